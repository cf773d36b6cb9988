"""The zoo: whether what it has is whole, flies, and does as its cards say; and how it takes new policies."""

import json
from dataclasses import replace

import numpy as np
import pytest

from agents.evaluation import evaluate, evaluation_seeds, fly
from agents.evaluation.conditions import physics_hash
from agents.policies import ExportedPolicy
from agents.zoo import ZooError, list_policies, load_policy
from agents.zoo.finding import PolicyError, as_policy, check_fit, scene_of
from agents.zoo.shelf import MOST_BYTES, SHELF, file_hash, load_record, policy_file
from dq_space_arm_env import SceneError, load_scene
from experts.demonstrations import SerialExecutor
from scripts.add_to_zoo import REPEATED, add_to_zoo, card, main

QUICK = load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})
"""Its problems are solved in hundredths of a second; the same as in the tests of the evaluation."""


def test_the_zoo_fits_into_the_repository():
    assert sum(policy_file(name).stat().st_size for name in list_policies()) < MOST_BYTES <= 2_000_000
    expected = {f"{name}{suffix}" for name in list_policies() for suffix in (".npz", ".json", ".md")}
    there = {path.name for path in SHELF.iterdir()} if SHELF.is_dir() else set()
    assert there == expected


def test_a_path_is_told_from_a_name(tmp_path):
    with pytest.raises(ZooError, match=r"is a path, should be a name of the zoo; there is no such file"):
        load_policy("results/x/policy.npz")
    (tmp_path / "policy.npz").touch()
    with pytest.raises(ZooError, match=r"to load it, ExportedPolicy\.load"):
        load_policy(str(tmp_path / "policy.npz"))


def test_policies_are_shown_in_a_line():
    assert repr(load_policy("ppo")) == "<ExportedPolicy 24 -> 128 -> 128 -> 12, tanh, trained in 'paper'>"


def test_a_policy_whose_scene_is_elsewhere_names_it():
    policy = replace(load_policy("ppo"), metadata={"scene": "own/my.yaml"})
    with pytest.raises(PolicyError, match=r"was trained in own/my\.yaml, which is not here: give scene"):
        scene_of([as_policy(policy)])
    for scene in ("x" * 300, "a\0b"):
        with pytest.raises(PolicyError, match="which is not here: give scene"):
            scene_of([as_policy(replace(policy, metadata={"scene": scene}))])


@pytest.mark.parametrize("name", list_policies())
def test_a_policy_of_the_zoo_is_what_its_card_says(name):
    policy, record = load_policy(name), load_record(name)
    assert file_hash(policy_file(name)) == record["sha256"]
    assert policy_file(name).stat().st_size == record["bytes"]
    assert policy_file(name).with_suffix(".md").read_text(encoding="utf-8") == card(name, policy, record)
    assert record["evaluations"][0]["episodes"] == 500
    assert record["evaluations"][0]["condition"] == "training"


@pytest.mark.parametrize("name", list_policies())
def test_a_policy_of_the_zoo_succeeds_as_often_as_its_card_says(name):
    """The very flights of its evaluation; another processor rounds otherwise, which may decide a few."""
    record = load_record(name)
    scene = load_scene(record["scene"])
    assert physics_hash(scene) == record["physics"]
    check_fit(as_policy(name), scene)
    assert record["seeds"] == evaluation_seeds(scene, REPEATED)
    flights = fly(as_policy(name).act, scene, record["seeds"])
    assert np.sum(flights.is_success != record["is_success"]) <= 2
    # Of 32 flights the rate of 500 is off by less than 3 standard deviations.
    rate, low, high = record["evaluations"][0]["success_rate"]
    assert low <= rate <= high
    assert abs(np.mean(flights.is_success) - rate) < 3.0 * 0.5 / np.sqrt(REPEATED)


@pytest.fixture
def shipped(monkeypatch):
    """As if the quick scene shipped with the package."""
    monkeypatch.setattr("scripts.add_to_zoo.list_scenes", lambda: ["quick"])
    monkeypatch.setattr("scripts.add_to_zoo.load_scene", lambda name: QUICK)


def write_policy(folder, **metadata):
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    metadata = {
        "agent": "stub",
        "scene": "quick",
        "scene_hash": QUICK.content_hash(),
        "configuration": {"name": "stub", "seed": 3, "description": "It knows nothing."},
        "training": {"environment_steps": 1000, "seconds": 90.0, "expert_solves": 7},
        **metadata,
    }
    weights = 0.01 * rng.standard_normal((14, 6))
    policy = ExportedPolicy((weights,), (np.zeros(6),), "tanh", np.zeros(14), np.ones(14), metadata=metadata)
    policy.save(folder / "policy.npz")
    return folder


