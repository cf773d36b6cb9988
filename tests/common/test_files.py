"""Files are written whole, through links, by many writers at once, and never over what is no file."""

import math
import os
import shutil
import socket
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dq_space_arm_env.common.files import (
    check_writable_file,
    flush,
    json_value,
    remove_leftovers,
    temporary_name,
    write_atomically,
    write_privately,
)

posix = pytest.mark.skipif(os.name == "nt", reason="POSIX permissions and files")


def test_file_is_replaced_and_nothing_is_left_over(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    for content in ("old", "Δt", b"\x00\xff"):
        write_atomically(file, content, durable=content == "Δt")
        assert file.read_bytes() == (content if isinstance(content, bytes) else content.encode())
    assert list(tmp_path.iterdir()) == [file]


@posix
def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    import resource

    file = tmp_path / "a.txt"
    file.write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=rf"File too large: '{file}'$"):
            write_atomically(file, bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["file/a.txt", "missing/a.txt", "a" * 240, "a" * 300])
def test_what_cannot_be_written_is_named_by_its_own_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=f": '{tmp_path / name}'$"):
        write_atomically(tmp_path / name, "new")


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_failure_at_any_moment_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    file = tmp_path / "a.txt"
    file.write_text("old")
    if call == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    elif call == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    else:
        monkeypatch.setattr(os, "fdopen", fail)
    with pytest.raises(OSError, match="no space"):
        write_atomically(file, "new", durable=True)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_content_is_on_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def flush(descriptor: int) -> None:
        calls.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def rename(source: Path, target: Path) -> Path:
        calls.append("rename")
        assert source.read_text() == "new"
        return replace(source, target)

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(Path, "replace", rename)
    write_atomically(tmp_path / "a.txt", "new", durable=True)
    assert calls == (["file", "rename"] if os.name == "nt" else ["file", "rename", "folder"])
    calls.clear()
    write_atomically(tmp_path / "a.txt", "new")
    assert calls == ["rename"]  # nobody waits for the disk without need


def test_a_flushed_folder_has_its_files_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed, fsync = [], os.fsync

    def note(descriptor: int) -> None:
        flushed.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    for name in ("model.zip", "state.json"):
        (tmp_path / name).write_text(name)
    (tmp_path / "further").mkdir()
    flush(tmp_path)
    expected = [path for path in tmp_path.iterdir() if path.is_file()]
    expected += [] if os.name == "nt" else [tmp_path]  # the names at last
    assert flushed == [path.stat().st_ino for path in expected]


