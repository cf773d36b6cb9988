"""The paper's formulation: a dual-quaternion Newton-Euler equation per body, a constraint per joint.

Frames e_0 .. e_n sit at the centers of mass; e_{i+1} is parallel to joint frame i. Unknown are the dual
accelerations of all bodies and the reaction wrenches of all joints (20). Indices and frames follow the
corrected equations: reaction wrench i is what body i exerts on body i+1, in the axes of joint frame i and
about its origin. A dual vector occupies 8 slots: scalar, vector of the real part, scalar, vector of the dual
part; velocities carry the angular part in the real slots, wrenches the force.

This formulation is the reference for those in minimal coordinates (`forward`), which simulations use: 8
numbers per body against one per joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dq_space_arm_env.algebra import dual_matrices
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.dynamics.kinematics import axis_rotation, tip_pose_rate, wrist_rotation
from dq_space_arm_env.dynamics.linear import factorize_ldl, solve_ldl
from dq_space_arm_env.dynamics.minimal import passive_torques

Scalar = Any
DualQuaternion = Sequence[Scalar]
Matrix = list[list[Scalar]]

# E_158 keeps what a revolute joint can transmit, E_145 the velocities that it forbids (counted from zero).
TRANSMITTED = (1, 2, 3, 5, 6)
FORBIDDEN = (1, 2, 5, 6, 7)


@dataclass(frozen=True)
class NewtonEulerSystem:
    """The linear system (20): S11 ydot + S12 T = B1, S21 ydot = B2.

    Attributes:
        s11: Block diagonal of H(M_i), (8 (n+1), 8 (n+1)).
        s12: How reaction wrenches act on the bodies, (8 (n+1), 5 n).
        s21: Joint constraints on the dual accelerations, (5 n, 8 (n+1)).
        b1: Wrenches, 8 (n+1).
        b2: Centripetal terms of the constraints, 5 n.
    """

    s11: Matrix
    s12: Matrix
    s21: Matrix
    b1: list[Scalar]
    b2: list[Scalar]


@dataclass(frozen=True)
class JointFrames:
    """Relative poses around each joint.

    Attributes:
        distal: q_{i/e_i} = C_i Rz(theta), joint frame i with respect to the body before it.
        proximal: q_{e_{i+1}/i} = D_i, the body after the joint with respect to joint frame i; constant.
        tip: q_{G/e_n}.
    """

    distal: Sequence[DualQuaternion]
    proximal: Sequence[DualQuaternion]
    tip: DualQuaternion


def _translation(position: Sequence[Scalar]) -> DualQuaternion:
    return (1.0, 0.0, 0.0, 0.0, 0.0, 0.5 * position[0], 0.5 * position[1], 0.5 * position[2])


def joint_frames(chain: Chain, joint_angles: Sequence[Scalar], wrist_angles: Sequence[Scalar]) -> JointFrames:
    """Poses that (13)-(19) refer to.

    Args:
        chain: The robot.
        joint_angles: n, rad.
        wrist_angles: psi, theta, phi, rad; ignored without a wrist.

    Returns:
        The relative poses.
    """
    distal, proximal = [], []
    center: Sequence[float] = (0.0, 0.0, 0.0)
    for link, angle in zip(chain.links, joint_angles, strict=True):
        fixed = dq.multiply(_translation([-c for c in center]), link.joint.dual_quaternion)
        distal.append(dq.multiply(fixed, axis_rotation(2, angle)))
        center = link.body.center_of_mass
        proximal.append(_translation(center))
    tip: DualQuaternion = _translation([-c for c in center])
    if chain.wrist is not None:
        tip = dq.multiply(dq.multiply(tip, chain.wrist.dual_quaternion), wrist_rotation(wrist_angles))
    return JointFrames(distal, proximal, dq.multiply(tip, chain.tip.dual_quaternion))


def joint_velocity(frames: JointFrames, joint: int, velocities: Sequence[DualQuaternion]) -> DualQuaternion:
    """Dual velocity of a joint in its own axes, omega^i_{i/e_i}; row 4 of it is the joint rate (12).

    Args:
        frames: From `joint_frames`.
        joint: Index i.
        velocities: Dual velocities omega^{e_i}_{e_i/I} of all bodies, 8 each.

    Returns:
        Dual vector, 8 numbers; all but the rate about z vanish when the velocities obey the joint.
    """
    after, before = frames.proximal[joint], frames.distal[joint]
    return dq.subtract(
        dq.adjoint(after, velocities[joint + 1]), dq.inverse_adjoint(before, velocities[joint])
    )


def assemble(
    chain: Chain,
    frames: JointFrames,
    velocities: Sequence[DualQuaternion],
    base_wrench: DualQuaternion,
    joint_torques: Sequence[Scalar],
) -> NewtonEulerSystem:
    """Assemble (20) from (13)-(16) and (19).

    Args:
        chain: The robot.
        frames: From `joint_frames`.
        velocities: Dual velocities omega^{e_i}_{e_i/I} of all bodies, 8 each.
        base_wrench: External wrench on the base, force [N] real, torque [N m] dual, 8.
        joint_torques: Torques about the joint axes on the distal bodies, springs and dampers included, n, N
            m.

    Returns:
        The system.
    """
    n = len(chain.links)
    bodies = [chain.base, *(link.body for link in chain.links)]
    s11 = _zeros(8 * (n + 1), 8 * (n + 1))
    s12, s21 = _zeros(8 * (n + 1), 5 * n), _zeros(5 * n, 8 * (n + 1))
    b1: list[Scalar] = []
    b2: list[Scalar] = []
    for i, (body, velocity) in enumerate(zip(bodies, velocities, strict=True)):
        inertia = dual_matrices.dual_inertia_matrix(body.mass, body.inertia)
        _place(s11, 8 * i, 8 * i, dual_matrices.swap_columns(inertia))
        # (9): the gyroscopic term omega x (M omega^s) moves to the right.
        momentum = dual_matrices.matrix_multiply(inertia, dq.swap(velocity))
        b1 += dq.scale(-1.0, dq.cross(velocity, momentum))
    _accumulate(b1, 0, base_wrench)
    if chain.tip_wrench is not None:
        wrench = (0.0, *chain.tip_wrench[:3], 0.0, *chain.tip_wrench[3:])
        _accumulate(b1, 8 * n, dq.adjoint(frames.tip, wrench))
    for j in range(n):
        before, after = frames.distal[j], frames.proximal[j]
        actuation = (0.0,) * 7 + (joint_torques[j],)
        for body_index, pose, sign in ((j, before, 1.0), (j + 1, dq.conjugate(after), -1.0)):
            transfer = dual_matrices.adjoint_matrix(pose)
            _place(s12, 8 * body_index, 5 * j, [[sign * row[c] for c in TRANSMITTED] for row in transfer])
            _accumulate(b1, 8 * body_index, dq.scale(-sign, dq.adjoint(pose, actuation)))
        back = dual_matrices.adjoint_matrix(dq.conjugate(before))
        _place(s21, 5 * j, 8 * (j + 1), [dual_matrices.adjoint_matrix(after)[row] for row in FORBIDDEN])
        _place(s21, 5 * j, 8 * j, [[-entry for entry in back[row]] for row in FORBIDDEN])
        carried = dq.inverse_adjoint(before, velocities[j])
        centripetal = dq.cross(carried, joint_velocity(frames, j, velocities))
        b2 += [centripetal[row] for row in FORBIDDEN]
    return NewtonEulerSystem(s11, s12, s21, b1, b2)


class SchurComplement:
    """S21 S11^-1 S12 of (21), factorized: solves (20) for any right-hand side.

    With the constraint rows in the order of the wrenches that enforce them, -S21 S11^-1 S12 is symmetric
    positive definite.
    """

    def __init__(self, chain: Chain, system: NewtonEulerSystem) -> None:
        """Factorize.

        Args:
            chain: The robot; the inverse of S11 is known in closed form from its mass properties.
            system: From `assemble`; its right-hand side is not read.
        """
        self._system = system
        self._bodies = [chain.base, *(link.body for link in chain.links)]
        count = len(system.s21)
        # A force enforces a linear velocity, a torque an angular one: (vx, vy, vz, wx, wy) within each joint.
        order = [5 * (k // 5) + (2, 3, 4, 0, 1)[k % 5] for k in range(count)]
        self._order = order
        self._constraints = [system.s21[row] for row in order]
        columns = [[row[c] for row in system.s12] for c in range(count)]
        self._weighted = [_solve_inertia(self._bodies, column) for column in columns]
        self._factor = factorize_ldl(
            [[-_product(row, column) for column in self._weighted] for row in self._constraints]
        )

    def solve(self, b1: Sequence[Scalar], b2: Sequence[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Dual accelerations (22) and reaction wrenches (21).

        Args:
            b1: Wrenches on the bodies, 8 (n+1), N and N m.
            b2: Right-hand side of the constraints, 5 n.

        Returns:
            Dual accelerations of all bodies, 8 (n+1), and reaction wrenches, 5 n (fx, fy, fz in N, tx, ty in
            N m per joint).
        """
        accelerations = _solve_inertia(self._bodies, b1)
        right = [
            b2[row] - _product(constraint, accelerations)
            for row, constraint in zip(self._order, self._constraints, strict=True)
        ]
        reactions = solve_ldl(self._factor, right)
        for reaction, column in zip(reactions, self._weighted, strict=True):
            accelerations = [a - reaction * c for a, c in zip(accelerations, column, strict=True)]
        return accelerations, reactions

    def refine(
        self, b1: Sequence[Scalar], b2: Sequence[Scalar], solution: tuple[list[Scalar], list[Scalar]]
    ) -> tuple[list[Scalar], list[Scalar]]:
        """Solve once more, for what a solution leaves of the right-hand side (iterative refinement).

        Entries of the Schur complement are as large as the greatest mobility of any body: about the axis of a
        needle, 1 over its moment of inertia. What else they add up is rounded accordingly; the system itself
        is not, and its residual tells.

        Args:
            b1: Wrenches on the bodies, 8 (n+1), N and N m.
            b2: Right-hand side of the constraints, 5 n.
            solution: From `solve`, for the same right-hand side.

        Returns:
            As `solve`.
        """
        accelerations, reactions = solution
        left = self._system
        unbalanced = [
            value - _product(own, accelerations) - _product(others, reactions)
            for value, own, others in zip(b1, left.s11, left.s12, strict=True)
        ]
        violated = [value - _product(row, accelerations) for value, row in zip(b2, left.s21, strict=True)]
        corrections = self.solve(unbalanced, violated)
        return (
            [a + b for a, b in zip(accelerations, corrections[0], strict=True)],
            [a + b for a, b in zip(reactions, corrections[1], strict=True)],
        )


