"""Both formulations against Pinocchio on random trees: accelerations, reactions, kinematics, invariants."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pinocchio_twin as twin
import pytest

from dq_space_arm_env.algebra import dual_quaternion, poses, screw, vectors
from dq_space_arm_env.dynamics import kinematics, minimal, newton_euler
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.forward import forward_dynamics
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix
from dq_space_arm_env.dynamics.minimal import Accelerations

pin = pytest.importorskip("pinocchio")

ZERO = (0.0, 0.0, 0.0)
SAMPLES = 15


def relative_error(actual, expected):
    expected = np.asarray(expected)
    return np.linalg.norm(np.asarray(actual, dtype=float) - expected) / max(np.linalg.norm(expected), 1e-300)


def random_case(joints, seed, wrench=False):
    """Robots of odd seeds branch."""
    rng = np.random.default_rng((joints, seed))
    tree = twin.random_tree(rng, joints, branches=seed % 2 == 1)
    tip_wrench = tuple(rng.normal(size=6).tolist()) if wrench else None
    tree = replace(tree, tip_wrench=tip_wrench)
    model = twin.pinocchio_model(tree)
    case = SimpleNamespace(
        tree=tree,
        model=model,
        data=model.createData(),
        base_pose=twin.random_placement(rng).dual_quaternion,
        angles=rng.uniform(-3.0, 3.0, joints).tolist(),
        wrist=rng.uniform(-3.0, 3.0, 3).tolist(),
        angular=tuple(rng.normal(size=3).tolist()),
        linear=tuple(rng.normal(size=3).tolist()),
        rates=rng.normal(size=joints).tolist(),
        force=tuple(rng.normal(size=3).tolist()),
        torque=tuple(rng.normal(size=3).tolist()),
        motors=rng.normal(size=joints).tolist(),
    )
    case.q = twin.configuration(case.base_pose, case.angles)
    case.v = twin.velocity(case.angular, case.linear, case.rates)
    return case


def external_forces(case):
    """Pinocchio's external forces: the wrench on the body with the tip, about that body's origin."""
    forces = pin.StdVec_Force()
    for _ in range(case.model.njoints):
        forces.append(pin.Force.Zero())
    if case.tree.tip_wrench is not None:
        rotation, position = twin.tip_on_its_body(case.tree, case.wrist)
        force = rotation @ case.tree.tip_wrench[:3]
        torque = rotation @ case.tree.tip_wrench[3:] + np.cross(position, force)
        forces[1 + case.tree.tip_body] = pin.Force(force, torque)
    return forces


def pinocchio_accelerations(case):
    tau = np.array([*case.force, *case.torque, *case.motors])
    a = pin.aba(case.model, case.data, case.q, case.v, tau, external_forces(case))
    return np.array([*a[3:6], *a[:3], *a[6:]])


def accelerations(case, inertia_at):
    """Dual accelerations of base and joints, given how a formulation's inertia is made of frames."""
    tree = case.tree
    frames = minimal.link_frames(tree, case.angles)
    acting = [(case.force, case.torque), *[(ZERO, ZERO)] * len(tree.links)]
    if tree.tip_wrench is not None:
        tip, wrench = twin.tip_on_its_body(tree, case.wrist), tree.tip_wrench
        loaded = minimal.shift_wrench(*tip, wrench[:3], wrench[3:])
        acting[tree.tip_body] = tuple(map(vectors.add, acting[tree.tip_body], loaded))
    inertia = inertia_at(tree, frames)
    solved = forward_dynamics(tree, inertia, frames, case.angular, case.rates, acting, case.motors)
    linear = vectors.subtract(solved.linear, vectors.cross(case.angular, case.linear))
    return np.array([*solved.angular, *linear, *solved.joints], dtype=float)


def paper_state(case):
    """The case in the paper's coordinates: dual velocities of all bodies at their centers of mass."""
    frames = minimal.link_frames(case.tree, case.angles)
    velocities = kinematics.body_velocities(case.tree, frames, (*case.angular, *case.linear), case.rates)
    bodies = case.tree.bodies
    duals = [
        (0.0, *v.angular, 0.0, *vectors.add(v.linear, vectors.cross(v.angular, body.center_of_mass)))
        for body, v in zip(bodies, velocities, strict=True)
    ]
    return newton_euler.PaperState(case.base_pose, case.angles, case.wrist, duals)


def paper_rates(case):
    base_wrench = (0.0, *case.force, 0.0, *case.torque)
    return newton_euler.paper_rates(case.tree, paper_state(case), base_wrench, case.motors, [0.0] * 3)


def newton_euler_accelerations(case):
    """Base and joint accelerations that the paper's dual accelerations imply: the rate of (12)."""
    frames = newton_euler.joint_frames(case.tree, case.angles, case.wrist)
    rates, _ = paper_rates(case)
    bodies = np.reshape(rates[-8 * (len(case.tree.links) + 1) :], (-1, 8))
    joints = newton_euler.along_joints(case.tree, frames, [tuple(body) for body in bodies])
    return np.array([*bodies[0][1:4], *bodies[0][5:8], *joints], dtype=float)


