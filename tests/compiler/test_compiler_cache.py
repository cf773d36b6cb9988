"""The cache of object files: found by other processes, never trusted when damaged or foreign."""

import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env.command_line.info import caches
from dq_space_arm_env.common import code_cache
from dq_space_arm_env.common.code_cache import cache_key
from dq_space_arm_env.compiler import native
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.kernels import library

posix = pytest.mark.skipif(os.name == "nt", reason="POSIX permissions and files")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@posix
@pytest.mark.parametrize("answer", [RuntimeError("could not determine the home directory"), "~/.cache/it"])
def test_a_user_without_a_home_has_a_cache_of_temporary_files(answer, tmp_path, monkeypatch):
    def folder_of(name):
        if isinstance(answer, str):
            return answer
        raise answer

    monkeypatch.delenv("DQ_SPACE_ARM_CACHE", raising=False)
    monkeypatch.setattr("platformdirs.user_cache_dir", folder_of)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert code_cache.cache_directory() == tmp_path / f"dq-space-arm-{os.getuid()}"
    assert caches()["writable"]


@posix
def test_a_folder_in_ones_home_may_be_written_short(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for given, folder in (("~/kernels", tmp_path / "kernels"), ("/a/~", Path("/a/~"))):
        monkeypatch.setenv("DQ_SPACE_ARM_CACHE", given)
        assert code_cache.cache_directory() == folder


class Builder:
    """Builds y = factor x and counts how often it is asked to."""

    def __init__(self, factor=2.0):
        self.factor, self.calls = factor, 0

    def __call__(self):
        self.calls += 1
        graph = trace("graph", {"x": 1}, lambda x: {"y": [self.factor * x[0]]})
        program = Program("double", [Buffer("x", 1)], [Buffer("y", 1)])
        program.call(graph)
        return build_program(program, 1)


def value(kernel):
    x, y = np.array([[3.0]]), np.zeros((1, 1))
    buffers = np.array([x.ctypes.data, y.ctypes.data], dtype=np.int64)
    kernel.function(0, 1, buffers.ctypes.data)
    return y[0, 0]


def load(builder, key="key"):
    return native.load_or_build("double", cache_key(key), builder)


def the_file(cache):
    (path,) = cache.glob("*.kernel")
    return path


def test_a_second_load_builds_nothing(cache):
    builder = Builder()
    assert value(load(builder)) == 6.0
    assert value(load(builder)) == 6.0
    assert builder.calls == 1
    assert value(load(Builder(5.0), "another key")) == 15.0


def flip(position):
    def flipped(content):
        content = bytearray(content)
        content[position] ^= 1
        return content

    return flipped


FOREIGN = [b"", code_cache._MAGIC, b"\x7fELF" + bytes(1000)]


@pytest.mark.parametrize(
    "damage", [flip(0), flip(40), flip(-1), *(lambda _, content=content: content for content in FOREIGN)]
)
def test_a_damaged_or_foreign_file_is_rebuilt_once(cache, damage):
    builder = Builder()
    load(builder)
    path = the_file(cache)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=r"double-\w+\.kernel is damaged; its code is compiled again"):
        assert value(load(builder)) == 6.0
    assert value(load(builder)) == 6.0
    assert builder.calls == 2


def test_a_sound_file_under_the_wrong_name_is_rebuilt(cache):
    load(Builder(5.0), "other")
    foreign = the_file(cache)
    load(Builder(2.0))
    (own,) = set(cache.glob("*.kernel")) - {foreign}
    own.write_bytes(foreign.read_bytes())
    builder = Builder(2.0)
    with pytest.warns(UserWarning, match="is damaged"):
        assert value(load(builder)) == 6.0
    assert builder.calls == 1


@posix
@pytest.mark.parametrize("mode", [0o660, 0o602, 0o666])
def test_a_file_that_others_can_write_is_rebuilt(cache, mode):
    builder = Builder()
    load(builder)
    the_file(cache).chmod(mode)
    with pytest.warns(UserWarning, match="can be written by others"):
        load(builder)
    load(builder)
    assert builder.calls == 2
    assert stat.S_IMODE(the_file(cache).stat().st_mode) == 0o600


@posix
def test_a_file_of_another_user_is_rebuilt(cache, monkeypatch):
    builder = Builder()
    load(builder)
    monkeypatch.setattr(os, "getuid", lambda: the_file(cache).stat().st_uid + 1)
    with pytest.warns(UserWarning, match="belongs to another user"):
        assert value(load(builder)) == 6.0
    assert builder.calls == 2


@posix
@pytest.mark.parametrize("kind", ["pipe", "link to a device"])
def test_what_is_no_regular_file_is_replaced(cache, kind):
    builder = Builder()
    load(builder)
    path = the_file(cache)
    path.unlink()
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    with pytest.warns(UserWarning, match="it should be a regular file; its code is compiled again"):
        assert value(load(builder)) == 6.0
    assert path.is_file()
    assert not path.is_symlink()


def test_where_the_folder_cannot_be_looked_into_there_is_no_code(tmp_path, monkeypatch):
    # Like a folder that may not be entered, which is none for the superuser.
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / ("long" * 100)))
    assert not code_cache.is_kept("code", "0" * 64)
    found = caches()
    assert (found["writable"], found["compiled kernels"]["files"]) == (True, 0)


@posix
def test_code_is_never_written_through_a_link(cache, tmp_path):
    load(Builder())
    path, other = the_file(cache), tmp_path / "other"
    path.rename(tmp_path / "elsewhere")
    other.write_text("mine")
    path.symlink_to(other)
    with pytest.warns(UserWarning, match="is damaged|can be written"):
        load(Builder())
    assert other.read_text() == "mine"