@posix
@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "device"])
@pytest.mark.parametrize("linked", [False, True])
def test_what_is_no_file_is_refused_and_stays(tmp_path: Path, kind: str, linked: bool) -> None:
    place = tmp_path / "out.html"
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(os.path.relpath(place))  # an absolute one may be too long
    elif kind == "folder":
        place.mkdir()
    else:
        try:  # one that nobody misses
            os.mknod(place, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        except (AttributeError, PermissionError):
            pytest.skip("devices can be made by the superuser alone")
    out = place
    if linked:
        out = tmp_path / "link"
        out.symlink_to(place)
    before = place.stat()
    for write in (check_writable_file, lambda path: write_atomically(path, "new")):
        with pytest.raises(ValueError, match=f"^{out} is a {kind}: name a regular file"):
            write(out)
    assert (place.stat().st_mode, place.stat().st_ino) == (before.st_mode, before.st_ino)
    assert not list(tmp_path.glob("*.part"))


@posix
def test_a_link_stays_and_its_target_is_written(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    target, link, second = tmp_path / "far" / "target", tmp_path / "link", tmp_path / "second"
    link.symlink_to(Path("far", "target"))
    second.symlink_to(link)
    for content in ("created", "replaced"):  # the first time, the links dangle
        write_atomically(second, content)
        assert target.read_text() == content
    assert link.readlink() == Path("far", "target")
    assert second.readlink() == link
    assert list((tmp_path / "far").iterdir()) == [target]


@posix
def test_a_link_into_a_folder_that_is_missing_is_refused_early(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "missing" / "file")
    with pytest.raises(ValueError, match="whose folder does not exist"):
        check_writable_file(tmp_path / "link")


@posix
def test_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    with pytest.raises(OSError, match="symbolic links"):
        write_atomically(circle, "text")
    assert circle.is_symlink()


@posix
@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_usual_permissions(tmp_path: Path, umask: int) -> None:
    file, usual = tmp_path / "a.txt", tmp_path / "usual.txt"
    before = os.umask(umask)
    try:
        usual.touch()
        write_atomically(file, "text")
    finally:
        os.umask(before)
    assert file.stat().st_mode == usual.stat().st_mode


@posix
def test_an_existing_file_keeps_its_permissions(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    for mode in (0o600, 0o664, 0o755):
        file.touch()
        file.chmod(mode)
        write_atomically(file, "text")
        assert stat.S_IMODE(file.stat().st_mode) == mode


def test_the_early_check_takes_what_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    check_writable_file(tmp_path / "a.txt")
    check_writable_file(tmp_path / "new" / "folder" / "a.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    with pytest.raises(ValueError, match="is not a folder"):
        check_writable_file(tmp_path / "a.txt" / "b.txt")


@posix
def test_the_early_check_respects_a_file_that_is_read_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.txt"
    file.write_text("old")
    file.chmod(0o444)
    access = os.access  # root may write everything
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != file and access(path, mode))
    with pytest.raises(ValueError, match="no permission to write this file"):
        check_writable_file(file)


def test_threads_that_write_the_same_file_never_meet(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_text("0" * 50_000)

    def write(number: int) -> int:
        torn = 0
        for _ in range(40):
            write_atomically(file, str(number) * 50_000)
            found = file.read_text()
            torn += len(found) != 50_000 or len(set(found)) != 1
        return torn

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(write, range(8))) == 0
    assert list(tmp_path.iterdir()) == [file]


WRITER = """
import os, sys
from pathlib import Path
if not os.environ.get("IN_A_NAMESPACE"):
    os.getpid = lambda: 1  # as in a container
assert os.getpid() == 1
from dq_space_arm_env.common.files import write_atomically
print("ready", flush=True)
sys.stdin.readline()
for _ in range(300):
    write_atomically(Path(sys.argv[1]), sys.argv[2] * 50_000)
"""


@pytest.mark.parametrize("container", [[], ["unshare", "--pid", "--fork"]], ids=["patched", "namespaces"])
def test_processes_of_the_same_number_never_meet(tmp_path: Path, container: list[str]) -> None:
    if container and (shutil.which("unshare") is None or subprocess.run([*container, "true"]).returncode):
        pytest.skip("no permission to make namespaces")
    file = tmp_path / "a.txt"
    commands = [[*container, sys.executable, "-c", WRITER, str(file), letter] for letter in "ab"]
    environment = {**os.environ, "IN_A_NAMESPACE": "yes" if container else ""}
    writers = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
        for command in commands
    ]
    for writer in writers:
        assert writer.stdout is not None
        writer.stdout.readline()
    for writer in writers:
        assert writer.stdin is not None
        writer.stdin.write("\n")
        writer.stdin.flush()
    for writer in writers:
        writer.communicate(timeout=60)
        assert writer.returncode == 0
    assert file.read_text() in ("a" * 50_000, "b" * 50_000)
    assert list(tmp_path.iterdir()) == [file]


def test_leftovers_of_killed_processes_are_removed_once_they_are_old(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    old, new, others = (tmp_path / temporary_name(name) for name in ("a.txt", "a.txt", "b.txt"))
    theirs = [tmp_path / name for name in (".a.txt.part", ".a.txt.123.part", ".a.txt.swp")]
    for path in (old, new, others, *theirs):
        path.write_text("half")
        os.utime(path, (time.time() - 86_500,) * 2)
    os.utime(new)
    write_atomically(file, "text")
    assert set(tmp_path.iterdir()) == {file, new, others, *theirs}
    unfinished = tmp_path / temporary_name("demonstrations")
    unfinished.mkdir()
    (unfinished / "shard").write_text("half of it")
    remove_leftovers(tmp_path)  # in a folder that is locked
    assert set(tmp_path.iterdir()) == {file, *theirs}


@posix
def test_a_killed_writer_leaves_the_old_file_whole(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    write_atomically(file, "a" * 50_000)
    command = [sys.executable, "-c", WRITER.replace("range(300)", "iter(int, 1)"), str(file), "b"]
    for wait in (0.0, 0.01, 0.03):
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdin is not None
            assert writer.stdout is not None
            writer.stdout.readline()
            writer.stdin.write("\n")
            writer.stdin.flush()
            time.sleep(wait)
            writer.kill()
        assert file.read_text() in ("a" * 50_000, "b" * 50_000)
    remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [file]


@posix
def test_a_private_file_replaces_what_is_there(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_bytes(b"old")
    link.symlink_to(target)
    write_privately(link, b"new")
    assert (link.read_bytes(), link.is_symlink(), target.read_bytes()) == (b"new", False, b"old")
    assert stat.S_IMODE(link.stat().st_mode) == 0o600


def test_a_leftover_of_just_the_age_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leftover = tmp_path / temporary_name("a.txt")
    leftover.touch()
    os.utime(leftover, (1000.0, 1000.0))
    monkeypatch.setattr(time, "time", lambda: 1060.0)
    remove_leftovers(tmp_path, age=60.5)
    assert leftover.exists()
    remove_leftovers(tmp_path, age=60.0)
    assert not leftover.exists()


def test_json_has_no_infinity_and_no_tuple() -> None:
    value = {"a": (1, [math.nan, (math.inf,)]), "b": 2.5, "c": "x", "d": None, "e": True}
    assert json_value(value) == {"a": [1, [None, [None]]], "b": 2.5, "c": "x", "d": None, "e": True}
