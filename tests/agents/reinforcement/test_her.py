"""Stable-Baselines3's hindsight experience replay on `DQSpaceArmGoal-v0`: rewards, and learning."""

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import SAC, HerReplayBuffer

from agents.vec_env import SB3VecEnv
from dq_space_arm_env import Scene, load_scene

pytestmark = pytest.mark.agents


def make(scene, **arguments):
    return gymnasium.make("DQSpaceArmGoal-v0", scene=scene, **arguments)


def make_many(copies, scene, **arguments):
    mode = AutoresetMode.SAME_STEP
    return SB3VecEnv(
        gymnasium.make_vec("DQSpaceArmGoal-v0", copies, scene=scene, autoreset_mode=mode, **arguments)
    )


def short(steps=20, **changes):
    scene = load_scene("random-target")
    simulation = scene.simulation.model_copy(update={"steps": steps})
    return scene.replace(simulation=simulation, **changes)


def agent(env, buffer=HerReplayBuffer, learning_starts=60, **arguments):
    """SAC with a small network."""
    arguments |= {"policy_kwargs": {"net_arch": [64, 64]}, "device": "cpu", "seed": 0}
    settings = {"replay_buffer_class": buffer, "learning_starts": learning_starts, **arguments}
    return SAC("MultiInputPolicy", env, **settings)


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.sampled
@pytest.mark.parametrize("copies", [3, None])
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_sampled_rewards_are_those_of_the_sampled_goals(reward_type, copies):
    """Tolerances are so tight that relabelled goals, a few steps away, give both rewards."""
    scene = short(success={"attitude_error_deg": 0.5, "position_error": 0.005})
    env = make(scene, reward_type=reward_type)
    venv = env if copies is None else make_many(copies, scene, reward_type=reward_type)
    model = agent(venv, train_freq=10, gradient_steps=2)
    model.learn(200)
    sample = model.replay_buffer.sample(256)
    achieved = sample.next_observations["achieved_goal"].numpy()
    desired = sample.next_observations["desired_goal"].numpy()
    np.testing.assert_array_equal(desired, sample.observations["desired_goal"].numpy())
    rewards = sample.rewards.numpy().ravel()
    expected = env.unwrapped.compute_reward(achieved, desired, {})
    np.testing.assert_allclose(rewards, expected, rtol=1e-6)  # some of goals in double precision
    episodes = np.unique(model.replay_buffer.observations["desired_goal"].reshape(-1, 8), axis=0)
    relabelled = ~(desired[:, None] == episodes).all(axis=2).any(axis=1)
    assert 0.7 < relabelled.mean() < 0.9  # four fifths, the buffer's default
    if reward_type == "sparse":
        overlap = np.abs(np.sum(achieved[:, :4] * desired[:, :4], axis=1))  # cosine of half the angle
        assert (overlap[rewards == 0.0] > np.cos(np.radians(0.26))).all()
        assert 0.1 < (rewards[relabelled] == 0.0).mean() < 0.9
        assert (rewards[~relabelled] == -1.0).all()


def test_no_end_of_an_episode_is_an_end_of_the_task():
    """The values of last states are estimated, those of diverged ones too."""
    links = [link.model_dump() | {"stiffness": 1e4} for link in load_scene("random-target").links]
    simulation = {"dt": 0.1, "steps": 20, "integrator": "symplectic_euler"}
    model = agent(make(short().replace(links=links, simulation=simulation)))
    buffer = model.replay_buffer
    model.learn(60)
    stored = slice(0, buffer.pos)
    assert buffer.dones[stored].sum() > 3  # episodes of less than twenty steps
    np.testing.assert_array_equal(buffer.dones[stored], buffer.timeouts[stored])
    assert (buffer.rewards[stored][buffer.dones[stored] == 1] == -20.0).all()
    assert not buffer.sample(64).dones.any()


# Nothing but a wrist on a free base: its Euler rates are to turn the tip to within 15 degrees of a goal that
# is up to 1 rad away about each axis, in 2.5 s.
TURNING_TIP = Scene.model_validate(
    {
        "name": "turning tip",
        "base": {"mass": 100, "inertia": [10, 10, 10]},
        "wrist": {"frame": {"position": [0, 0, 0.5]}},
        "actuators": {"wrist_rate": {"limit": 1.0}},
        "target": {"pose": {"position": [0, 0, 0.5]}},
        "spread": {"target_rotation": 1.0},
        "success": {"attitude_error_deg": 15},
        "simulation": {"dt": 0.25, "steps": 10},
    }
)


def success_rate(model, episodes=100):
    env, successes = make(TURNING_TIP), 0
    for seed in range(episodes):
        observation, _ = env.reset(seed=10_000 + seed)
        truncated = False
        while not truncated:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, _, truncated, info = env.step(action)
        successes += info["is_success"]
    return successes / episodes


@pytest.mark.endurance
@pytest.mark.parametrize("environment", [make(TURNING_TIP), make_many(4, TURNING_TIP)], ids=["one", "four"])
@pytest.mark.parametrize(
    ("buffer", "least", "most"), [(HerReplayBuffer, 0.8, 1.0), (None, 0.0, 0.2)], ids=["hindsight", "without"]
)
def test_sparse_rewards_are_learned_from_with_hindsight_only(environment, buffer, least, most):
    arguments = {"learning_starts": 200, "gamma": 0.9, "learning_rate": 3e-3, "batch_size": 128}
    # As many updates as decisions.
    model = agent(environment, buffer, gradient_steps=-1, **arguments)
    assert success_rate(model) < 0.1
    model.learn(1600)
    assert least <= success_rate(model) <= most
