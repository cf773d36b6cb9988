"""Configurations of agents: what ships is valid, what is wrong is named, nothing unknown is taken."""

import pytest

from agents.configuration import (
    Configuration,
    ConfigurationError,
    ImitationConfiguration,
    list_configurations,
    load_configuration,
)
from agents.evaluation.training_runs import agent_of, training_command
from agents.training import with_changes
from dq_space_arm_env import load_scene
from dq_space_arm_env.validation import dump_yaml

MINIMAL = {"name": "small", "algorithm": {"name": "PPO"}, "schedule": {"total_steps": 1000}}


def refusal(**changes):
    with pytest.raises(ConfigurationError) as error:
        load_configuration(MINIMAL | changes)
    return str(error.value)


@pytest.mark.parametrize("name", list_configurations())
def test_shipped_configurations_are_named_like_their_files_and_have_scenes(name):
    configuration = load_configuration(name)
    assert configuration.name == name
    assert configuration.description
    assert load_scene(configuration.scene)


def test_every_algorithm_ships():
    configurations = [load_configuration(name) for name in list_configurations()]
    names = {"APG", "PPO", "SAC", "TQC", "TD3", "cloning", "dagger", "act", "residual-PPO"}
    assert {each.algorithm.name for each in configurations} == names


def test_files_mappings_and_configurations_are_one(tmp_path):
    configuration = load_configuration(MINIMAL)
    assert isinstance(configuration, Configuration)
    assert load_configuration(configuration) == configuration
    path = tmp_path / "small.yaml"
    path.write_text(dump_yaml(MINIMAL))
    assert load_configuration(path) == load_configuration(str(path)) == configuration
    resolved = configuration.model_dump(mode="json", exclude_none=True)
    assert resolved["algorithm"]["clip_range"] == 0.2
    assert load_configuration(resolved) == configuration


@pytest.mark.parametrize("name", ["cloning", "residual", "sac-with-demonstrations"])
def test_each_run_draws_its_own_demonstrations(name):
    def source(configuration):
        given = getattr(configuration, "demonstrations", None)
        return (given or configuration.algorithm.demonstrations.source).seed

    configuration = load_configuration(name)
    assert source(configuration) is None
    other = with_changes(configuration, seed=3)
    assert (source(configuration.resolved()), source(other.resolved())) == (0, 3)
    resolved = other.resolved().model_dump(mode="json", exclude_none=True)
    fixed = load_configuration({**resolved, "seed": 4})
    assert fixed.seed == 4
    assert source(fixed.resolved()) == 3
    assert training_command({"configuration": resolved}) == f"dq-space-arm train {name} --seed 3"
    assert training_command({"configuration": {**resolved, "seed": 4}}) is None
    resolved_again = with_changes(configuration, seed=4).resolved().model_dump(mode="json", exclude_none=True)
    assert agent_of({"configuration": resolved}) == agent_of({"configuration": resolved_again})


def test_unknown_keys_are_refused_with_a_suggestion():
    assert "seeds: unknown key; did you mean 'seed'?" in refusal(seeds=3)
    message = refusal(algorithm={"name": "PPO", "learning_rat": 1e-3})
    assert "learning_rat: unknown key; did you mean 'learning_rate'?" in message
    assert "clip_range: unknown key" in refusal(algorithm={"name": "SAC", "clip_range": 0.2})
    assert refusal(seeds=1, schedule={"total_steps": 0}).startswith("configuration 'small': 2 problems")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"algorithm": {"name": "DQN"}}, "it must be one of PPO, SAC, TQC, TD3, APG, cloning, dagger, act"),
        (
            {"algorithm": {"name": "PPO", "gamma": 1.5}},
            "- algorithm.gamma = 1.5: must be a number from 0 to 1",
        ),
        ({"algorithm": {"name": "SAC", "ent_coef": "autoo"}}, ".ent_coef = 'autoo': must be a finite"),
        ({"algorithm": {"name": "TQC", "ent_coef": 0.0}}, "must be a finite number greater than 0, or auto"),
        ({"algorithm": {"name": "SAC", "target_entropy": "x"}}, "must be a finite number, or auto ("),
        ({"algorithm": {"name": "TD3", "tau": 1.5}}, "tau = 1.5: must be at most 1, where targets are"),
        (
            {"algorithm": {"name": "SAC", "buffer_size": 10, "learning_starts": 20}},
            "learning_starts = 20: must be at most buffer_size, which is 10",
        ),
        (
            {"algorithm": {"name": "TQC", "n_quantiles": 2, "top_quantiles_to_drop_per_net": 2}},
            "top_quantiles_to_drop_per_net = 2: must be less than n_quantiles",
        ),
        ({"environment": {"action_scale": {"base_force": 2.0}}}, "base_force = 2.0: must be at most 1"),
        ({"environment": {"action_scale": {"wheel_torque": 2}}}, "wheel_torque = 2.0: must be at most 1"),
        ({"network": {"activation": "sigmoid"}}, "network.activation = 'sigmoid': must be"),
        (
            {"network": {"hidden": [8192, 8192]}},
            "network.hidden = [8192, 8192]: makes 67,108,864 weights between layers, must make at most",
        ),
        ({"schedule": {}}, "schedule.total_steps: missing"),
        ({"schedule": {"total_steps": 8000.5}}, "total_steps = 8000.5: must be a whole number"),
        ({"seed": -1}, "seed = -1"),
        (
            {"environment": {"copies": 2}, "algorithm": {"name": "PPO", "n_steps": 50}},
            "algorithm.batch_size = 4096: must be at most 100, n_steps times environment.copies",
        ),
        ({"algorithm": {"name": "PPO", "batch_size": 1}}, "batch_size = 1: must be at least 2"),
        (
            {"algorithm": {"name": "TD3", "layer_norm": True}, "network": {"hidden": []}},
            "network.hidden = []: must have a layer for algorithm.layer_norm",
        ),
        (
            {"algorithm": {"name": "TQC", "ent_coef": 0.1, "final_target_entropy": -9.0}},
            "final_target_entropy = -9.0: must be absent with ent_coef = 0.1",
        ),
        ({"algorithm": {"name": "PPO", "learning_rate": float("inf")}}, "learning_rate = inf"),
        (
            {"algorithm": {"name": "SAC", "hindsight": {}}, "environment": {"reward_scale": 0.01}},
            "environment.reward_scale = 0.01: must be 1 with hindsight",
        ),
        (
            {"algorithm": {"name": "SAC", "batch_size": 4, "demonstrations": {"share": 0.1}}},
            "demonstrations.share = 0.1: must leave room for decisions of both kinds in a batch",
        ),
    ],
)
def test_wrong_values_are_named_with_what_would_be_right(changes, sentence):
    assert sentence in refusal(**changes)


