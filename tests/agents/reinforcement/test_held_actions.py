"""Actions that are held for some steps, and what learners are rewarded with meanwhile."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from agents import DQSpaceArmVecEnv
from agents.reinforcement.held_actions import HeldActions
from dq_space_arm_env import load_scene

pytestmark = pytest.mark.agents

PAPER = load_scene("paper")
EIGHT_STEPS = PAPER.replace(simulation={"dt": 0.015, "steps": 8})
STILL = np.zeros((2, 12), dtype=np.float32)


def hold(scene=EIGHT_STEPS, **settings):
    """Two copies whose decisions are held for four steps, begun."""
    scale = np.ones(12, dtype=np.float32)
    env = HeldActions(DQSpaceArmVecEnv(2, scene, seed=1), repeat=4, action_scale=scale, **settings)
    env.reset()
    return env


def test_held_actions_add_rewards_up_and_end_with_the_episode():
    scene = PAPER.replace(simulation={"dt": 0.015, "steps": 10})
    scale = np.full(12, 0.5, dtype=np.float32)
    held = HeldActions(DQSpaceArmVecEnv(3, scene), repeat=4, action_scale=scale, reward_scale=0.1)
    plain = DQSpaceArmVecEnv(3, scene)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 12)).astype(np.float32)
    for env in (held, plain):
        env.seed(4)
        env.reset()
    np.testing.assert_array_equal(held.action_space.high, scale)
    for block in range(3):
        observation, reward, done, infos = held.step(actions)
        total = np.zeros(3)
        for step in range(4):
            expected, rewards, _, _ = plain.step(actions)
            if 4 * block + step < 10:  # what follows belongs to the next episode
                total += rewards
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_allclose(reward, 0.1 * total, rtol=1e-6)
        assert done.all() == (block == 2)
    assert all(info["episode"]["l"] == 10 for info in infos)


def test_a_power_of_the_cost_is_that_of_its_mean():
    rewards = [hold(cost_power=power).step(STILL)[1] for power in (1.0, 0.5)]
    np.testing.assert_allclose(rewards[1], -4.0 * np.sqrt(-rewards[0] / 4.0), rtol=1e-6)


def test_success_is_rewarded_once_at_the_end():
    """Everything is a success in one scene, nothing in the other."""
    rewards = []
    for degrees in (180.0, 1e-6):
        success = {"attitude_error_deg": degrees, "position_error": 100.0}
        env = hold(EIGHT_STEPS.replace(success=success), success_reward=0.5)
        rewards.append([env.step(STILL)[1] for _ in range(4)])
    expected = np.tile([[0.0], [0.5]], (2, 2))  # two episodes, each of two decisions
    np.testing.assert_allclose(np.subtract(*rewards), expected, rtol=0.0, atol=1e-6)


def test_errors_at_the_end_cost_the_more_the_larger_they_are_but_not_without_bound():
    rewards, infos = [], []
    for cost in (0.0, 2.0):
        env = hold(end_error_cost=cost, tolerances=(3.0, 0.1))
        steps = [env.step(STILL) for _ in range(2)]
        rewards.append([step[1] for step in steps])
        infos = steps[1][3]
    errors = [(info["attitude_error"] / 3.0) ** 2 + (info["position_error"] / 0.1) ** 2 for info in infos]
    charged = [2.0 * error / (1.0 + error) for error in errors]
    assert all(1.0 < cost < 2.0 for cost in charged)
    np.testing.assert_allclose(np.subtract(*rewards), [[0.0, 0.0], charged], rtol=1e-4)


def test_the_tips_velocity_at_the_end_costs_where_success_asks_for_it():
    env = hold(tolerances=(0.5, 0.01, None, 0.02), end_error_cost=1.0)
    info = {"attitude_error": 0.0, "position_error": 0.01, "velocity_error": 0.04, "is_success": False}
    assert env._final_reward(info) == pytest.approx(-5.0 / 6.0)
