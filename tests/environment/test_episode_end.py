"""The end of an episode that diverges: no success, the rest is charged, nothing counts after it."""

import numpy as np
import pytest
from short_scenes import short

from dq_space_arm_env import DQSpaceArmEnv, Scene, compile_scene
from dq_space_arm_env.environment.rollouts import rollout
from dq_space_arm_env.task.step_report import cost_names

STEPS = 25


@pytest.fixture(scope="module")
def scene() -> Scene:
    return short("planar", STEPS)


@pytest.fixture(scope="module")
def at_target(scene: Scene) -> Scene:
    """With the target where the tip is at the start."""
    kernels = compile_scene(scene)
    pose = kernels.tip_pose(kernels.layout.initial_state)
    return scene.replace(target={"pose": {"dual_quaternion": pose.tolist()}})


def racing(scene: Scene) -> np.ndarray:
    """The nominal start, with joints so fast that the first steps diverge."""
    layout = compile_scene(scene).layout
    state = layout.initial_state.copy()
    state[layout.state.joint_rates] = 1e5
    return state


def test_the_time_left_and_the_error_fit_their_space(scene: Scene) -> None:
    env = DQSpaceArmEnv(scene)
    space, duration = env.observation_space, STEPS * scene.simulation.dt
    assert space.low[-1] == 0.0
    assert duration <= space.high[-1] <= 1.001 * duration
    np.testing.assert_array_equal(space.low[:-1], -space.high[:-1])
    assert ((space.high[:2] > 1.0) & (space.high[:2] < 1.001)).all()
    observation, _ = env.reset(seed=0)
    while True:
        assert space.contains(observation)
        observation, _, terminated, truncated, _ = env.step(np.ones(6))
        assert truncated is False
        if terminated:
            break
    assert observation[-1] == 0.0


def test_an_episode_that_diverges_at_the_target_is_no_success(at_target: Scene) -> None:
    env = DQSpaceArmEnv(at_target)
    _, info = env.reset(options={"initial_state": racing(at_target)})
    assert info["is_success"]
    for _ in range(STEPS):
        _, _, terminated, _, info = env.step(np.zeros(6))
        if terminated:
            break
    assert info["diverged"]
    assert info["position_error"] == pytest.approx(0.0, abs=1e-9)
    assert not info["is_success"]


def test_more_than_every_step_that_is_left_is_charged_after_a_divergence(scene: Scene) -> None:
    env = DQSpaceArmEnv(scene)
    env.reset(options={"initial_state": racing(scene)})
    step, terminated = -1, False
    while not terminated:
        observation, reward, terminated, _, info = env.step(np.full(6, 0.5))
        step += 1
    assert info["diverged"]
    assert observation[-1] == pytest.approx((STEPS - step - 1) * scene.simulation.dt)
    stage = sum(info[name] for name in cost_names(scene)[:3])
    terminal = sum(info[name] for name in cost_names(scene)[3:])
    assert reward < -(STEPS - step) * stage - terminal


def test_nothing_is_counted_after_the_end_of_an_episode(scene: Scene) -> None:
    """What diverges begins anew and flies along: neither steps nor costs of that count."""
    starts = [racing(scene), compile_scene(scene).layout.initial_state]
    both = rollout(lambda seen: np.full((len(seen), 6), 0.5), scene, starts=starts)
    alone = rollout(lambda seen: np.full((len(seen), 6), 0.5), scene, starts=starts[:1])
    assert both.length.tolist() == [alone.length[0], STEPS]
    assert alone.length[0] < STEPS
    for name in cost_names(scene):
        assert both.cost_terms[name][0] == alone.cost_terms[name][0]
    assert both.base_turn[0] == alone.base_turn[0]
    np.testing.assert_array_equal(both.rewards[0], alone.rewards[0])
