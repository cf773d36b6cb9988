"""The cached code of loops: found by other processes, checked before it is parsed, done without."""

import importlib.util
import os
import pickle
import pkgutil
import random
import subprocess
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from dq_space_arm_env.common import code_cache

LOOPS = """
from experts.native.compilation import compiled

FACTOR = 2.0

@compiled
def twice_the_sum(values):
    total = 0.0
    for value in values:
        total += value
    return FACTOR * total
"""
numbers = count()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def run(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[float, int]]:
    """Import the loop as a new process would, and call it: its result, and how often it was compiled."""
    # Bytecode of a source that changes within a second, to the same length, would be taken for up to date.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    source = tmp_path / "loops.py"
    source.write_text(LOOPS)

    def use() -> tuple[float, int]:
        specification = importlib.util.spec_from_file_location(f"loops_{next(numbers)}", source)
        assert specification is not None
        assert specification.loader is not None
        module = importlib.util.module_from_spec(specification)
        sys.modules[module.__name__] = module  # unpickling looks there
        specification.loader.exec_module(module)
        loop: Any = module.twice_the_sum
        return loop(np.arange(4.0)), sum(loop.stats.cache_misses.values())

    return use


def the_file(cache: Path) -> Path:
    (path,) = cache.glob("loops.twice_the_sum-*.kernel")
    return path


def test_a_second_process_compiles_nothing(cache: Path, run: Callable[[], tuple[float, int]]) -> None:
    assert run() == (12.0, 1)
    assert run() == (12.0, 0)
    assert the_file(cache).stat().st_mode & 0o777 == 0o600 or os.name == "nt"


def test_changed_source_is_compiled_again(
    cache: Path, tmp_path: Path, run: Callable[[], tuple[float, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from experts.native import loop_cache

    assert run() == (12.0, 1)
    loop_cache._source_hash.cache_clear()  # a process reads the source once
    (tmp_path / "loops.py").write_text(LOOPS.replace("2.0", "3.0"))
    assert run() == (18.0, 1)
    monkeypatch.setattr(loop_cache.numba, "__version__", "0.0.0")
    assert run() == (18.0, 1)


def truncated(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(len(content))]


def zeroed(content: bytes, chance: random.Random) -> bytes:
    begin = chance.randrange(len(content) // 2)
    return content[:begin] + bytes(len(content) - begin)


def flipped(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    changed[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def other(content: bytes, chance: random.Random) -> bytes:
    return pickle.dumps(print) + chance.randbytes(100)


@pytest.mark.parametrize("damage", [truncated, zeroed, flipped, other])
@pytest.mark.parametrize("times", [3, pytest.param(300, marks=pytest.mark.endurance)])
def test_a_damaged_file_is_never_parsed(
    damage: Callable[[bytes, random.Random], bytes],
    times: int,
    cache: Path,
    run: Callable[[], tuple[float, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert run() == (12.0, 1)
    sound, chance = the_file(cache).read_bytes(), random.Random(0)
    parsed: list[bytes] = []
    loads = pickle.loads
    monkeypatch.setattr(pickle, "loads", lambda content: parsed.append(content) or loads(content))
    for _ in range(times):
        the_file(cache).write_bytes(damage(sound, chance))
        with pytest.warns(
            UserWarning, match=r"loops.twice_the_sum-\w+.kernel is damaged; its code is compiled"
        ):
            assert run() == (12.0, 1)
        assert parsed == []
        assert run() == (12.0, 0)
        assert len(parsed) == 1
        parsed.clear()


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_a_file_that_others_can_write_is_never_parsed(
    mode: int, cache: Path, run: Callable[[], tuple[float, int]]
) -> None:
    assert run() == (12.0, 1)
    the_file(cache).chmod(mode)
    with pytest.warns(UserWarning, match="can be written by others"):
        assert run() == (12.0, 1)
    assert run() == (12.0, 0)


def test_a_full_disk_costs_only_the_cache(
    cache: Path, run: Callable[[], tuple[float, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(code_cache, "write_privately", full)
        for _ in range(2):
            with pytest.warns(
                UserWarning, match=r"cannot keep machine code in .* \(No space left on device\)"
            ):
                assert run() == (12.0, 1)
    assert run() == (12.0, 1)
    assert run() == (12.0, 0)


def test_a_cache_that_cannot_be_a_folder_costs_only_the_cache(
    tmp_path: Path, run: Callable[[], tuple[float, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="cannot keep machine code"):
        assert run() == (12.0, 1)


def test_every_loop_of_the_solver_is_behind_the_guard() -> None:
    import experts
    from experts.native import compilation
    from experts.native.loop_cache import LoopCache

    for module in pkgutil.walk_packages(experts.__path__, "experts."):
        if module.name.startswith(("experts.ddp", "experts.native")):
            importlib.import_module(module.name)
    loops = {
        value
        for name, module in sys.modules.items()
        if name.startswith("experts.")
        for value in vars(module).values()
        if isinstance(value, Dispatcher)
    }
    assert len(loops) > 30
    kept = {loop for loop in loops if type(loop) is not compilation._PartDispatcher}
    assert 10 < len(kept) < len(loops)
    assert all(type(loop._cache) is LoopCache for loop in kept)


def test_a_part_of_loops_is_compiled_within_them_and_cannot_be_called() -> None:
    from experts.native.compilation import compiled, part

    @part
    def plus_one(value: float) -> float:
        return value + 1.0

    @compiled
    def plus_two(value: float) -> float:
        return plus_one(plus_one(value))

    assert plus_two(1.5) == 3.5
    for argument in (1.5, 1):  # of a type that it was compiled for, and of another
        with pytest.raises(TypeError, match=r"plus_one is a part of compiled loops"):
            plus_one(argument)


FULL_DISK = """
import ctypes, runpy, sys
if ctypes.CDLL(None).mount(b"tmpfs", sys.argv[1].encode(), b"tmpfs", 0, b"size=4k"):
    sys.exit(77)
print(runpy.run_path(sys.argv[2])["twice_the_sum"]((1.0, 2.0)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a small disk")
def test_a_loop_runs_on_a_full_disk(cache: Path, tmp_path: Path) -> None:
    cache.mkdir()
    (tmp_path / "loops.py").write_text(LOOPS)
    command = ["unshare", "--mount", sys.executable, "-c", FULL_DISK, str(cache), str(tmp_path / "loops.py")]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    try:
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("unshare is missing")
    if ended.returncode == 77 or "unshare failed" in ended.stderr:
        pytest.skip("mounting needs the superuser")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == "6.0\n"
    assert "cannot keep machine code" in ended.stderr
    assert "No space left on device" in ended.stderr
