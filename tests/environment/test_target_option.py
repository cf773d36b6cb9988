"""The option `target` of `reset`: episodes with a given target, of one copy and of many, and in pictures."""

import gymnasium
import numpy as np
import pytest
from short_scenes import short

from dq_space_arm_env import DQSpaceArmVectorEnv, load_scene
from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.scene import Spread


def make(scene="random-target", **arguments):
    return gymnasium.make("DQSpaceArm-v0", scene=scene, **arguments).unwrapped


def pose(vector, position):
    return np.array(poses.from_rotation_and_position(rotations.exponential(vector), position))


PLANAR = load_scene("planar").replace(spread=Spread(target_position=0.1))
TARGET = pose((0.3, -1.0, 0.5), (0.5, -3.0, 4.8))


@pytest.mark.parametrize("spread", [{"target_position": 0.1}, {"target_rotation": 0.1, "link_masses": 0.2}])
@pytest.mark.parametrize("options", [{}, {"nominal": True}])
def test_an_episode_is_that_of_a_scene_with_this_target(options, spread):
    """Also its rotation where only its position is drawn, and the other way round."""
    env = make(load_scene("paper").replace(spread={"joint_angles": 0.2} | spread))
    env.reset(seed=1, options=options | {"target": TARGET})
    scene = env.episode_scene
    np.testing.assert_allclose(scene.target.pose.dual_quaternion, TARGET, rtol=0, atol=1e-15)
    twin = make(scene)
    twin.reset(options={"initial_state": env.state})
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1, 1, 12)
        actual, expected = env.step(action), twin.step(action)
        np.testing.assert_allclose(actual[0], expected[0], rtol=1e-12, atol=1e-12)
        assert actual[1] == pytest.approx(expected[1], rel=1e-11)
        assert actual[4] == pytest.approx(expected[4], rel=1e-10)


def test_only_the_target_is_given_and_only_for_one_episode():
    env, twin = make(), make()
    env.reset(seed=2, options={"target": TARGET})
    twin.reset(seed=2)
    np.testing.assert_allclose(env.target, TARGET, rtol=0, atol=1e-15)
    assert np.abs(twin.target - TARGET).max() > 0.1
    np.testing.assert_array_equal(np.abs(env.state), np.abs(twin.state))  # but for the sign of the pose
    env.reset()
    twin.reset()
    np.testing.assert_array_equal(env.target, twin.target)
    assert env.episode_scene == twin.episode_scene


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_the_tip_has_the_sign_of_the_target(precision):
    env = make(short("random-target", precision=precision))
    for sign in (1.0, -1.0):
        for options in ({}, {"nominal": True}):
            observation, _ = env.reset(seed=0, options=options | {"target": sign * TARGET})
            np.testing.assert_allclose(env.target, sign * TARGET, rtol=1e-6)
            assert env.kernels.tip_pose(env.state)[:4] @ env.target[:4] > 0.0
            assert observation[0] > 0.0


@pytest.mark.parametrize("rows", ["one", "each"])
@pytest.mark.parametrize("started", [False, True])
def test_copies_are_single_environments_with_the_same_targets(rows, started):
    copies = 5
    venv, singles = DQSpaceArmVectorEnv(copies, "random-target"), [make() for _ in range(copies)]
    rng = np.random.default_rng(0)
    vectors, positions = rng.uniform(-3, 3, (copies, 3)), rng.uniform(-5, 5, (copies, 3))
    targets = np.array([pose(*pair) for pair in zip(vectors, positions, strict=True)])
    options = {"target": targets if rows == "each" else targets[0]}
    if started:
        options["initial_state"] = venv.kernels.layout.initial_state
    seen, info = venv.reset(seed=3, options=options)
    for i, env in enumerate(singles):
        target = targets[i] if rows == "each" else targets[0]
        observation, single_info = env.reset(seed=3 + i, options=options | {"target": target})
        np.testing.assert_array_equal(seen[i], observation)
        np.testing.assert_array_equal(venv.states[i], env.state)
        np.testing.assert_array_equal(venv.parameters[i], env.parameters)
        assert single_info["position_error"] == info["position_error"][i]
    mask = np.arange(copies) == 1
    seen, _ = venv.reset(options={"target": targets, "reset_mask": mask})
    np.testing.assert_array_equal(seen[1], singles[1].reset(options={"target": targets[1]})[0])
    actions = rng.uniform(-1, 1, (copies, 12))
    seen, rewards, *_ = venv.step(actions)
    for i, env in enumerate(singles):
        observation, reward, *_ = env.step(actions[i])
        np.testing.assert_array_equal(seen[i], observation)
        assert rewards[i] == reward


@pytest.mark.parametrize(
    ("scene", "target", "message"),
    [
        ("paper", TARGET, "has the same in every episode.*give the scene a spread of target_pos"),
        ("random-target", TARGET[:7], r"shape \(7,\), should be finite numbers of shape \(8,\)"),
        (
            "random-target",
            pose((0.3, -1.0, 0.5), (0.0, 1e6, 0.0)),
            r"target is 1e\+06 m from the origin, should be at most 500000 m",
        ),
        ("random-target", 1.1 * TARGET, r"target is a pose with \|q_r\| = 1\.1"),
        (PLANAR, TARGET, r"leaves the plane, its entries \[1, 2, 4, 7\] should be 0"),
    ],
)
def test_bad_targets_are_refused(scene, target, message):
    env = make(scene)
    with pytest.raises(ValueError, match=message):
        env.reset(options={"target": target})


@pytest.mark.parametrize("rows", [2, 4])
def test_too_few_or_too_many_rows_are_refused_with_the_shapes_that_fit(rows):
    venv = gymnasium.make_vec("DQSpaceArm-v0", num_envs=3, scene="random-target")
    message = rf"target of shape \({rows}, 8\), should be \(8,\) for all, or \(3, 8\) with a row for each"
    with pytest.raises(ValueError, match=message):
        venv.reset(options={"target": np.tile(TARGET, (rows, 1))})