def test_all_problems_are_told_at_once():
    message = refusal(scene="nowhere.yaml", threads="two", environment={"copies": 0, "cost_power": 2})
    assert message.startswith("configuration 'small': 4 problems")
    assert "- scene: nowhere.yaml: there is no such file" in message
    assert "- environment.cost_power = 2.0: must be at most 1 (exponent" in message
    message = refusal(scene="nowhere.yaml", threads="two", algorithm={"name": "PP0"})
    assert message.startswith("configuration 'small': 3 problems\n  - algorithm.name = 'PP0': did you mean")
    assert "threads = 'two'" in message
    told = refusal(algorithm="SAC")
    assert told.endswith("1 problem\n  - algorithm = 'SAC': must be a mapping, as {name: SAC}")


IMITATION = {"name": "small", "algorithm": {"name": "cloning"}}


def test_names_of_scenes_in_names_of_agents_lose_what_no_name_may_have():
    changed = with_changes(load_configuration("apg"), scene="some folder/my arm (1).yaml")
    assert (changed.name, changed.scene) == ("apg-my-arm--1-", "some folder/my arm (1).yaml")


def test_whole_numbers_may_be_written_with_an_exponent(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("{name: a, algorithm: {name: PPO}, schedule: {total_steps: 8e3}}")
    total = load_configuration(file).schedule.total_steps
    assert (total, type(total)) == (8000, int)


def test_the_algorithm_decides_about_the_class():
    configuration = load_configuration(IMITATION)
    assert isinstance(configuration, ImitationConfiguration)
    assert configuration.cloning is configuration.algorithm
    algorithm = {"name": "dagger", "cloning": {"validate_every": 7}}
    dagger = load_configuration(IMITATION | {"algorithm": algorithm})
    assert isinstance(dagger, ImitationConfiguration)
    assert dagger.cloning.validate_every == 7


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"network": {"activation": "relu"}}, "network.activation = 'relu': must be one of tanh, silu"),
        ({"algorithm": {"name": "clonin"}}, "algorithm.name = 'clonin': did you mean 'cloning'"),
        ({"algorithm": {"name": ["cloning"]}}, "algorithm.name = ['cloning']: it must be one of PPO"),
        ({"algorithm": {"name": "dagger", "share": 1.0}}, "share = 1.0: must be less than 1"),
        (
            {"algorithm": {"name": "dagger", "optimization": {"batch_size": 1}}},
            "algorithm.optimization.batch_size = 1: must be at least 2: a labeled state",
        ),
        ({"algorithm": {"name": "act", "width": 50}}, "heads = 4: must divide width, 50"),
        ({"algorithm": {"name": "act", "chunk": 1002, "spacing": 10}}, "1002 actions are 10,011 time steps"),
        (
            {"algorithm": {"name": "act", "chunk": 21, "spacing": 5, "weighting": 6}},
            "weighting = 6.0: must be between -5.94 and 5.94",
        ),
        ({"algorithm": {"name": "act", "validation_share": 1}}, "validation_share = 1.0: must be less"),
        ({"algorithm": {"name": "cloning", "optimization": {"update": 5}}}, "did you mean 'updates'"),
        ({"demonstrations": {"tolerance_scale": 2}}, "tolerance_scale = 2.0: must be at most 1"),
        (
            {"demonstrations": {"tolerance_scale": 0.5, "minari": "a/b-v0"}},
            "tolerance_scale = 0.5: must be absent: existing demonstrations, here of minari, have",
        ),
    ],
)
def test_wrong_values_for_imitation_are_named(changes, sentence):
    with pytest.raises(ConfigurationError) as error:
        load_configuration(IMITATION | changes)
    assert sentence in str(error.value)


def test_what_cannot_be_found_or_read_is_named(tmp_path):
    for wrong in (3, None, ["ppo"]):
        with pytest.raises(ConfigurationError, match="is no configuration: give a name"):
            load_configuration(wrong)
    with pytest.raises(ConfigurationError, match="no configuration is named 'pppo'; did you mean 'ppo'"):
        load_configuration("pppo")
    with pytest.raises(ConfigurationError, match=r"nothing\.yaml: there is no such file"):
        load_configuration(tmp_path / "nothing.yaml")
    for content, sentence in (
        ("a: [", "not valid YAML"),
        ("- 1", "must be a mapping"),
        (
            "name: mine\nbase: {}\nlinks: []",
            r"is a scene, should be .*: dq-space-arm train apg --scene /.*odd",
        ),
    ):
        (tmp_path / "odd.yaml").write_text(content)
        with pytest.raises(ConfigurationError, match=sentence):
            load_configuration(tmp_path / "odd.yaml")