@pytest.mark.sampled
@pytest.mark.parametrize("wrench", [False, True])
@pytest.mark.parametrize("joints", range(8))
def test_all_formulations_agree_with_pinocchio_13_to_22(joints, wrench):
    """The mass matrix, articulated bodies from every root, and the paper's Newton-Euler system."""
    for seed in range(SAMPLES):
        case = random_case(joints, seed, wrench and joints > 0)
        expected = pinocchio_accelerations(case)
        assert relative_error(accelerations(case, MassMatrix), expected) < 4e-13
        assert relative_error(newton_euler_accelerations(case), expected) < 4e-13
        for root in range(joints + 1):
            found = accelerations(case, partial(ArticulatedBodies, root=root))
            assert relative_error(found, expected) < 2e-13


@pytest.mark.parametrize("joints", [1, 3, 6])
def test_reaction_wrenches_agree_with_pinocchio_21(joints):
    for seed in range(SAMPLES):
        case = random_case(joints, seed, wrench=True)
        _, reactions = paper_rates(case)
        a = pinocchio_accelerations(case)
        acceleration = np.array([*a[3:6], *a[:3], *a[6:]])
        pin.rnea(case.model, case.data, case.q, case.v, acceleration, external_forces(case))
        forces = list(case.data.f)[2:]
        expected = []
        for link, force in zip(case.tree.links, forces, strict=True):
            turns = link.screw.turn
            expected += [*force.linear, *force.angular[:2]] if turns else [*force.linear[:2], *force.angular]
        assert relative_error(reactions, expected) < 1e-13


def test_schur_complement_solves_the_full_system_20():
    for joints in range(1, 6):
        case = random_case(joints, joints, wrench=True)
        state = paper_state(case)
        frames = newton_euler.joint_frames(case.tree, case.angles, case.wrist)
        wrench = (0.0, *case.force, 0.0, *case.torque)
        system = newton_euler.assemble(case.tree, frames, state.velocities, wrench, case.motors)
        size = 8 * (joints + 1)
        full = np.zeros((size + 5 * joints, size + 5 * joints))
        full[:size, :size], full[:size, size:], full[size:, :size] = system.s11, system.s12, system.s21
        expected = np.linalg.solve(full, [*system.b1, *system.b2])
        accelerations, reactions = newton_euler.solve_schur(case.tree, system)
        assert relative_error([*accelerations, *reactions], expected) < 2e-13


def test_tip_pose_27_and_its_rate_30():
    for joints in range(5):
        case = random_case(joints, joints)
        twist, wrist_rates = (*case.angular, *case.linear), (0.3, -0.4, 0.5)
        arguments = (case.tree, case.base_pose, case.angles, case.wrist)
        pin.forwardKinematics(case.model, case.data, case.q)
        last = case.data.oMi[1 + case.tree.tip_body]
        rotation, position = twin.tip_on_its_body(case.tree, case.wrist)
        matrix, origin = poses.to_matrix(kinematics.tip_pose(*arguments))
        np.testing.assert_allclose(matrix, last.rotation @ rotation, rtol=0, atol=1e-14)
        np.testing.assert_allclose(origin, last.translation + last.rotation @ position, rtol=0, atol=1e-14)
        frames = kinematics.frame_poses(*arguments)
        np.testing.assert_allclose(frames[-1], kinematics.tip_pose(*arguments), rtol=0, atol=5e-15)

        def moved(h, case=case, twist=twist, wrist_rates=wrist_rates):
            base = dual_quaternion.multiply(case.base_pose, screw.exponential([h * w for w in twist]))
            angles = [a + h * r for a, r in zip(case.angles, case.rates, strict=True)]
            wrist = [a + h * r for a, r in zip(case.wrist, wrist_rates, strict=True)]
            return np.array(kinematics.tip_pose(case.tree, base, angles, wrist))

        h = 1e-3
        eighth_order = sum(
            weight * (moved(k * h) - moved(-k * h))
            for k, weight in ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
        )
        rate = kinematics.tip_pose_rate(*arguments, twist, case.rates, wrist_rates)
        np.testing.assert_allclose(rate, eighth_order / h, rtol=0, atol=4e-12)


def test_momentum_and_energy_agree_with_pinocchio():
    for joints in range(8):
        case = random_case(joints, joints)
        frames = minimal.link_frames(case.tree, case.angles)
        twist = (*case.angular, *case.linear)
        velocities = kinematics.body_velocities(case.tree, frames, twist, case.rates)
        linear, angular, _ = kinematics.momentum(case.tree, frames, velocities)
        kinetic, potential = kinematics.energy(case.tree, case.angles, velocities)
        arguments = (case.model, case.data, case.q, case.v)
        centroidal = pin.computeCentroidalMomentum(*arguments)
        attitude, _ = poses.to_matrix(case.base_pose)
        assert relative_error(np.array(attitude) @ linear, centroidal.linear) < 1e-14
        assert relative_error(np.array(attitude) @ angular, centroidal.angular) < 1e-14
        assert kinetic == pytest.approx(pin.computeKineticEnergy(*arguments), rel=5e-15)
        assert potential == 0.0


def test_inverse_dynamics_undoes_forward_dynamics():
    for joints in range(8):
        case = random_case(joints, joints)
        frames = minimal.link_frames(case.tree, case.angles)
        a = accelerations(case, MassMatrix)
        linear = vectors.add(tuple(a[3:6]), vectors.cross(case.angular, case.linear))
        solved = Accelerations(tuple(a[:3]), linear, a[6:].tolist())
        found = minimal.inverse_dynamics(case.tree, frames, case.angular, case.rates, solved)
        given = [*case.force, *case.torque, *case.motors]
        assert relative_error([*found.force, *found.torque, *found.joints], given) < 1e-12
