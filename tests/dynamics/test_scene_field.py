"""The field of a scene in plain numbers: accelerations undo inverse dynamics, derivatives are of the rates.

Nothing is compiled here: what the compiled dynamics must give is said in `kernels/test_kernels_dynamics.py`.
"""

from typing import Any

import casadi
import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.algebra.vectors import add, cross
from dq_space_arm_env.dynamics import linear, minimal
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.minimal import Accelerations
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.scene import Actuators, InitialState, JointLimit, Pose, Spread
from dq_space_arm_env.scene.layout import StateLayout

FORMULATIONS = ("articulated_body", "minimal_coordinates")


def sprung(name: str) -> Scene:
    """The scene with a spring and a damper in every joint."""
    scene = load_scene(name)
    passive = {"stiffness": 3.0, "rest_angle": 0.2, "damping": 0.7}
    return scene.replace(links=[link.model_dump() | passive for link in scene.links])


def field_of(scene: Scene, formulation: str | None = None) -> SpaceArmField:
    return SpaceArmField(KinematicTree.from_scene(scene), StateLayout.of(scene), formulation=formulation)


def drawn(field: SpaceArmField, seed: int = 0) -> tuple[list[float], list[float]]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, field.n_y).tolist(), rng.normal(size=field.n_u).tolist()


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("name", ["paper", "planar", "tip-load", "payload"])
def test_the_forces_that_the_accelerations_need_are_those_that_act(name: str, formulation: str) -> None:
    field = field_of(sprung(name), formulation)
    tree, layout = field.tree, field.layout
    y, u = drawn(field)
    found = field.accelerations(y, u)
    motion = field.motion(y)
    twist = field.pose.full_twist(found[: len(field.pose.directions)])
    inertial = add(twist[3:], cross(motion.angular, motion.linear))
    given = Accelerations(twist[:3], inertial, found[len(field.pose.directions) :])
    rotations = minimal.link_frames(tree, motion.joint_angles)
    needed = minimal.inverse_dynamics(tree, rotations, motion.angular, motion.joint_rates, given)

    control, u = layout.control, np.array(u)
    if tree.planar:
        expected = [*u[control.base_force], 0.0, 0.0, 0.0, *u[control.base_torque]]
    else:
        expected = [*u[control.base_force], *u[control.base_torque]]
    joints = np.zeros(len(tree.links))
    joints[list(layout.actuated_joints)] = u[control.joint_torque]
    joints -= 3.0 * (np.array(motion.joint_angles) - 0.2) + 0.7 * np.array(motion.joint_rates)
    tip = field.tip_forces(motion, rotations, tree.tip_wrench)
    expected = np.add([*expected, *joints], [*tip.force, *tip.torque, *tip.joints])
    actual = np.array([*needed.force, *needed.torque, *needed.joints])
    if tree.planar:  # what holds the base in its plane
        actual[2:5] = 0.0
    np.testing.assert_allclose(actual, expected, rtol=0, atol=2e-12)


def test_a_wrench_at_the_tip_replaces_the_scenes() -> None:
    field, loaded = (field_of(load_scene(name)) for name in ("paper", "tip-load"))
    y, u = drawn(field)
    wrench = loaded.tree.tip_wrench
    assert wrench is not None
    np.testing.assert_allclose(field.accelerations(y, u, wrench), loaded.accelerations(y, u), rtol=1e-12)
    rotations = minimal.link_frames(field.tree, field.motion(y).joint_angles)
    idle = field.tip_forces(field.motion(y), rotations, None)
    assert not any([*idle.force, *idle.torque, *idle.joints])
    assert len(idle.joints) == len(idle.reactions) == len(field.tree.links)


def test_a_missing_actuator_pushes_nothing() -> None:
    scene = load_scene("paper")
    bare = scene.replace(actuators=Actuators(joint_torque=JointLimit(limit=1.0)))
    field = field_of(bare)
    inputs = field.inputs([1.0, 2.0, 3.0])
    assert (tuple(inputs.force), tuple(inputs.torque)) == ((0.0,) * 3, (0.0,) * 3)
    assert list(inputs.joint_torques) == [1.0, 2.0, 3.0]
    assert list(inputs.wrist_rates) == [0.0, 0.0, 0.0]
    full = field_of(scene).inputs([float(i) for i in range(12)])
    assert list(full.force) == [0.0, 1.0, 2.0]
    assert list(full.torque) == [3.0, 4.0, 5.0]
    assert list(full.joint_torques) == [6.0, 7.0, 8.0]
    assert list(full.wrist_rates) == [9.0, 10.0, 11.0]


def values(expressions: Any, names: Any, numbers: list[float]) -> list[np.ndarray]:
    return [np.array(value) for value in casadi.Function("f", [names], expressions).call([numbers])]


