"""The paper's formulation: a dual-quaternion Newton-Euler equation per body, a constraint per joint.

Frames e_0 .. e_n sit at the centers of mass; e_{i+1} is parallel to joint frame i. The unknowns are the dual
accelerations of all bodies and the reaction wrenches of all joints (20). Indices and frames follow the
corrected equations: reaction wrench i is what the parent of body i+1, in the paper body i, exerts on it, in
the axes of joint frame i and about its origin; its columns and rows in (20) are those of these two bodies. A
dual vector has 8 slots: scalar and vector of the real part, scalar and vector of the dual part; velocities
carry the angular part in the real slots, wrenches the force.

It is the reference for minimal coordinates (`forward`), which simulations use: 8 numbers per body against one
per joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra import dual_matrices
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.kinematics import joint_motion, tip_pose_rate, wrist_rotation
from dq_space_arm_env.dynamics.linear import factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.minimal import angle_rates, passive_torques
from dq_space_arm_env.dynamics.paper_joints import (
    FORBIDDEN,
    PRISMATIC_FORBIDDEN,
    Joint,
    bodies_of,
    count_of_coordinates,
    forbidden,
    joints_of,
    tip_body_of,
    transmitted,
)

Scalar = Any
DualQuaternion = Sequence[Scalar]
Matrix = list[list[Scalar]]


@dataclass(frozen=True)
class NewtonEulerSystem:
    """The linear system (20): S11 ydot + S12 T = B1, S21 ydot = B2."""

    s11: Matrix  # block diagonal of H(M_i), (8 (n+1), 8 (n+1))
    s12: Matrix  # reaction wrenches on the bodies, (8 (n+1), 5 n)
    s21: Matrix  # joint constraints on the dual accelerations, (5 n, 8 (n+1))
    b1: list[Scalar]  # wrenches, 8 (n+1)
    b2: list[Scalar]  # centripetal terms of the constraints, 5 n
    # Rotors add an unknown to T each, the negative of what their spin changes by per second, with the row
    # that says so: S21 ydot + S22 T = B2.
    s22: list[Scalar]  # diagonal of S22: 0 for constraints, 1 / J_r for rotors


@dataclass(frozen=True)
class JointFrames:
    """Relative poses around each joint."""

    distal: Sequence[DualQuaternion]  # q_{i/e_i} = C_i exp(1/2 theta s), joint frame i in its parent
    proximal: Sequence[DualQuaternion]  # q_{e_{i+1}/i} = D_i, body after the joint in joint frame i; constant
    tip: DualQuaternion  # q_{G/e_n} in the body that carries the tip


def _translation(position: Sequence[Scalar]) -> DualQuaternion:
    return (1.0, 0.0, 0.0, 0.0, 0.0, 0.5 * position[0], 0.5 * position[1], 0.5 * position[2])


def joint_frames(
    tree: KinematicTree, joint_angles: Sequence[Scalar], wrist_angles: Sequence[Scalar]
) -> JointFrames:
    """Relative poses that (13)-(19) refer to."""
    distal, proximal = [], []
    to_center = [_translation([-c for c in body.center_of_mass]) for body in bodies_of(tree)]
    for joint in joints_of(tree):
        fixed = dq.multiply(to_center[joint.parent], joint.link.joint.dual_quaternion)
        distal.append(dq.multiply(fixed, joint_motion(joint.link.screw, joint_angles[joint.first])))
        proximal.append(_translation(joint.body.center_of_mass))
    tip: DualQuaternion = to_center[tip_body_of(tree)]
    if tree.wrist is not None:
        tip = dq.multiply(dq.multiply(tip, tree.wrist.dual_quaternion), wrist_rotation(wrist_angles))
    return JointFrames(distal, proximal, dq.multiply(tip, tree.tip.dual_quaternion))


def joint_velocity(
    tree: KinematicTree, frames: JointFrames, joint: int, velocities: Sequence[DualQuaternion]
) -> DualQuaternion:
    """Dual velocity of a joint in its own axes, omega^i_{i/e_i}.

    Entry 3, or 7 of a prismatic joint, is the joint rate (12), entries 1 to 3 those of a spherical one. A
    screw's entry 7 is pitch times its rate; the others vanish when the bodies obey the joint.
    """
    after, before = frames.proximal[joint], frames.distal[joint]
    # (12): Ad(q_{e_{i+1}/i}) w_{i+1} - Ad(q_{i/e_i}*) w_i.
    return dq.subtract(
        dq.adjoint(after, velocities[joint + 1]),
        dq.inverse_adjoint(before, velocities[joints_of(tree)[joint].parent]),
    )


def along_joints(
    tree: KinematicTree, frames: JointFrames, velocities: Sequence[DualQuaternion]
) -> list[Scalar]:
    """Joint rates (12) from the dual velocities of the bodies."""
    rates: list[Scalar] = []
    for j, joint in enumerate(joints_of(tree)):
        velocity = joint_velocity(tree, frames, j, velocities)
        rates += [velocity[entry] for entry in joint.free]
    return rates


def joint_accelerations(
    tree: KinematicTree,
    frames: JointFrames,
    velocities: Sequence[DualQuaternion],
    accelerations: Sequence[DualQuaternion],
) -> list[Scalar]:
    """Accelerations of the joints from the dual velocities and accelerations of the bodies, by (19).

    The turning of a single axis has no component along it: there (12) holds for accelerations too.
    """
    changes = along_joints(tree, frames, accelerations)
    for j, joint in enumerate(joints_of(tree)):
        if joint.link.spherical is not None:
            turned = _centripetal(tree, frames, j, velocities)
            for degree, entry in enumerate(joint.free):
                changes[joint.first + degree] = changes[joint.first + degree] - turned[entry]
    return changes


def _centripetal(
    tree: KinematicTree, frames: JointFrames, joint: int, velocities: Sequence[DualQuaternion]
) -> DualQuaternion:
    """The right-hand side of (19), w^j_{e_j/I} x w^j_{j/e_j}."""
    carried = dq.inverse_adjoint(frames.distal[joint], velocities[joints_of(tree)[joint].parent])
    return dq.cross(carried, joint_velocity(tree, frames, joint, velocities))


def assemble(
    tree: KinematicTree,
    frames: JointFrames,
    velocities: Sequence[DualQuaternion],
    base_wrench: DualQuaternion,
    joint_torques: Sequence[Scalar],
) -> NewtonEulerSystem:
    """Assemble (20) from (13)-(16) and (19).

    `velocities` holds omega^{e_i}_{e_i/I}, 8 per body; `joint_torques` include springs and dampers.
    """
    joints, bodies = joints_of(tree), bodies_of(tree)
    count = sum(len(joint.forbidden) for joint in joints)
    s11 = _zeros(8 * len(bodies), 8 * len(bodies))
    rotors = sum(link.rotor is not None for link in tree.links)
    s12, s21 = _zeros(8 * len(bodies), count + rotors), _zeros(count, 8 * len(bodies))
    b1: list[Scalar] = []
    b2: list[Scalar] = []
    for i, (body, velocity) in enumerate(zip(bodies, velocities, strict=True)):
        inertia = dual_matrices.dual_inertia_matrix(body.mass, body.inertia)
        _place(s11, 8 * i, 8 * i, dual_matrices.swap_columns(inertia))  # H(M_i) wdot_i = M_i wdot_i^s
        # (9): the gyroscopic term omega x (M omega^s) moves to the right.
        momentum = dual_matrices.matrix_multiply(inertia, dq.swap(velocity))
        b1 += dq.scale(-1.0, dq.cross(velocity, momentum))
    _accumulate(b1, 0, base_wrench)  # W_0 of (13)
    if tree.tip_wrench is not None:
        wrench = (0.0, *tree.tip_wrench[:3], 0.0, *tree.tip_wrench[3:])
        _accumulate(b1, 8 * tip_body_of(tree), dq.adjoint(frames.tip, wrench))  # Ad(q_{G/e_n}) W_ext of (16)
    for j, joint in enumerate(joints):
        before, after, parent = frames.distal[j], frames.proximal[j], joint.parent
        # (13)-(16): +-Ad(.) E158' W~_{j+1/j} on the left, -+Ad(.) W_act,j+1 on the right.
        actuation = [0.0] * 8
        for degree, entry in enumerate(joint.free):  # a torque turns, a force slides
            actuation[(entry + 4) % 8] = joint_torques[joint.first + degree]
        for body_index, pose, sign in ((parent, before, 1.0), (j + 1, dq.conjugate(after), -1.0)):
            transfer = dual_matrices.adjoint_matrix(pose)
            columns = [[sign * entry for entry in transmitted(joint, row)] for row in transfer]
            _place(s12, 8 * body_index, joint.row, columns)
            _accumulate(b1, 8 * body_index, dq.scale(-sign, dq.adjoint(pose, actuation)))
        # (19): E145 Ad(q_{e_{j+1}/j}) wdot_{j+1} - E145 Ad(q_{j/e_j}*) wdot_j = E145 (w^j_{e_j/I} x
        # w^j_{j/e_j}).
        back = dual_matrices.adjoint_matrix(dq.conjugate(before))
        _place(s21, joint.row, 8 * (j + 1), forbidden(joint, dual_matrices.adjoint_matrix(after)))
        _place(s21, joint.row, 8 * parent, [[-entry for entry in row] for row in forbidden(joint, back)])
        centripetal = _centripetal(tree, frames, j, velocities)
        b2 += [row[0] for row in forbidden(joint, [[entry] for entry in centripetal])]
    s22: list[Scalar] = [0.0] * len(b2)
    for j, joint in enumerate(joints):
        link = joint.link
        if link.rotor is not None:
            row = _rotor_row(joint, frames, j)
            for body_index, entries in row.items():
                _place(s12, 8 * body_index, len(s22), [[-entry] for entry in dq.swap(entries)])
            s21.append([0.0] * len(s11))
            for body_index, entries in row.items():
                _place(s21, len(s22), 8 * body_index, [entries])
            s22.append(1.0 / link.rotor.inertia)
            b2.append(0.0)
            gyroscopic = _gyroscopic(joint, frames, j, velocities)
            _accumulate(b1, 8 * joint.parent, dq.scale(-1.0, dq.adjoint(frames.distal[j], gyroscopic)))
    return NewtonEulerSystem(s11, s12, s21, b1, b2, s22)


def _rotor_row(whole: Joint, frames: JointFrames, joint: int) -> dict[int, list[Scalar]]:
    """The rate of a rotor per dual velocity of the bodies before and after its joint, 8 each."""
    link = whole.link
    assert link.rotor is not None
    along = 3 if link.screw.turn else 7
    after = dual_matrices.adjoint_matrix(frames.proximal[joint])
    before = dual_matrices.adjoint_matrix(dq.conjugate(frames.distal[joint]))
    own = [link.rotor.gear * entry for entry in after[along]]
    carrier = [-link.rotor.gear * entry for entry in before[along]]
    if link.rotor.exact:
        carrier = [entry + turning for entry, turning in zip(carrier, before[3], strict=True)]
    return {whole.parent: carrier, joint + 1: own}


def _gyroscopic(
    whole: Joint, frames: JointFrames, joint: int, velocities: Sequence[DualQuaternion]
) -> DualQuaternion:
    """Wrench that a rotor's spin needs as the body that carries it turns, joint axes: omega x s z."""
    link, parent = whole.link, whole.parent
    assert link.rotor is not None
    if not link.rotor.exact:
        return [0.0] * 8
    carried = dq.inverse_adjoint(frames.distal[joint], velocities[parent])
    parents = {parent: velocities[parent], joint + 1: velocities[joint + 1]}
    row = _rotor_row(whole, frames, joint)
    spin = link.rotor.inertia * sum(_product(row[body], parents[body]) for body in parents)
    return [0.0, 0.0, 0.0, 0.0, 0.0, carried[2] * spin, -carried[1] * spin, 0.0]


