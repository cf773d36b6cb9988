"""PPO that begins with an exported policy: it acts like that one, and its critic may learn first."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from agents import ExportedPolicy
from agents.configuration import ConfigurationError, load_configuration
from agents.reinforcement.networks import export_policy
from agents.reinforcement.ppo import GROWTH
from agents.reinforcement.reinforcement_training import make_environment, make_learner
from agents.training import train
from agents.zoo.starting import spent_before
from dq_space_arm_env import load_scene

pytestmark = pytest.mark.agents

REPEAT, COPIES = 4, 4
N_OBSERVATION, N_ACTION, HIDDEN = 24, 12, (256, 256)
WARM_UP = 2
DECISIONS = 40  # of an update


@pytest.mark.parametrize("training", [None, "two hours", {"seconds": "long", "expert_solves": None}])
def test_what_a_policy_says_of_its_training_in_words_has_taken_nothing(training, tmp_path):
    plain = np.zeros((3, 2)), np.zeros(2), np.zeros(3)
    policy = ExportedPolicy(
        (plain[0],), (plain[1],), "tanh", plain[2], plain[2], metadata={"training": training}
    )
    policy.save(tmp_path / "policy.npz")
    assert spent_before(str(tmp_path)) == (0, 0.0)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A policy with gains as large as those of one that was cloned, and of its size."""
    rng = np.random.default_rng(3)
    sizes = (N_OBSERVATION, *HIDDEN, N_ACTION)
    weights = [rng.normal(0.0, n**-0.5, (n, m)) for n, m in pairwise(sizes)]
    deviation = np.r_[np.full(8, 0.05), np.full(6, 0.02), np.full(9, 0.5), 4.3]
    policy = ExportedPolicy(
        weights=tuple(weights),
        biases=tuple(rng.normal(0.0, 0.1, m) for m in sizes[1:]),
        activation="tanh",
        mean=np.r_[1.0, np.zeros(7), np.zeros(6), np.full(9, 0.5), 7.5],
        scale=np.r_[1.0 / deviation[:-2], 0.0, 1.0 / deviation[-1]],  # one entry is ignored
        metadata={"training": {"expert_solves": 7, "seconds": 1000.0}},
    )
    path = tmp_path_factory.mktemp("start") / "policy.npz"
    policy.save(path)
    return path


def configuration(start, scene_file, **changes):
    content = {
        "name": "from-clone",
        "scene": str(scene_file),
        "environment": {
            "copies": COPIES,
            "action_repeat": REPEAT,
            "action_scale": {"base_force": 0.001, "base_torque": 0.2},
            "success_reward": 0.5,
        },
        "network": {"hidden": list(HIDDEN), "activation": "tanh"},
        "start_from": str(start),
        "algorithm": {
            "name": "PPO",
            "n_steps": DECISIONS // COPIES,
            "batch_size": DECISIONS,
            "n_epochs": 2,
            "critic_warm_up": WARM_UP,
            "desired_kl": 0.01,
        },
        "schedule": {"total_steps": 4 * DECISIONS * REPEAT, "evaluation_episodes": 4},
    }
    return load_configuration(content | changes)


def seen_by(start):
    policy = ExportedPolicy.load(start)
    unit = np.where(policy.scale > 0.0, 1.0 / np.maximum(policy.scale, 1e-9), 1.0)
    noise = np.random.default_rng(0).normal(0.0, 1.0, (200, N_OBSERVATION))
    return (policy.mean + unit * noise).astype(np.float32)


def test_before_its_first_update_it_acts_like_the_policy_that_it_begins_with(start, scene_file):
    settings = configuration(start, scene_file)
    model = make_learner(settings, make_environment(settings, load_scene(scene_file)))
    observations, policy = seen_by(start), ExportedPolicy.load(start)
    expected = policy(observations)
    assert np.ptp(expected, axis=0).min() > 0.1
    actions = np.clip(model.predict(observations, deterministic=True)[0], -1.0, 1.0)
    # The policy's own arithmetic is in single precision.
    np.testing.assert_allclose(actions, expected, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(export_policy(model, {})(observations), expected, rtol=0.0, atol=1e-6)


def test_the_critic_learns_alone_before_the_actor_does(start, scene_file, tmp_path):
    settings = configuration(start, scene_file)
    observations = seen_by(start)
    expected = ExportedPolicy.load(start)(observations)
    changes, critics = [], []

    def compare(count):
        steps = count * DECISIONS * REPEAT
        schedule = {"total_steps": steps, "evaluation_episodes": 4}
        content = settings.model_dump(exclude_none=True) | {"schedule": schedule}
        run = train(content, tmp_path)
        critics.append(run.model.policy.value_net.weight.detach().numpy().copy())
        changes.append(np.abs(run.policy(observations) - expected).max())
        return run

    for count in (1, WARM_UP, WARM_UP + 1):  # each goes on where the last one ended
        run = compare(count)
    assert max(changes[:2]) < 1e-6 < 1e-4 < changes[2]
    assert np.abs(critics[1] - critics[0]).max() > 1e-4
    assert run.policy.metadata["training"]["expert_solves"] == 7
    assert run.policy.metadata["training"]["seconds"] > 1000.0
    curve = [json.loads(line) for line in (tmp_path / "evaluations.jsonl").read_text().splitlines()]
    assert all(line["seconds"] > 1000.0 for line in curve)


def test_steps_follow_the_divergence_that_they_cause(start, scene_file, tmp_path):
    """Asked for next to none, they become as small as they may; asked for much, they are the schedule's."""
    factors = []
    for desired, first, last in ((1e-9, 0.5, 0.5 / GROWTH**3), (1e6, 1.0, 1.0)):
        content = configuration(start, scene_file).model_dump(exclude_none=True)
        content["algorithm"] |= {"desired_kl": desired, "critic_warm_up": 0, "first_step_factor": first}
        run = train(content, tmp_path / str(first))
        factors.append(run.model.step_factor)
        actor, critic = run.model.policy.optimizer.param_groups
        assert critic["lr"] == content["algorithm"]["learning_rate"]
        assert actor["lr"] == pytest.approx(critic["lr"] * last, rel=1e-6)
    assert factors[0] == pytest.approx(0.5 / GROWTH**4)
    assert factors[1] == 1.0


def test_policies_that_do_not_fit_are_refused(start, scene_file, tmp_path):
    def refusal(**changes):
        settings = configuration(start, scene_file, **changes)
        with pytest.raises(ConfigurationError) as caught:
            make_learner(settings, make_environment(settings, load_scene(scene_file)))
        return str(caught.value)

    hidden = refusal(network={"hidden": [16, 16], "activation": "tanh"})
    assert "network.hidden is [256, 256] there and [16, 16] here" in hidden
    assert "network.activation is tanh there and relu here" in refusal(
        network={"hidden": list(HIDDEN), "activation": "relu"}
    )
    assert "dq-space-arm train cloning-with-gains" in refusal(start_from="nowhere/policy.npz")
    scaled = tmp_path / "scaled.npz"
    replace(ExportedPolicy.load(start), action_scale=np.full(N_ACTION, 0.05)).save(scaled)
    said = refusal(start_from=str(scaled))
    assert "action_scale is 0.05 there, where actions are clipped, and 1 here" in said
    with pytest.raises(ConfigurationError, match="is for PPO, not for SAC"):
        configuration(start, scene_file, algorithm={"name": "SAC"})