def test_the_files_unused_for_longest_are_removed_above_the_limit(cache, monkeypatch):
    for number in range(6):
        code_cache.keep_code("code", f"{number}" * 64, bytes(1000))
        os.utime(cache / f"code-{str(number) * 32}.kernel", (number, number))
    leftover = cache / f".{the_first(cache)}.0123456789abcdef.part"
    leftover.touch()
    os.utime(leftover, (0, 0))
    (cache / "notes.txt").write_text("of others")
    assert code_cache.read_code("code", "0" * 64) == bytes(1000)  # used again: now the newest
    monkeypatch.setattr(code_cache, "LIMIT", 4000)
    code_cache.keep_code("code", "6" * 64, bytes(1000))
    assert sorted(path.name[5] for path in cache.glob("*.kernel")) == ["0", "5", "6"]
    assert {path.name for path in cache.iterdir() if path.suffix != ".kernel"} == {"notes.txt"}


def the_first(cache):
    return min(path.name for path in cache.iterdir())


def test_a_process_that_trims_disturbs_no_reader(cache, monkeypatch):
    monkeypatch.setattr(code_cache, "LIMIT", 20_000)

    def use(thread):
        wrong = 0
        for turn in range(200):
            key = f"{(thread + turn) % 16:032x}" * 2
            code = code_cache.read_code("code", key)
            if code is None:
                code_cache.keep_code("code", key, key.encode() * 40)
            else:
                wrong += code != key.encode() * 40
        return wrong

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(use, range(8))) == 0
    assert sum(path.stat().st_size for path in cache.iterdir()) <= 20_000 + 8 * 3000


@posix
def test_a_full_disk_costs_only_the_cache(cache):
    with limited_file_size(1000), pytest.warns(UserWarning, match="cannot keep machine code"):
        assert value(load(Builder())) == 6.0
    assert list(cache.iterdir()) == []


@contextmanager
def limited_file_size(size):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_file_is_replaced_and_never_written_in_place(cache, tmp_path):
    """Another process may have the old one open."""
    load(Builder())
    path, old = the_file(cache), tmp_path / "old"
    path.write_bytes(b"damaged")
    os.link(path, old)
    with pytest.warns(UserWarning, match="is damaged"):
        load(Builder())
    assert old.read_bytes() == b"damaged"
    assert path.read_bytes() != b"damaged"


def test_a_folder_that_cannot_be_written_costs_only_the_cache(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(blocked / "cache"))
    with pytest.warns(UserWarning, match="DQ_SPACE_ARM_CACHE"):
        assert value(load(Builder())) == 6.0


SECOND_PROCESS = """
import sys
from dq_space_arm_env import compile_scene
kernels = compile_scene("planar")
print(repr(kernels.step(kernels.layout.initial_state, [0.1] * kernels.n_u).tolist()))
print("casadi" in sys.modules)
"""


def run_process(cache, code=SECOND_PROCESS):
    environment = {**os.environ, "DQ_SPACE_ARM_CACHE": str(cache)}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)


@pytest.mark.slow
def test_a_second_process_neither_traces_nor_compiles(cache):
    first, second = (run_process(cache).stdout.split("\n") for _ in range(2))
    assert first[0] == second[0]
    assert (first[1], second[1]) == ("True", "False")


@pytest.mark.slow
def test_code_of_another_casadi_is_not_taken(monkeypatch):
    assert library.source_hash.__wrapped__() == library.source_hash()
    monkeypatch.setattr(library, "version", lambda package: f"another {package}")
    assert library.source_hash.__wrapped__() != library.source_hash()


def test_scenes_share_the_code_of_what_does_not_depend_on_their_difference(cache, short_scene, monkeypatch):
    built = []

    def noting(program, *arguments):
        built.append(program.name)
        return build_program(program, *arguments)

    monkeypatch.setattr("dq_space_arm_env.compiler.build.build_program", noting)
    nearer = short_scene.replace(target={"pose": {"position": [0.5, 0.4, 0.0]}}, cost={"joint_torque": 3})
    lighter = short_scene.replace(base={"mass": 15})
    x, u = library.KernelLibrary(short_scene).layout.initial_state, [0.1, 0.1]
    steps, costs = (
        [library.KernelLibrary(scene).call(name, x=x, u=u)[0] for scene in (short_scene, nearer, lighter)]
        for name in ("step", "cost")
    )
    assert built == ["step", "step", "cost", "cost"]  # the lighter base's step, the nearer target's cost
    np.testing.assert_array_equal(steps[0], steps[1])
    assert not np.array_equal(steps[0], steps[2])
    assert costs[0] != costs[1]


def test_code_that_was_removed_is_compiled_again_where_scenes_refer_to_it(cache, short_scene):
    x = library.KernelLibrary(short_scene).layout.initial_state
    first = library.KernelLibrary(short_scene).call("tip_pose", x=x)[0]
    (code,) = cache.glob("tip_pose-*.kernel")
    code.unlink()
    np.testing.assert_array_equal(library.KernelLibrary(short_scene).call("tip_pose", x=x)[0], first)
    assert code.is_file()


def test_a_first_use_says_that_it_compiles_and_where_the_result_is(cache):
    code = SECOND_PROCESS + "kernels.linearize(kernels.layout.initial_state, [0.0] * kernels.n_u)\n"
    first, second = (run_process(cache, code).stderr for _ in range(2))
    assert "compiling what is used of scene 'planar' for the first time" in first
    assert str(cache) in first
    assert second == ""


@pytest.mark.slow
def test_two_processes_at_once_agree(cache):
    with ThreadPoolExecutor() as pool:
        outputs = pool.map(run_process, [cache] * 3)
    assert len({output.stdout.split("\n")[0] for output in outputs}) == 1
    assert not list(cache.glob(".*"))
