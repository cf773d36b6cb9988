"""A folder survives whatever happens to a run, and ends with the same bytes."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from demonstration_files import CountingExecutor, contents, shard_files

from dq_space_arm_env import Scene
from dq_space_arm_env.common import files
from dq_space_arm_env.common.files import temporary_name
from experts import generate_demonstrations, load_demonstrations
from experts.demonstrations import Demonstrations, DemonstrationsError, SerialExecutor
from experts.demonstrations.folder import Folder, Part
from experts.demonstrations.settings import Settings


def go_on(scene: Scene, folder: Path, executor=None, **changes) -> Demonstrations | None:
    arguments = {"n": 18, "seed": 3, "shard_size": 4, "executor": executor or SerialExecutor(), **changes}
    return generate_demonstrations(scene, out=folder, **arguments)


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_to_the_same_bytes(
    whole: Demonstrations, quick_scene: Scene, tmp_path: Path
):
    first = CountingExecutor(most=2)
    with pytest.raises(KeyboardInterrupt):
        go_on(quick_scene, tmp_path, first)
    assert len(shard_files(tmp_path)) == 2
    with pytest.raises(DemonstrationsError, match="is not complete"):
        load_demonstrations(tmp_path)
    second = CountingExecutor()
    assert len(go_on(quick_scene, tmp_path, second)) == len(whole)
    assert sorted(first.made + second.made) == [0, 1, 2, 3, 4]
    assert contents(tmp_path) == contents(whole.path)


def test_a_flipped_bit_is_found_and_only_its_shard_made_again(
    whole: Demonstrations, quick_scene: Scene, folder: Path
):
    damaged = shard_files(folder)[3]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    load_demonstrations(folder)
    with pytest.raises(DemonstrationsError, match="is damaged"):
        load_demonstrations(folder, verify=True)
    executor = CountingExecutor()
    go_on(quick_scene, folder, executor)
    assert executor.made == [3]
    assert contents(folder) == contents(whole.path)


def test_missing_and_half_written_shards_are_made_again(
    whole: Demonstrations, quick_scene: Scene, folder: Path
):
    first, second = shard_files(folder)[:2]
    first.unlink()
    second.write_bytes(second.read_bytes()[:1000])
    (folder / "shards" / temporary_name(first.name)).write_bytes(b"begun")
    (folder / temporary_name("manifest.json")).write_bytes(b"begun")
    executor = CountingExecutor()
    go_on(quick_scene, folder, executor)
    assert sorted(executor.made) == [0, 1]
    assert contents(folder) == contents(whole.path)


def test_a_shard_that_is_there_twice_is_kept_once(whole: Demonstrations, quick_scene: Scene, folder: Path):
    """As after parts that ran on processors of different kinds."""
    import hashlib

    other = shard_files(folder)[1].read_bytes()
    digest = hashlib.sha256(other).hexdigest()
    (folder / "shards" / f"000000-{digest}.safetensors").write_bytes(other)
    go_on(quick_scene, folder)
    assert len(shard_files(folder)) == 5
    assert len(load_demonstrations(folder, verify=True)) == len(whole)


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"n": 19}, "problems is 18 there and 19 here"), ({"seed": 4}, "seed is 3 there and 4 here")],
)
def test_other_settings_are_refused(changes, named: str, quick_scene: Scene, folder: Path):
    before = contents(folder)
    with pytest.raises(DemonstrationsError, match=named):
        go_on(quick_scene, folder, **changes)
    assert contents(folder) == before


def test_another_scene_or_other_code_is_refused(quick_scene: Scene, folder: Path):
    heavier = quick_scene.replace(base={"mass": 106.0})
    with pytest.raises(DemonstrationsError, match=r"scene.base.mass is 105.0 there and 106.0 here"):
        go_on(heavier, folder)
    settings = json.loads((folder / "settings.json").read_text())
    settings["versions"]["numpy"], settings["source"] = "1.0", "0" * 64
    (folder / "settings.json").write_text(json.dumps(settings))
    with pytest.raises(DemonstrationsError, match=r"source is .* versions.numpy is \"1.0\" there"):
        go_on(quick_scene, folder)


def test_two_runs_in_one_folder_refuse_each_other(quick_scene: Scene, folder: Path):
    settings = Settings.of(quick_scene, 18, 3, 4)
    with (
        Folder(folder, settings, Part(1, 1)).opened(),
        pytest.raises(DemonstrationsError, match="another run is writing to"),
    ):
        go_on(quick_scene, folder)
    with Folder(folder, settings, Part(1, 2)).opened():
        for part in ((1, 1), (1, 2)):
            with pytest.raises(DemonstrationsError, match="another run is writing to"):
                go_on(quick_scene, folder, part=part)
        go_on(quick_scene, folder, part=(2, 2))
    go_on(quick_scene, folder)


def test_a_lock_ends_with_its_process(quick_scene: Scene, folder: Path):
    code = (
        "import fcntl, os, sys\n"
        "lock = os.open(sys.argv[1], os.O_RDWR); fcntl.flock(lock, fcntl.LOCK_EX)\n"
        "print('held', flush=True)\n"
        "sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(folder / "log" / "lock-1-of-1")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(DemonstrationsError, match="another run is writing to"):
            go_on(quick_scene, folder)
        process.kill()
    go_on(quick_scene, folder)


@pytest.mark.slow
def test_parts_share_a_folder_and_the_last_one_completes_it(
    whole: Demonstrations, quick_scene: Scene, tmp_path: Path
):
    settings = Settings.of(quick_scene, 18, 3, 4)
    executors = [CountingExecutor() for _ in range(3)]
    with Folder(tmp_path, settings, Part(9, 9)).opened():  # another part is at work all the time
        assert go_on(quick_scene, tmp_path, executors[1], part=(2, 3)) is None
        assert go_on(quick_scene, tmp_path, executors[0], part=(1, 3)) is None
        assert go_on(quick_scene, tmp_path, executors[2], part=(3, 3)) is not None
    assert [sorted(executor.made) for executor in executors] == [[0, 3], [1, 4], [2]]
    assert contents(tmp_path) == contents(whole.path)


@pytest.mark.slow
def test_a_full_disk_ends_with_a_sentence_and_a_folder_to_go_on_with(
    whole: Demonstrations, quick_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    flush, calls = os.fsync, []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) == 6:  # settings, a shard, the next one: each file, then its folder
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(descriptor)

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(DemonstrationsError, match=r"No space left on device. Finished shards remain"):
        go_on(quick_scene, tmp_path)
    monkeypatch.undo()
    assert not [path for path in shard_files(tmp_path) if path.name.startswith(".")]
    go_on(quick_scene, tmp_path)
    assert contents(tmp_path) == contents(whole.path)
