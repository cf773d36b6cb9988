"""SAC with demonstrations: flown again by the agent's own actions, mixed into batches, and resumed."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

import torch

from agents import ExportedPolicy
from agents.configuration import load_configuration
from agents.reinforcement.checkpoint import Progress, read_checkpoint, write_checkpoint
from agents.reinforcement.reinforcement_training import make_environment, make_learner
from agents.reinforcement.sac import DemonstrationBuffer
from agents.reinforcement.training_environment import native_environment
from agents.reinforcement.warm_start import fly_again
from agents.run_folder import RunFolder
from agents.training import train
from agents.zoo.finding import read_policy
from experts.demonstrations import DemonstrationsError

pytestmark = pytest.mark.agents

COPIES, REPEAT, DECISIONS = 2, 2, 75  # of 150 steps
BATCH, SHARE = 32, 0.25


def configuration(demonstrations, small_file, total_steps=1200, cloning_weight=0.5, **practice):
    source = {"folder": str(demonstrations.path)}
    sizes = {"batch_size": BATCH, "learning_starts": 40, "buffer_size": 1000}
    return load_configuration(
        {
            "name": "demonstrated",
            "scene": str(small_file),
            "environment": {"copies": COPIES, "action_repeat": REPEAT, "reward_scale": 0.01, **practice},
            "network": {"hidden": [32, 32], "activation": "relu"},
            "algorithm": {
                "name": "SAC",
                "layer_norm": True,
                **sizes,
                "demonstrations": {"source": source, "share": SHARE, "cloning_weight": cloning_weight},
            },
            "schedule": {"total_steps": total_steps, "evaluation_episodes": 4, "checkpoint_every": 600},
        }
    )


@pytest.fixture(scope="module")
def flown(demonstrations, small_scene, small_file):
    """All demonstrations, flown again."""
    return fly_again(demonstrations, configuration(demonstrations, small_file), small_scene)


@pytest.fixture(scope="module")
def trained(demonstrations, small_file, tmp_path_factory):
    return train(configuration(demonstrations, small_file), tmp_path_factory.mktemp("run"))


def test_demonstrations_report_their_progress(demonstrations, small_file, tmp_path, monkeypatch):
    def prepare(*given, progress):
        progress("they are made")
        raise DemonstrationsError("enough")

    monkeypatch.setattr("agents.reinforcement.reinforcement_training.prepare_demonstrations", prepare)
    reports = []
    with pytest.raises(DemonstrationsError, match="enough"):
        train(configuration(demonstrations, small_file), tmp_path, report=reports.append)
    assert reports == ["they are made"]


def test_a_demonstration_is_flown_again_to_its_own_target(drawn, small_file):
    settings = configuration(drawn, small_file, action_repeat=1)
    flown = fly_again(drawn, settings, drawn.scene)
    returns = flown.rewards.reshape(len(drawn), -1).sum(axis=1, dtype=np.float64) / 0.01
    np.testing.assert_allclose(returns, -drawn.column("cost"), rtol=1e-5)


def test_a_demonstration_flown_again_is_what_the_environment_does(demonstrations, small_scene, small_file):
    settings = configuration(demonstrations, small_file)
    flown = fly_again(demonstrations[:4], settings, small_scene)
    assert len(flown.actions) == 4 * DECISIONS
    np.testing.assert_array_equal(np.flatnonzero(flown.done) % DECISIONS, DECISIONS - 1)
    # The same actions in the agent's environment, one flight after the other.
    alone = native_environment(settings, small_scene, 1)
    for flight in range(4):
        alone.set_options({"initial_state": demonstrations[flight].states[0]})
        observation = alone.reset()
        for row in range(flight * DECISIONS, (flight + 1) * DECISIONS):
            np.testing.assert_array_equal(flown.observations[row], observation[0])
            observation, reward, done, infos = alone.step(flown.actions[row : row + 1])
            assert flown.rewards[row] == reward[0]
            assert flown.done[row] == done[0]
            after = infos[0]["terminal_observation"] if done[0] else observation[0]
            np.testing.assert_array_equal(flown.next_observations[row], after)
        assert infos[0]["is_success"]
        # Held for two steps, it costs little more than the optimum.
        assert demonstrations[flight].cost < -infos[0]["episode"]["r"] < 1.1 * demonstrations[flight].cost


def test_actions_too_small_to_succeed_are_named(demonstrations, small_scene, small_file):
    weak = {"base_torque": 0.001, "joint_torque": 0.001, "base_force": 0.001}
    settings = configuration(demonstrations, small_file, action_scale=weak)
    with pytest.raises(DemonstrationsError, match=r"none of the 2 demonstrations .*raise environment"):
        fly_again(demonstrations[:2], settings, small_scene)


def test_batches_end_with_demonstrated_decisions(trained, flown):
    buffer = trained.model.replay_buffer
    assert buffer.demonstrated(BATCH) == SHARE * BATCH == 8
    batch = buffer.sample(BATCH)
    known = {row.tobytes() for row in flown.observations}
    shown = [row.tobytes() in known for row in batch.observations.numpy()]
    assert shown == [False] * 24 + [True] * 8
    assert batch.rewards.shape == batch.dones.shape == (BATCH, 1)


def test_networks_see_in_units_of_the_demonstrations(trained, flown):
    deviation = flown.observations.astype(np.float64).std(axis=0)
    policy = trained.model.policy
    for network in (policy.actor, policy.critic, policy.critic_target):
        scale = network.features_extractor.scale.numpy()
        varies = scale > 0.0
        assert varies.sum() > 8
        np.testing.assert_allclose(scale[varies], 1.0 / deviation[varies], rtol=1e-12)


def test_critics_are_layer_normalized_and_optimized(trained):
    critic = trained.model.critic
    norms = [module for module in critic.modules() if isinstance(module, torch.nn.LayerNorm)]
    assert len(norms) == 2 * 2  # critics, hidden layers
    assert all(np.abs(norm.weight.detach().numpy() - 1.0).max() > 1e-5 for norm in norms)
    assert len(list(critic.parameters())) == 2 * (3 * 2 + 2 * 2)


@pytest.mark.slow
def test_the_actor_is_drawn_to_what_was_demonstrated(demonstrations, small_file, flown, tmp_path):
    errors = []
    for weight in (0.0, 100.0):
        run = train(configuration(demonstrations, small_file, 2000, weight), tmp_path / str(weight))
        actions = run.model.predict(flown.observations, deterministic=True)[0]
        errors.append(np.mean((actions - flown.actions) ** 2))
    assert errors[1] < 0.8 * errors[0]


def test_saved_and_exported_policies_act_like_the_model(trained):
    policy = ExportedPolicy.load(trained.folder / "policy.npz")
    noise = np.random.default_rng(0).normal(0.0, 1.5, (50, policy.n_observation))
    unit = np.where(policy.scale > 0.0, 1.0 / np.maximum(policy.scale, 1e-9), 0.0)
    observations = (policy.mean + unit * noise).astype(np.float32)
    expected = trained.model.predict(observations, deterministic=True)[0]
    assert np.ptp(expected, axis=0).min() > 0.0
    np.testing.assert_allclose(policy(observations), expected, rtol=0.0, atol=1e-6)
    loaded = read_policy(trained.folder / "model.zip")
    np.testing.assert_allclose(loaded(observations), expected, rtol=0.0, atol=1e-6)


def test_a_run_resumes_with_both_buffers(trained, demonstrations, small_scene, small_file):
    settings = configuration(demonstrations, small_file)
    checkpoint = RunFolder(trained.folder, settings).checkpoint()
    environment = make_environment(settings, small_scene)
    model = make_learner(settings, environment, blank=True)
    progress = read_checkpoint(checkpoint, model)
    before, after = trained.model.replay_buffer, model.replay_buffer
    assert isinstance(after, DemonstrationBuffer)
    assert after.pos == before.pos > 0
    np.testing.assert_array_equal(after.actions, before.actions)
    np.random.seed(0)  # noqa: NPY002
    first = before.sample(BATCH)
    np.random.seed(0)  # noqa: NPY002
    for one, other in zip(first, after.sample(BATCH), strict=True):
        assert one is other is None or torch.equal(one, other)
    assert progress.expert_solves == len(demonstrations)
    assert trained.policy.metadata["training"]["expert_solves"] == len(demonstrations)
    more = train(configuration(demonstrations, small_file, total_steps=1800), trained.folder)
    assert more.model.num_timesteps * REPEAT == 1800
    assert isinstance(more.model.replay_buffer, DemonstrationBuffer)


def test_demonstrations_larger_than_the_buffer_are_resumed(demonstrations, small_scene, small_file, tmp_path):
    settings = configuration(demonstrations, small_file)
    environment = make_environment(settings, small_scene)
    model, again = (make_learner(settings, environment, blank=True) for _ in range(2))
    model._last_obs, model._last_episode_starts = environment.reset(), np.ones(COPIES, dtype=bool)
    n_obs, n_u = environment.observation_space.shape[0], environment.action_space.shape[0]
    sizes = n_obs, n_u, n_obs, 1, 1
    model.replay_buffer._demonstrated = tuple(np.zeros((160_000, n), dtype=np.float32) for n in sizes)
    write_checkpoint(tmp_path, model, Progress(1200))
    assert read_checkpoint(tmp_path, again) == Progress(1200)
    assert [column.shape[1] for column in again.replay_buffer._demonstrated] == [*sizes]
