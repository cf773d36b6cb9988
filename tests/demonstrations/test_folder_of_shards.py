"""The folder of demonstrations on its own: which shards it takes for sound, and when it is complete."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import Scene
from experts.demonstrations.folder import Folder, Part, sha256_of
from experts.demonstrations.outcomes import REASONS
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import ShardResult
from experts.demonstrations.tensors import DemonstrationsError, pack

WHOLE = Part(1, 1)


def shard(number: int, reasons: tuple[int, ...] = ()) -> ShardResult:
    """A shard of one demonstration and some failures, without anything else."""
    arrays = {"index": np.array([number]), "failures.stop_reason": np.array(reasons, dtype=np.int64)}
    content = pack(arrays, {})
    return ShardResult(number, content, hashlib.sha256(content).hexdigest(), "host", 1, len(reasons), [], {})


def folder_of(scene: Scene, path: Path, part: Part = WHOLE, n: int = 12) -> Folder:
    return Folder(path, Settings.of(scene, n, 3, 4), part)


def found(folder: Folder) -> dict[int, str | None]:
    return {number: path and path.name for number, path in folder.sound_shards()}


def test_folders_and_settings_are_created_once(quick_scene: Scene, tmp_path: Path) -> None:
    folder = folder_of(quick_scene, tmp_path / "new" / "folder")
    for _ in range(2):
        with folder.opened():
            assert sorted(path.name for path in folder.path.iterdir()) == ["log", "settings.json", "shards"]
    assert json.loads((folder.path / "settings.json").read_text()) == folder.settings.record()
    other = folder_of(quick_scene, folder.path, n=16)
    with pytest.raises(DemonstrationsError, match="started with different settings"), other.opened():
        pass


def test_a_readme_of_somebody_else_is_not_replaced(quick_scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("mine")
    with (
        pytest.raises(DemonstrationsError, match=r"has a README\.md of its own, .*; choose a new folder"),
        folder_of(quick_scene, tmp_path).opened(),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_a_file_is_no_folder(quick_scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "folder"):
        with (
            pytest.raises(DemonstrationsError, match=r"^out: .*file is a file, it should be a folder"),
            folder_of(quick_scene, path).opened(),
        ):
            pass
    assert (tmp_path / "file").read_text() == "mine"


def test_sound_shards_are_those_that_their_names_say(quick_scene: Scene, tmp_path: Path) -> None:
    folder = folder_of(quick_scene, tmp_path)
    with folder.opened():
        assert found(folder) == {0: None, 1: None, 2: None}
        for number in (0, 1):
            folder.write(shard(number))
        names = sorted(path.name for path in (tmp_path / "shards").iterdir())
        assert names[0].startswith("000000-")
        assert found(folder) == {0: names[0], 1: names[1], 2: None}
        (tmp_path / "shards" / names[1]).write_bytes(b"another content")
        copy = tmp_path / "shards" / f"000000-{'f' * 64}.safetensors"  # not its hash
        copy.write_bytes(b"")
        (tmp_path / "shards" / "notes.txt").write_text("stays")
        assert found(folder) == {0: names[0], 1: None, 2: None}
        assert sorted(path.name for path in (tmp_path / "shards").iterdir()) == [names[0], "notes.txt"]


def test_what_killed_runs_left_is_removed_unless_it_may_be_of_a_living_one(
    quick_scene: Scene, tmp_path: Path
) -> None:
    """The shards of 1/2 are also of 1/3: beside each other, a half-written one may be the other's."""
    half, third = (folder_of(quick_scene, tmp_path, Part(1, of)) for of in (2, 3))
    other_half = folder_of(quick_scene, tmp_path, Part(2, 2))
    with half.opened():
        name = f"000000-{'0' * 64}.safetensors"
    leftover = tmp_path / "shards" / f".{name}.0123456789abcdef.part"
    leftover.write_bytes(b"half of")
    with half.opened():
        assert not leftover.exists()
        leftover.write_bytes(b"half of")
        with other_half.opened(), third.opened():
            assert list(found(third)) == [0]
            assert leftover.exists()
    with third.opened():
        assert not leftover.exists()