@pytest.mark.parametrize("name", ["planar", "tip-load"])
def test_derivatives_are_those_of_the_rates(name: str) -> None:
    field = field_of(sprung(name))
    n_y, n_u = field.n_y, field.n_u
    y, u = drawn(field, 1)
    weights = np.random.default_rng(2).normal(size=n_y).tolist()
    z = casadi.SX.sym("z", n_y + n_u)
    entries = casadi.vertsplit(z)
    rates = casadi.vertcat(*field.rates(entries[:n_y], entries[n_y:]))
    exact = [rates, casadi.jacobian(rates, z)]
    exact.append(casadi.jacobian(casadi.gradient(casadi.dot(casadi.DM(weights), rates), z), z))
    expected = values(exact, z, y + u)

    given, by_y, by_u = field.linearized_rates(entries[:n_y], entries[n_y:])
    arguments = entries[:n_y], entries[n_y:], given, by_y, by_u
    found = [casadi.vertcat(*given), casadi.horzcat(by_y, by_u)]
    found.append(field.rates_hessian(*arguments, weights))
    for actual, wanted in zip(values(found, z, y + u), expected, strict=True):
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=8e-15 * max(1.0, np.abs(wanted).max()))


@pytest.mark.parametrize("name", ["planar", "tip-load"])
def test_momentum_changes_by_the_external_wrench_alone(name: str) -> None:
    """Along the motion, seen from axes that do not turn: p' = f, L' = tau about the center of mass."""
    field = field_of(sprung(name))
    balance = field.momentum_balance
    y, u = drawn(field, 3)
    z = casadi.SX.sym("z", field.n_y)
    entries = casadi.vertsplit(z)
    linear_momentum, angular, center = balance.momentum(entries)
    rates = casadi.vertcat(*field.rates(entries, u))
    force, torque = balance.external_wrench(entries, u)
    omega = field.motion(entries).angular
    p, moment = casadi.vertcat(*linear_momentum), casadi.vertcat(*angular)
    spin, arm = casadi.vertcat(*omega), casadi.vertcat(*center)
    f, tau = casadi.vertcat(*force), casadi.vertcat(*torque)
    changes = [casadi.jtimes(part, z, rates) + casadi.cross(spin, part) for part in (p, moment)]
    wanted = [f, tau - casadi.cross(arm, f)]
    found = values([*changes, *wanted], z, y)
    free = [0, 1] if field.tree.planar else [0, 1, 2]
    turning = [2] if field.tree.planar else [0, 1, 2]
    np.testing.assert_allclose(found[0][free], found[2][free], rtol=0, atol=5e-14)
    np.testing.assert_allclose(found[1][turning], found[3][turning], rtol=0, atol=2e-13)
    twist = casadi.vertcat(*balance.base_twist(entries, linear_momentum, angular))
    motion = field.motion(y)
    (given_twist,) = values([twist], z, y)
    np.testing.assert_allclose(given_twist.ravel(), [*motion.angular, *motion.linear], rtol=0, atol=5e-15)
    assert balance.mass == pytest.approx(sum(b.mass for b in bodies(field.tree)))


def bodies(tree: KinematicTree) -> list[Any]:
    return tree.bodies


@pytest.mark.parametrize("n", [1, 2, 5])
def test_factorizations_solve(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    definite, right = root @ root.T + np.eye(n), rng.normal(size=n)
    scaled = np.eye(n) + definite @ np.diag(rng.uniform(0.0, 2.0, n))
    by_ldl = linear.solve_ldl(linear.factorize_ldl(definite.tolist()), right.tolist())
    np.testing.assert_allclose(by_ldl, np.linalg.solve(definite, right), rtol=3e-15)
    by_lu = linear.solve_lu(linear.factorize_lu(scaled.tolist()), right.tolist())
    np.testing.assert_allclose(by_lu, np.linalg.solve(scaled, right), rtol=2e-15)


@pytest.mark.parametrize("name", ["paper", "planar"])
def test_a_pose_moves_by_the_exponential_and_stays_a_unit(name: str) -> None:
    """Also where it was off a unit dual quaternion by a rounding."""
    field = field_of(load_scene(name))
    rng, coordinates = np.random.default_rng(7), field.pose
    increment = np.zeros(6)
    increment[list(coordinates.directions)] = rng.normal(size=len(coordinates.directions))
    pose = field.layout.initial_state[field.layout.state.pose].tolist()
    expected = dq.multiply(coordinates.full(pose), screw.exponential(increment.tolist()))
    np.testing.assert_allclose(
        coordinates.moved(pose, increment), coordinates.reduced(expected), rtol=0, atol=1e-14
    )
    off = coordinates.moved([entry * (1.0 + 1e-7) for entry in pose], increment)
    np.testing.assert_allclose(off, coordinates.reduced(expected), rtol=0, atol=1e-6)
    unit = dq.multiply(dq.conjugate(coordinates.full(off)), coordinates.full(off))
    np.testing.assert_allclose(unit, [1.0, *[0.0] * 7], rtol=0, atol=1e-13)


def test_a_wrench_on_a_base_alone() -> None:
    bare: Any = {
        "links": [],
        "wrist": None,
        "initial_state": InitialState(),
        "spread": Spread(),
        "tip": Pose(),
    }
    actuators = {"joint_torque": None, "wrist_rate": None}
    wrench = {"force": [3.0, 0.0, -6.0]}
    scene = load_scene("paper").replace(**bare, actuators=actuators, tip_wrench=wrench)
    field = field_of(scene)
    found = field.accelerations([*field.layout.initial_state], [0.0] * 6)
    np.testing.assert_allclose(
        found, np.array([0, 0, 0, 3, 0, -6]) / [1, 1, 1, *[scene.base.mass] * 3], rtol=1e-14
    )
