"""Pictures through Gymnasium's interfaces: single and vector environments, wrappers, closing, pickling."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmGoalEnv, DQSpaceArmVectorEnv, load_scene

SIZE = {"width": 80, "height": 60}


def pictures_of(environment, steps=2):
    environment.reset(seed=0)
    pictures = [environment.render()]
    for _ in range(steps):
        environment.step(np.zeros(12))
        pictures.append(environment.render())
    return pictures


def test_size_and_camera_reach_the_picture():
    plain = pictures_of(DQSpaceArmEnv(render_mode="rgb_array", **SIZE), 0)[0]
    config = {"azimuth": 120, "lookat": [0, -3, 4]}
    env = DQSpaceArmEnv(render_mode="rgb_array", default_camera_config=config, **SIZE)
    turned = pictures_of(env, 0)[0]
    assert plain.shape == turned.shape == (60, 80, 3)
    assert plain.dtype == np.uint8
    assert (plain != turned).any()
    np.testing.assert_array_equal(pictures_of(pickle.loads(pickle.dumps(env)), 0)[0], turned)
    goal = DQSpaceArmGoalEnv("paper", render_mode="rgb_array", default_camera_config=config, **SIZE)
    np.testing.assert_array_equal(pictures_of(goal, 0)[0], turned)


def test_closing_twice_and_drawing_afterwards_are_harmless():
    env = DQSpaceArmEnv(render_mode="rgb_array", **SIZE)
    start, before = pictures_of(env, 1)
    assert (start != before).any(), "nothing moves"
    env.close()
    env.close()
    np.testing.assert_array_equal(env.render(), before)


@pytest.mark.parametrize("environment", ["single", "vector"])
def test_no_picture_before_the_first_reset_or_without_a_render_mode(environment):
    make = DQSpaceArmEnv if environment == "single" else DQSpaceArmVectorEnv
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before render\(\)"):
        make(render_mode="rgb_array").render()
    blind = make()
    blind.reset()
    with pytest.warns(UserWarning, match="does nothing without a render mode"):
        assert blind.render() is None


# Vector environment ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_pictures_of_copies_are_those_of_single_environments(mode):
    scene = load_scene("random-target").replace(simulation={"dt": 0.015, "steps": 4})
    arguments = {"render_mode": "rgb_array", **SIZE}
    native = gymnasium.make_vec("DQSpaceArm-v0", num_envs=2, scene=scene, autoreset_mode=mode, **arguments)
    sync = SyncVectorEnv([lambda: DQSpaceArmEnv(scene, **arguments)] * 2, autoreset_mode=mode)
    native.reset(seed=3)
    sync.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(7):
        actions = rng.uniform(-1.0, 1.0, (2, 12)).astype(np.float32)
        native.step(actions)
        sync.step(actions)
        np.testing.assert_array_equal(native.render(), sync.render())
    assert native.metadata["render_modes"] == ["rgb_array"]
    assert native.metadata["render_fps"] == sync.metadata["render_fps"] == 67
    native.close()


def test_copies_that_a_mask_resets_lose_their_trails():
    venv = DQSpaceArmVectorEnv(2, "paper", AutoresetMode.DISABLED, "rgb_array", **SIZE)
    venv.reset(seed=0)
    for _ in range(3):
        venv.step(np.ones((2, 12)))
    assert len(venv._trails.of(0)) == len(venv._trails.of(1)) == 4
    venv.reset(options={"reset_mask": np.array([True, False])})
    assert len(venv._trails.of(0)) == 1
    assert len(venv._trails.of(1)) == 4
    for _ in range(3):
        venv.set_state(venv.get_state([0]), [0])
    assert [len(venv._trails.of(row)) for row in (0, 1)] == [1, 4]