def test_a_part_leaves_the_shards_of_others_alone(quick_scene: Scene, tmp_path: Path) -> None:
    first, second = (folder_of(quick_scene, tmp_path, Part(number, 2)) for number in (1, 2))
    assert (list(first.shards), list(second.shards)) == ([0, 2], [1])
    with first.opened(), second.opened():
        first.write(shard(0))
        damaged = tmp_path / "shards" / f"000001-{'0' * 64}.safetensors"
        damaged.write_bytes(b"")
        assert list(found(first)) == [0, 2]
        assert damaged.exists()
        assert found(second) == {1: None}
        assert not damaged.exists()


def test_nothing_is_complete_with_a_damaged_shard_of_another_part(quick_scene: Scene, tmp_path: Path) -> None:
    first, second = (folder_of(quick_scene, tmp_path, Part(number, 2)) for number in (1, 2))
    with first.opened():
        first.write(shard(0))
        first.write(shard(2))
        assert not first.complete()
    damaged = next((tmp_path / "shards").glob("000002-*"))
    content = damaged.read_bytes()
    damaged.write_bytes(content[:-1] + b"?")
    with second.opened():
        second.write(shard(1))
        with pytest.raises(DemonstrationsError, match=f"{damaged.name} is damaged: run part 1 of 2 again"):
            second.complete()
        assert not (tmp_path / "manifest.json").exists()
        damaged.write_bytes(content)
        assert second.complete()


def test_a_file_beyond_the_last_shard_neither_counts_nor_stops_the_run(
    quick_scene: Scene, tmp_path: Path
) -> None:
    folder = folder_of(quick_scene, tmp_path)
    with folder.opened():
        (tmp_path / "shards" / f"000003-{'0' * 64}.safetensors").write_bytes(b"of another set")
        for number in (0, 2):
            folder.write(shard(number))
        assert not folder.complete()
        folder.write(shard(1))
        assert folder.complete()
    assert len(json.loads((tmp_path / "manifest.json").read_text())["shards"]) == 3


def test_a_second_run_waits_for_its_turn(quick_scene: Scene, tmp_path: Path) -> None:
    folder = folder_of(quick_scene, tmp_path)
    again, part = folder_of(quick_scene, tmp_path), folder_of(quick_scene, tmp_path, Part(1, 2))
    with folder.opened():
        for other in (again, part):
            with pytest.raises(DemonstrationsError, match="another run is writing"), other.opened():
                pass
    with again.opened():
        pass


def test_the_manifest_counts_what_the_shards_hold(quick_scene: Scene, tmp_path: Path) -> None:
    folder = folder_of(quick_scene, tmp_path)
    with folder.opened():
        for number, reasons in ((2, (0, 1, 1)), (0, ())):
            folder.write(shard(number, reasons))
            assert not folder.complete()
            assert not (tmp_path / "manifest.json").exists()
        folder.write(shard(1, (1,)))
        assert folder.complete()
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["settings_sha256"] == sha256_of(tmp_path / "settings.json")
    assert manifest["demonstrations"] == 3
    assert manifest["failures"] == {REASONS[0]: 1, REASONS[1]: 3}
    files = sorted((tmp_path / "shards").iterdir())
    for entry, file, failures in zip(manifest["shards"], files, (0, 1, 3), strict=True):
        assert entry["file"] == file.name
        assert entry["sha256"] == sha256_of(file) == hashlib.sha256(file.read_bytes()).hexdigest()
        assert (entry["bytes"], entry["demonstrations"]) == (file.stat().st_size, 1)
        assert entry["failures"] == failures


def test_the_log_has_a_line_for_each_entry(quick_scene: Scene, tmp_path: Path) -> None:
    folder = folder_of(quick_scene, tmp_path, Part(2, 3))
    with folder.opened():
        folder.log({"shard": 1})
        folder.log({"shard": 4})
    text = (tmp_path / "log" / "part-2-of-3.jsonl").read_text()
    assert [json.loads(line) for line in text.splitlines()] == [{"shard": 1}, {"shard": 4}]
