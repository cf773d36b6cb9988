"""The folder of a training run: whose it is, its checkpoints one after another, its learning curve."""

import json
from pathlib import Path

import pytest

from agents import run_folder
from agents.configuration import AgentConfiguration, load_configuration
from agents.run_folder import RunFolder, RunFolderError, reserved, validation_seeds


@pytest.fixture(scope="module")
def configuration() -> AgentConfiguration:
    return load_configuration("ppo")


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def save(content: str):
    def write(folder: Path) -> None:
        assert not list(folder.iterdir())
        (folder / "model").write_text(content)

    return write


def test_a_folder_says_what_it_is_for_and_each_start(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    first = RunFolder(tmp_path, configuration)
    assert load_configuration(tmp_path / "config.yaml") == configuration
    RunFolder(tmp_path, configuration)
    starts = json.loads((tmp_path / "provenance.json").read_text())
    assert len(starts) == 2
    assert starts[0]["scene_hash"] == starts[1]["scene_hash"]
    assert first.checkpoint() is None
    assert first.evaluations() == []


def test_another_configuration_is_refused_but_for_its_length_and_description(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    RunFolder(tmp_path, configuration)
    described = configuration.model_copy(update={"description": "another"})
    RunFolder(tmp_path, described)
    schedule = configuration.schedule
    longer = schedule.model_copy(update={"total_steps": 2 * schedule.total_steps})
    RunFolder(tmp_path, configuration.model_copy(update={"schedule": longer}))
    RunFolder(tmp_path, configuration).add_checkpoint(1, save("first"))
    before = contents(tmp_path)
    with pytest.raises(RunFolderError, match=r"another configuration: .*name"):
        RunFolder(tmp_path, configuration.model_copy(update={"name": "another"}))
    shorter = schedule.model_copy(update={"total_steps": schedule.total_steps - 1})
    with pytest.raises(
        RunFolderError, match=r"total_steps: \d+, which may become larger, not \d+: use another"
    ):
        RunFolder(tmp_path, configuration.model_copy(update={"schedule": shorter}))
    starts = json.loads(before["provenance.json"])
    starts[0]["scene_hash"] = "0" * 64
    (tmp_path / "provenance.json").write_text(json.dumps(starts))
    with pytest.raises(RunFolderError, match="another version of scene"):
        RunFolder(tmp_path, configuration)
    assert (tmp_path / "config.yaml").read_text() == before["config.yaml"]


def test_a_mistake_that_is_corrected_is_no_other_run(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    """As that in a scene or the path of demonstrations: nothing has been trained."""
    RunFolder(tmp_path, configuration.model_copy(update={"start_from": "nowhere"}))
    starts = json.loads((tmp_path / "provenance.json").read_text())
    (tmp_path / "provenance.json").write_text(json.dumps([{**starts[0], "scene_hash": "0" * 64}]))
    RunFolder(tmp_path, configuration).write_evaluations([])
    assert load_configuration(tmp_path / "config.yaml") == configuration
    assert len(json.loads((tmp_path / "provenance.json").read_text())) == 1
    RunFolder(tmp_path, configuration)  # and goes on
    with pytest.raises(RunFolderError, match=r"another configuration: .*start_from"):
        RunFolder(tmp_path, configuration.model_copy(update={"start_from": "nowhere"}))


def test_a_checkpoint_replaces_the_last_one_and_what_killed_runs_left(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    folder = RunFolder(tmp_path, configuration)
    checkpoints = tmp_path / "checkpoints"
    folder.add_checkpoint(900, save("first"))
    assert [path.name for path in checkpoints.iterdir()] == ["000000000900"]
    (checkpoints / ".000000001000.0123456789abcdef.part").mkdir()
    (checkpoints / "notes").mkdir()
    folder.add_checkpoint(1000, save("second"))
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000000001000", "notes"]
    last = folder.checkpoint()
    assert last is not None
    assert contents(last) == {"model": "second"}


def test_a_checkpoint_is_on_disk_before_it_has_its_name(
    tmp_path: Path, configuration: AgentConfiguration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power failure the last one may be gone: what replaces it must be whole."""
    folder, seen = RunFolder(tmp_path, configuration), []

    def note(place: Path) -> None:
        seen.append((place == tmp_path / "checkpoints", sorted(path.suffix for path in place.iterdir())))

    monkeypatch.setattr(run_folder, "flush", note)
    folder.add_checkpoint(900, save("first"))
    folder.add_checkpoint(1000, save("second"))
    assert seen == [(False, [""]), (True, [""]), (False, [""]), (True, ["", ""])]  # then the old one goes


def test_a_checkpoint_that_cannot_be_written_leaves_the_last_one(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    folder = RunFolder(tmp_path, configuration)
    folder.add_checkpoint(1, save("first"))

    def fail(folder: Path) -> None:
        (folder / "model").write_text("half of")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        folder.add_checkpoint(2, fail)
    last = folder.checkpoint()
    assert last is not None
    assert contents(last) == {"model": "first"}
    folder.add_checkpoint(2, save("second"))
    last = folder.checkpoint()
    assert last is not None
    assert contents(last) == {"model": "second"}


def test_the_learning_curve_is_read_up_to_a_number_of_steps(
    tmp_path: Path, configuration: AgentConfiguration
) -> None:
    folder = RunFolder(tmp_path, configuration)
    lines = [
        {"environment_steps": steps, "seconds": 1.0, "success_rate": steps / 40, "median_cost": 1.0}
        for steps in (10, 20, 30)
    ]
    folder.write_evaluations(lines)
    assert folder.evaluations() == lines
    assert folder.evaluations(20) == lines[:2]
    folder.write_evaluations(lines[:1])
    assert folder.evaluations() == lines[:1]
    with pytest.raises(RunFolderError, match=r"jsonl is damaged .* lacks a number of .*, updates"):
        folder.evaluations(names=["updates"])
    folder.write_evaluations([{name: lines[0][name] for name in lines[0] if name != "seconds"}])
    with pytest.raises(RunFolderError, match="lacks a number of environment_steps, seconds"):
        folder.evaluations()


def test_a_folder_is_locked_and_free_again(tmp_path: Path) -> None:
    for _ in range(2):
        with reserved(tmp_path / "new"):
            assert (tmp_path / "new").is_dir()


def test_validation_starts_are_always_the_same() -> None:
    assert validation_seeds(3) == validation_seeds(5)[:3]
    assert len(set(validation_seeds(5))) == 5