class SchurComplement:
    """S21 S11^-1 S12 of (21), factorized: solves (20) for any right-hand side.

    With the constraint rows in the order of the wrenches that enforce them, -S21 S11^-1 S12 is symmetric
    positive definite.
    """

    def __init__(self, tree: KinematicTree, system: NewtonEulerSystem) -> None:
        self._system = system
        self._bodies = bodies_of(tree)
        count = len(system.s21)
        # A force enforces a linear velocity, a torque an angular one: (vx, vy, vz, wx, wy) within each joint,
        # (vx, vy, wx, wy, wz) within a prismatic one, (vx, vy, vz) within a spherical one.
        pairing: dict[tuple[int, ...], tuple[int, ...]] = {
            FORBIDDEN: (2, 3, 4, 0, 1),
            PRISMATIC_FORBIDDEN: (3, 4, 0, 1, 2),
        }
        order = [joint.row + k for joint in joints_of(tree) for k in pairing.get(joint.forbidden, (0, 1, 2))]
        joints = len(order)
        order += range(joints, count)  # rotors pair with their own rows
        self._order = order
        self._constraints = [system.s21[row] for row in order]
        columns = [[row[c] for row in system.s12] for c in range(count)]
        self._weighted = [_solve_inertia(self._bodies, column) for column in columns]
        complement = [[-_product(row, column) for column in self._weighted] for row in self._constraints]
        for k in range(joints, count):
            complement[k][k] = complement[k][k] + system.s22[k]
        self._factor = factorize_ldl(complement)

    def solve(self, b1: Sequence[Scalar], b2: Sequence[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Dual accelerations (22), 8 (n+1), and reaction wrenches (21), 5 n, of right-hand sides b1, b2.

        Those of rotors come after the reaction wrenches.
        """
        accelerations = _solve_inertia(self._bodies, b1)  # S11^-1 B1
        # (21): (-S21 S11^-1 S12) T = B2 - S21 S11^-1 B1.
        right = [
            b2[row] - _product(constraint, accelerations)
            for row, constraint in zip(self._order, self._constraints, strict=True)
        ]
        reactions = solve_ldl(self._factor, right)
        # (22): ydot = S11^-1 (B1 - S12 T).
        for reaction, column in zip(reactions, self._weighted, strict=True):
            accelerations = [a - reaction * c for a, c in zip(accelerations, column, strict=True)]
        return accelerations, reactions

    def refine(
        self, b1: Sequence[Scalar], b2: Sequence[Scalar], solution: tuple[list[Scalar], list[Scalar]]
    ) -> tuple[list[Scalar], list[Scalar]]:
        """Improve a solution by solving for its residual (iterative refinement).

        Entries of the Schur complement are as large as the greatest mobility of any body: about the axis of a
        needle, 1 over its moment of inertia. Smaller terms of the same sums are rounded accordingly; the
        residual of the system itself is not.
        """
        accelerations, reactions = solution
        left = self._system
        unbalanced = [
            value - _product(own, accelerations) - _product(others, reactions)
            for value, own, others in zip(b1, left.s11, left.s12, strict=True)
        ]
        violated = [
            value - _product(row, accelerations) - own * reaction
            for value, row, own, reaction in zip(b2, left.s21, left.s22, reactions, strict=True)
        ]
        corrections = self.solve(unbalanced, violated)
        return (
            [a + b for a, b in zip(accelerations, corrections[0], strict=True)],
            [a + b for a, b in zip(reactions, corrections[1], strict=True)],
        )


def solve_schur(
    tree: KinematicTree, system: NewtonEulerSystem, refinements: int = 0
) -> tuple[list[Scalar], list[Scalar]]:
    """Dual accelerations (22) and reaction wrenches (21), refined a number of times."""
    complement = SchurComplement(tree, system)
    solution = complement.solve(system.b1, system.b2)
    for _ in range(refinements):
        solution = complement.refine(system.b1, system.b2, solution)
    return solution


def _solve_inertia(bodies: Sequence[Any], wrenches: Sequence[Scalar]) -> list[Scalar]:
    """S11^-1 applied to stacked wrenches: force / m is linear, J^-1 torque angular acceleration."""
    result: list[Scalar] = []
    for i, body in enumerate(bodies):
        wrench = wrenches[8 * i : 8 * i + 8]
        angular = solve_ldl(factorize_ldl(body.inertia), wrench[5:8])
        linear = [entry * (1.0 / body.mass) for entry in wrench[1:4]]
        result += [wrench[4], *angular, wrench[0], *linear]
    return result


def _zeros(rows: int, columns: int) -> Matrix:
    return [[0.0] * columns for _ in range(rows)]


def _place(matrix: Matrix, row: int, column: int, block: Sequence[Sequence[Scalar]]) -> None:
    for i, values in enumerate(block):
        matrix[row + i][column : column + len(values)] = list(values)


def _accumulate(vector: list[Scalar], start: int, values: Sequence[Scalar]) -> None:
    for i, value in enumerate(values):
        vector[start + i] = vector[start + i] + value


def _product(row: Sequence[Scalar], column: Sequence[Scalar]) -> Scalar:
    total: Scalar = 0.0
    for a, b in zip(row, column, strict=True):
        total = total + a * b
    return total


@dataclass(frozen=True)
class PaperState:
    """The paper's state: 46 numbers for three links and a wrist."""

    base_pose: DualQuaternion  # q_{e0/I}, 8
    joint_angles: Sequence[Any]  # n, rad; of spherical joints see `KinematicTree.coordinates`
    wrist_angles: Sequence[Scalar]  # psi, theta, phi, rad; empty without a wrist
    velocities: Sequence[DualQuaternion]  # dual velocities omega^{e_i}_{e_i/I} of all bodies

    @classmethod
    def from_vector(cls, tree: KinematicTree, x: Sequence[Scalar]) -> PaperState:
        """Split a state vector of 8 + n + (3) + 8 (n + 1) numbers, one more for each spherical joint."""
        n, wrist = count_of_coordinates(tree), 0 if tree.wrist is None else 3
        start, bodies = 8 + n + wrist, range(len(joints_of(tree)) + 1)
        velocities = [x[start + 8 * i : start + 8 * i + 8] for i in bodies]
        return cls(x[:8], tree.coordinates(x[8 : 8 + n]), x[8 + n : start], velocities)


def paper_rates(
    tree: KinematicTree,
    state: PaperState,
    base_wrench: DualQuaternion,
    joint_torques: Sequence[Scalar],
    wrist_rates: Sequence[Scalar],
) -> tuple[list[Scalar], list[Scalar]]:
    """Time derivative of the paper's state (11), (12), (22), and the reaction wrenches (21)."""
    system = system_of(tree, state, base_wrench, joint_torques)
    accelerations, reactions = solve_schur(tree, system)
    count = sum(len(joint.forbidden) for joint in joints_of(tree))
    return [*paper_position_rates(tree, state, wrist_rates), *accelerations], reactions[:count]


def system_of(
    tree: KinematicTree, state: PaperState, base_wrench: DualQuaternion, joint_torques: Sequence[Scalar]
) -> NewtonEulerSystem:
    """The system (20) of a state and its inputs, springs and dampers included."""
    frames = joint_frames(tree, state.joint_angles, state.wrist_angles)
    passive = passive_torques(tree, state.joint_angles, joint_speeds(tree, state))
    torques = [motor + other for motor, other in zip(joint_torques, passive, strict=True)]
    return assemble(tree, frames, state.velocities, base_wrench, torques)


def joint_speeds(tree: KinematicTree, state: PaperState) -> list[Scalar]:
    """Joint rates (12) from the dual velocities of the bodies."""
    frames = joint_frames(tree, state.joint_angles, state.wrist_angles)
    return along_joints(tree, frames, state.velocities)


def paper_position_rates(
    tree: KinematicTree, state: PaperState, wrist_rates: Sequence[Scalar]
) -> list[Scalar]:
    """Rates of base pose (11), joint angles (12) and wrist angles."""
    pose_rate = dq.scale(0.5, dq.multiply(state.base_pose, state.velocities[0]))  # (8), (11)
    angles = angle_rates(tree, state.joint_angles, joint_speeds(tree, state))
    return [*pose_rate, *angles, *wrist_rates]


def paper_tip_rate(tree: KinematicTree, state: PaperState, wrist_rates: Sequence[Scalar]) -> DualQuaternion:
    """Time derivative of q_{G/I} (30), which the 54-dimensional formulation appends."""
    base = state.velocities[0]
    return tip_pose_rate(
        tree,
        state.base_pose,
        state.joint_angles,
        state.wrist_angles,
        (*base[1:4], *base[5:8]),
        joint_speeds(tree, state),
        wrist_rates,
    )