def solve_schur(
    chain: Chain, system: NewtonEulerSystem, refinements: int = 0
) -> tuple[list[Scalar], list[Scalar]]:
    """Dual accelerations (22) and reaction wrenches (21) of a system.

    Args:
        chain: The robot.
        system: From `assemble`.
        refinements: How often to solve once more for the residual.

    Returns:
        As `SchurComplement.solve`.
    """
    complement = SchurComplement(chain, system)
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
    """The paper's state: 46 numbers for three links and a wrist.

    Attributes:
        base_pose: q_{e0/I}, 8.
        joint_angles: n, rad.
        wrist_angles: psi, theta, phi, rad; empty without a wrist.
        velocities: Dual velocities of all bodies, n + 1 times 8.
    """

    base_pose: DualQuaternion
    joint_angles: Sequence[Scalar]
    wrist_angles: Sequence[Scalar]
    velocities: Sequence[DualQuaternion]

    @classmethod
    def from_vector(cls, chain: Chain, x: Sequence[Scalar]) -> PaperState:
        """Split a state vector of 8 + n + (3) + 8 (n + 1) numbers."""
        n, wrist = len(chain.links), 0 if chain.wrist is None else 3
        start = 8 + n + wrist
        velocities = [x[start + 8 * i : start + 8 * i + 8] for i in range(n + 1)]
        return cls(x[:8], x[8 : 8 + n], x[8 + n : start], velocities)


