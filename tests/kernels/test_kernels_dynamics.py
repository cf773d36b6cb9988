"""The compiled dynamics of every shipped robot against the paper's Newton-Euler system (13)-(22)."""

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import vectors
from dq_space_arm_env.dynamics import elastic_gears, kinematics, minimal, newton_euler, reaction_wheels
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.paper_joints import bodies_of
from dq_space_arm_env.dynamics.space_arm_field import SpaceArmField
from dq_space_arm_env.dynamics.vector_field import split_state
from scripts.benchmarks.robots import robots


def relative_error(actual, expected):
    return np.linalg.norm(np.asarray(actual) - expected) / max(np.linalg.norm(expected), 1e-300)


def paper_solution(kernels, x, u):
    """Dual accelerations of base and joints, and reaction wrenches, from the paper's system."""
    tree = KinematicTree.from_scene(kernels.scene)
    field = SpaceArmField(tree, kernels.layout)
    stored, y = split_state(field, x.tolist())
    motion, inputs = field.motion(y), field.inputs(u.tolist())
    link_frames = minimal.link_frames(tree, motion.joint_angles)
    twist = (*motion.angular, *motion.linear)
    velocities = kinematics.body_velocities(tree, link_frames, twist, motion.joint_rates)
    bodies = bodies_of(tree)
    duals = [
        (0.0, *v.angular, 0.0, *vectors.add(v.linear, vectors.cross(v.angular, body.center_of_mass)))
        for body, v in zip(tree.bodies, velocities, strict=True)
        if body.mass
    ]
    state = newton_euler.PaperState(field.pose.full(stored), motion.joint_angles, motion.wrist_angles, duals)
    wheels = tree.wheels, inputs.wheel_torques, motion.wheel_momenta, motion.angular
    torque = vectors.add(inputs.torque, reaction_wheels.torque_on_base(*wheels))
    base_wrench = (0.0, *inputs.force, 0.0, *torque)
    # Behind an elastic gear the motor turns its rotor alone, and the gear the link.
    moving = motion.joint_angles, motion.joint_rates, motion.motor_angles, motion.motor_rates
    torques = elastic_gears.transmitted_torques(tree, *moving)
    for joint, (link, torque) in enumerate(zip(tree.links, inputs.joint_torques, strict=True)):
        torques[joint] += torque if link.elastic is None else 0.0
    given = (base_wrench, torques, inputs.wrist_rates)
    rates, reactions = newton_euler.paper_rates(tree, state, *given)
    accelerations = [tuple(body) for body in np.reshape(rates[-8 * len(bodies) :], (-1, 8))]
    frames = newton_euler.joint_frames(tree, motion.joint_angles, motion.wrist_angles)
    joints = newton_euler.joint_accelerations(tree, frames, duals, accelerations)
    base = np.array([*accelerations[0][1:4], *accelerations[0][5:8]])
    return np.array([*base[list(field.pose.directions)], *joints]), np.array(reactions)


@pytest.mark.sampled
@pytest.mark.parametrize("scene", robots())
def test_minimal_coordinates_and_the_papers_system_agree_to_1e_12(scene, draw):
    kernels, states, inputs = draw(scene, 30)
    accelerations = kernels.forward_dynamics(states, inputs)
    wrenches = kernels.reaction_wrenches(states, inputs)
    for x, u, a, w in zip(states, inputs, accelerations, wrenches, strict=True):
        expected_a, expected_w = paper_solution(kernels, x, u)
        assert relative_error(a, expected_a) < 1e-12
        assert relative_error(w, expected_w) < 1e-12


def test_springs_and_dampers_agree_with_the_papers_system(draw):
    paper = load_scene("paper")
    links = [
        {**link.model_dump(), "stiffness": 3.0 + i, "rest_angle": 0.2, "damping": 0.7}
        for i, link in enumerate(paper.links)
    ]
    scene = paper.replace(links=links)
    kernels, states, inputs = draw(scene, 10)
    for x, u, a in zip(states, inputs, kernels.forward_dynamics(states, inputs), strict=True):
        assert relative_error(a, paper_solution(kernels, x, u)[0]) < 1e-12
    limp = paper.replace(links=[link.model_dump() for link in paper.links])
    assert not np.allclose(a, draw(limp, 1)[0].forward_dynamics(x, u))


def test_a_wrench_at_the_tip_given_to_the_call_replaces_the_scenes(draw):
    kernels, states, inputs = draw("tip-load", 5)
    wrench = kernels.scene.tip_wrench
    own = kernels.forward_dynamics(states, inputs)
    given = kernels.forward_dynamics(states, inputs, w_tip=[*wrench.force, *wrench.torque])
    np.testing.assert_allclose(given, own, rtol=1e-13, atol=1e-13)
    assert not np.allclose(kernels.forward_dynamics(states, inputs, w_tip=np.zeros(6)), own)


def test_base_pose_and_velocity_do_not_change_the_motion(draw):
    kernels, states, inputs = draw("paper", 10)
    moved = states.copy()
    moved[:, kernels.layout.state.pose] = states[::-1, kernels.layout.state.pose]
    found, expected = (kernels.forward_dynamics(x, inputs) for x in (moved, states))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("scene", robots())
def test_frame_poses_end_at_the_tip_27(scene, draw):
    kernels, states, _ = draw(scene, 10)
    frames, tips = kernels.frame_poses(states), kernels.tip_pose(states)
    scene = kernels.scene
    assert frames.shape == (10, 2 + len(scene.links) + len(scene.other_tips) + (scene.wrist is not None), 8)
    np.testing.assert_allclose(frames[:, -1], tips, rtol=0, atol=1e-13)


def test_cost_terms_follow_the_papers_formula(draw):
    kernels, states, inputs = draw("paper", 20)
    target = np.array([0.5, 0.5, -0.5, -0.5, 0.25, 2.25, 0.25, 2.25])
    effort = np.diag([10.0] * 3 + [1.0] * 3 + [0.01] * 3 + [0.1] * 3)
    tips = kernels.tip_pose(states)
    twists = states[:, kernels.layout.state.base_velocity]
    for x, u, q, w in zip(states, inputs, tips, twists, strict=True):
        gap = (q - target) @ (q - target)
        assert kernels.cost(x, u) == pytest.approx(15.0 * gap + w @ w + u @ effort @ u, rel=1e-13)
        assert kernels.terminal_cost(x) == pytest.approx(150.0 * gap + w @ w, rel=1e-13)


def test_start_of_the_paper_scene_is_where_the_design_says(draw):
    kernels, _, _ = draw("paper", 1)
    x = kernels.layout.initial_state
    _, (angle, distance) = kernels.observation(x, [0.0])
    assert np.degrees(angle) == pytest.approx(74.4, abs=0.05)
    assert distance == pytest.approx(1.330, abs=0.0005)