@pytest.mark.slow
def test_a_policy_is_added_with_its_evaluation_and_card(shipped, tmp_path, monkeypatch):
    run, shelf = write_policy(tmp_path / "run"), tmp_path / "shelf"
    options = {"conditions": ("training", "spin"), "training": "dq-space-arm train mine.yaml"}
    written = add_to_zoo(run, "my-stub", n=5, shelf=shelf, executor=SerialExecutor(), **options)
    assert list_policies(shelf) == ["my-stub"]
    record = load_record("my-stub", shelf)
    policy = ExportedPolicy.load(shelf / "my-stub.npz")
    text = written.read_text()
    assert text == card("my-stub", policy, record)
    for part in ("dq-space-arm train mine.yaml", "It knows nothing.", record["sha256"]):
        assert part in text
    assert "It misses the target in 100.0 % of the flights even under training conditions." in text
    assert "dq-space-arm evaluate my-stub --scene quick -n 5 --condition training spin" in text
    evaluation = evaluate(run, QUICK, 5, executor=SerialExecutor())
    assert record["is_success"] == evaluation.flights.is_success.tolist()
    assert record["evaluations"][0]["median_cost"] == pytest.approx(
        evaluation.summary()["median_cost"], rel=1e-5
    )
    assert record["trained_here"] is True
    # From now on its name will do.
    monkeypatch.setattr("agents.zoo.shelf.SHELF", shelf)
    assert load_policy("my-stub").metadata == policy.metadata
    named = evaluate("my-stub", QUICK, 5, expert=False)
    assert named.policy == "my-stub"
    np.testing.assert_array_equal(named.flights.cost, evaluation.flights.cost)
    with pytest.raises(ZooError, match="no policy 'my-stup'; did you mean 'my-stub'\\? It has my-stub"):
        load_policy("my-stup")


def test_what_does_not_belong_into_the_zoo_is_refused(shipped, tmp_path, monkeypatch):
    shelf = tmp_path / "shelf"
    run = write_policy(tmp_path / "run")
    with pytest.raises(ZooError, match="does not follow from a configuration of the package"):
        add_to_zoo(run, shelf=shelf)
    other = write_policy(tmp_path / "other", scene="mine")
    with pytest.raises(ZooError, match="trained for scene 'mine', which does not ship"):
        add_to_zoo(other, training="x", shelf=shelf)
    # Scenes to fly it in besides are looked at before the first flight.
    monkeypatch.setattr("scripts.add_to_zoo.evaluate", lambda *given, **options: pytest.fail("flies"))
    with pytest.raises(ValueError, match="condition: 'rain' is unknown"):
        add_to_zoo(run, training="x", conditions=["spin", "rain"], shelf=shelf)
    for name, value in {"configuration": "mine", "provenance": {"versions": ["torch"]}}.items():
        vague = write_policy(tmp_path / name, **{name: value})
        with pytest.raises(ZooError, match=rf"metadata: {name}.*, should be a mapping, or left out"):
            add_to_zoo(vague, training="x", shelf=shelf)
    found = {"quick": QUICK}
    monkeypatch.setattr("scripts.add_to_zoo.load_scene", lambda name: found.get(name) or load_scene(name))
    with pytest.raises(SceneError, match="no-such-scene"):
        add_to_zoo(run, training="x", also=["no-such-scene"], shelf=shelf)
    with pytest.raises(PolicyError, match="scene 'paper' has"):
        add_to_zoo(run, training="x", also=["quick", "paper"], shelf=shelf)
    monkeypatch.setattr("scripts.add_to_zoo.MOST_BYTES", 100)
    with pytest.raises(ZooError, match="together they should be at most 100"):
        add_to_zoo(run, training="x", shelf=shelf)
    assert not shelf.exists()


def test_what_fails_after_the_flights_leaves_the_shelf_as_it_was(shipped, tmp_path, monkeypatch):
    def fails(*given):
        raise ValueError("no card")

    monkeypatch.setattr("scripts.add_to_zoo.card", fails)
    run, shelf = write_policy(tmp_path / "run", training="little"), tmp_path / "shelf"
    with pytest.raises(ValueError, match="no card"):
        add_to_zoo(run, n=1, conditions=(), training="x", shelf=shelf, executor=SerialExecutor())
    assert not shelf.exists()
    monkeypatch.undo()
    assert "The training effort was not recorded." in card(
        "stub", ExportedPolicy.load(run / "policy.npz"), load_record("ppo")
    )


def test_the_script_adds_a_policy(shipped, tmp_path, capsys):
    run = str(write_policy(tmp_path / "run"))
    options = ["--zoo", str(tmp_path / "zoo"), "-n", "5", "--condition", "training", "--workers", "1"]
    assert main([run, *options]) == 2
    assert "does not follow from a configuration" in capsys.readouterr().err
    assert main([run, *options, "--training", "make it"]) == 0
    assert json.loads((tmp_path / "zoo" / "stub.json").read_text())["training_command"] == "make it"
    assert "stub.md: its card" in capsys.readouterr().out.replace("\n", "")