def paper_rates(
    chain: Chain,
    state: PaperState,
    base_wrench: DualQuaternion,
    joint_torques: Sequence[Scalar],
    wrist_rates: Sequence[Scalar],
) -> tuple[list[Scalar], list[Scalar]]:
    """Time derivative of the paper's state (11), (12), (22), and the reaction wrenches (21).

    Args:
        chain: The robot.
        state: The state.
        base_wrench: External wrench on the base, 8, N and N m.
        joint_torques: Motor torques, n, N m.
        wrist_rates: psi, theta, phi rates, rad/s; empty without a wrist.

    Returns:
        Derivative of the state vector, and the reaction wrenches, 5 n.
    """
    system = system_of(chain, state, base_wrench, joint_torques)
    accelerations, reactions = solve_schur(chain, system)
    return [*paper_position_rates(chain, state, wrist_rates), *accelerations], reactions


def system_of(
    chain: Chain, state: PaperState, base_wrench: DualQuaternion, joint_torques: Sequence[Scalar]
) -> NewtonEulerSystem:
    """The system (20) of a state and its inputs, springs and dampers included.

    Args:
        chain: The robot.
        state: The state.
        base_wrench: External wrench on the base, 8, N and N m.
        joint_torques: Motor torques, n, N m.

    Returns:
        The system.
    """
    frames = joint_frames(chain, state.joint_angles, state.wrist_angles)
    passive = passive_torques(chain, state.joint_angles, joint_speeds(chain, state))
    torques = [motor + other for motor, other in zip(joint_torques, passive, strict=True)]
    return assemble(chain, frames, state.velocities, base_wrench, torques)


