"""The constants of a tree, and the paper's redundant state against the minimal one, in plain numbers."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.paper_field import PaperField
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import split_state
from dq_space_arm_env.kernels.programs.paper_programs import PaperPrograms
from dq_space_arm_env.scene.layout import StateLayout

SCENES = ("paper", "no-wrist", "planar", "tip-load", "sliding", "wheels")


def about(body: object, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, first moment, and inertia about a point, which add up."""
    mass, center = body.mass, np.array(body.center_of_mass, dtype=float)
    d = center - point
    inertia = np.array(body.inertia, dtype=float) + mass * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, mass * center, inertia


def test_masses_of_a_chain_are_those_of_the_scene() -> None:
    scene = load_scene("paper")
    tree = KinematicTree.from_scene(scene)
    for body, given, center in (
        (tree.base, scene.base, (0.0, 0.0, 0.0)),
        *(
            (link.body, given, given.center_of_mass)
            for link, given in zip(tree.links, scene.links, strict=True)
        ),
    ):
        assert body.mass == given.mass
        assert tuple(body.center_of_mass) == tuple(center)
        np.testing.assert_array_equal(body.inertia, given.inertia)
    assert tree.heaviest == np.argmax([scene.base.mass, *(link.mass for link in scene.links)])


def test_a_payload_and_its_link_add_up() -> None:
    scene = load_scene("payload")
    inertia = [[0.3, 0.01, 0.02], [0.01, 0.4, 0.03], [0.02, 0.03, 0.5]]
    payload = {**scene.payload.model_dump(), "inertia": inertia, "center_of_mass": [0.1, -0.2, 0.3]}
    tip = {"position": [0.4, 0.1, -0.1], "rotation": {"axis": [1, 2, 3], "angle": 50}}
    scene = scene.replace(payload=payload, tip=tip)
    held, bare = KinematicTree.from_scene(scene), KinematicTree.from_scene(scene.replace(payload=None))
    rotation = np.array(scene.tip.rotation_matrix)

    class Moved:
        mass = scene.payload.mass
        center_of_mass = np.array([0.4, 0.1, -0.1]) + rotation @ [0.1, -0.2, 0.3]
        inertia = rotation @ np.array([[0.3, 0.01, 0.02], [0.01, 0.4, 0.03], [0.02, 0.03, 0.5]]) @ rotation.T

    for point in np.eye(3):
        parts = [about(body, point) for body in (bare.links[-1].body, Moved)]
        for found, *expected in zip(about(held.links[-1].body, point), *parts, strict=True):
            np.testing.assert_allclose(found, sum(expected), rtol=0, atol=3e-13)


@pytest.mark.parametrize("name", SCENES)
def test_both_states_describe_the_same_motion(name: str) -> None:
    scene = load_scene(name)
    layout = StateLayout.of(scene)
    minimal = SpaceArmField(KinematicTree.from_scene(scene), layout)
    field = PaperField(minimal)
    rng = np.random.default_rng(0)
    x = layout.initial_state.copy()
    x[layout.state.pose.stop :] = rng.uniform(-1.0, 1.0, minimal.n_y)
    u = rng.normal(size=minimal.n_u).tolist()
    y = field.state_from_minimal(x.tolist())
    assert len(y) == field.n_y
    np.testing.assert_allclose(field.minimal_from_state(y), x, rtol=0, atol=2e-15)

    rates = field.rates(y, u)
    assert len(rates) == field.n_y
    bodies = slice(field.rate_indices[0], field.rate_indices[-1] + 1)
    _, rest = split_state(minimal, x.tolist())
    expected = minimal.accelerations(rest, u)
    np.testing.assert_allclose(field.free_accelerations(y, rates[bodies]), expected, rtol=0, atol=1e-13)
    assert [y[i] for i in field.base_twist] == list(minimal.motion(rest).angular) + list(
        minimal.motion(rest).linear
    )

    # The tip moves as the chain rule says.
    pose, motion = minimal.pose.full(x[layout.state.pose].tolist()), minimal.motion(rest)
    count, wrist = len(motion.joint_angles), len(motion.wrist_angles)
    z = casadi.SX.sym("z", 8 + count + wrist)
    parts = casadi.vertsplit(z)
    tip = casadi.vertcat(
        *kinematics.tip_pose(minimal.tree, parts[:8], parts[8 : 8 + count], parts[8 + count :])
    )
    moving = [
        *dq.derivative(pose, (*motion.angular, *motion.linear)),
        *minimal.rates(rest, u)[: count + wrist],
    ]
    along = casadi.Function("along", [z], [tip, casadi.jtimes(tip, z, casadi.DM(moving))])
    at, rate = along([*pose, *motion.joint_angles, *motion.wrist_angles])
    np.testing.assert_allclose(y[field.tip], np.array(at).ravel(), rtol=0, atol=2e-15)
    np.testing.assert_allclose(rates[field.tip], np.array(rate).ravel(), rtol=0, atol=7e-15)
    np.testing.assert_allclose(rates[: 8 + count + wrist], moving, rtol=0, atol=2e-15)


@pytest.mark.slow
def test_the_papers_form_has_rotors_and_refuses_what_it_has_no_rows_for() -> None:
    motor = {"inertia": 2e-4, "gear": -30.0, "friction": 0.2, "friction_speed": 0.3}
    scene = load_scene("no-wrist").replace({f"links.{i}.motor": motor for i in (0, 2)})
    layout = StateLayout.of(scene)
    minimal = SpaceArmField(KinematicTree.from_scene(scene), layout)
    field, rng = PaperField(minimal), np.random.default_rng(0)
    x, u = layout.initial_state.copy(), rng.normal(size=minimal.n_u)
    x[layout.state.pose.stop :] = rng.uniform(-1.0, 1.0, minimal.n_y)
    y = field.state_from_minimal(x.tolist())
    rates = field.rates(y, u.tolist())
    bodies = slice(field.rate_indices[0], field.rate_indices[-1] + 1)
    expected = minimal.accelerations(split_state(minimal, x.tolist())[1], u.tolist())
    np.testing.assert_allclose(field.free_accelerations(y, rates[bodies]), expected, rtol=0, atol=6e-14)
    symbols, inputs = casadi.SX.sym("y", field.n_y), casadi.SX.sym("u", field.n_u)
    found = field.linearized_rates(casadi.vertsplit(symbols), casadi.vertsplit(inputs))
    expected = casadi.vertcat(*field.rates(casadi.vertsplit(symbols), casadi.vertsplit(inputs)))
    jacobians = [*found[1:], casadi.jacobian(expected, symbols), casadi.jacobian(expected, inputs)]
    values = casadi.Function("values", [symbols, inputs], jacobians)(casadi.DM(list(y)), u)
    for own, other in zip(values[:2], values[2:], strict=True):
        np.testing.assert_allclose(np.array(own), np.array(other), rtol=0, atol=7e-14)
    for name in ("elastic-joints", "motors"):
        with pytest.raises(ValueError, match=f"and scene {name!r} has some"):
            PaperPrograms(load_scene(name))