def joint_speeds(chain: Chain, state: PaperState) -> list[Scalar]:
    """Joint rates (12) from the dual velocities of the bodies.

    Args:
        chain: The robot.
        state: The state.

    Returns:
        Joint rates, n, rad/s.
    """
    frames = joint_frames(chain, state.joint_angles, state.wrist_angles)
    return [joint_velocity(frames, j, state.velocities)[3] for j in range(len(chain.links))]


def paper_position_rates(chain: Chain, state: PaperState, wrist_rates: Sequence[Scalar]) -> list[Scalar]:
    """Rates of base pose (11), joint angles (12) and wrist angles.

    Args:
        chain: The robot.
        state: The state.
        wrist_rates: psi, theta, phi rates, rad/s; empty without a wrist.

    Returns:
        8 + n + (3) rates.
    """
    pose_rate = dq.scale(0.5, dq.multiply(state.base_pose, state.velocities[0]))
    return [*pose_rate, *joint_speeds(chain, state), *wrist_rates]


def paper_tip_rate(chain: Chain, state: PaperState, wrist_rates: Sequence[Scalar]) -> DualQuaternion:
    """Rate of the tip's pose (30) from the paper's state: what the 54-dimensional formulation appends.

    Args:
        chain: The robot.
        state: The state.
        wrist_rates: psi, theta, phi rates, rad/s; empty without a wrist.

    Returns:
        Derivative of q_{G/I}, 8, 1/s.
    """
    base = state.velocities[0]
    return tip_pose_rate(
        chain,
        state.base_pose,
        state.joint_angles,
        state.wrist_angles,
        (*base[1:4], *base[5:8]),
        joint_speeds(chain, state),
        wrist_rates,
    )
