"""Runs of the program that a supervisor disturbs at a chosen moment, and what must hold afterwards.

Runs are forked from a server that has imported everything, in a session of their own. A moment is a time
after the start, or a change of a file in the run's folder, at which the run waits for the supervisor's blow.
"""

import ctypes
import io
import json
import multiprocessing
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
CACHE = "cache"
PRELOADED = ("warm_imports",)
TIMES = re.compile(r"second|date$|provenance|^host|^machine|commit|rate$|versions|^file$|^rss|times?$")
"""Keys of what differs from run to run."""


@dataclass(frozen=True)
class Undertaking:
    """A command that writes; `{inputs}` in its words is the folder of `inputs`."""

    name: str
    command: str
    exact: tuple[str, ...] = ()  # files whose content a disturbed and repeated run repeats, times apart
    loose: tuple[str, ...] = ()  # files that may be there or not
    program: str = "dq_space_arm_env.command_line"
    once: bool = False  # refused where its file exists
    weight: float = 1.0  # share of the moments that are tried


# --- the run ---


def _run(words, program, folder, environment, output, powerless, gate):
    """Body of a forked run."""
    os.setsid()
    os.chdir(folder)
    os.environ.update(environment)
    for descriptor in (1, 2):
        os.dup2(os.open(f"{output}.{descriptor}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    main = import_module(program).main
    if powerless:
        _drop_capabilities()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    count = _watch(folder, gate)
    gate.send(-1)  # ready
    status = main(words)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdout.flush()
    sys.stderr.flush()
    with suppress(OSError):
        gate.send(count())
    os._exit(status)


def _drop_capabilities():
    """Let root be refused like anybody else."""
    header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(header, none):
        raise OSError(ctypes.get_errno(), "capset")


def _watch(folder, gate):
    """Count the changes of files below a folder, and wait at the one that the supervisor names."""
    count, at = 0, gate.recv()
    writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT
    changes = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate")

    def hook(event, arguments):
        nonlocal count
        if event not in changes and not (event == "open" and arguments[2] & writing):
            return
        path = arguments[0]
        if isinstance(path, str | os.PathLike) and Path(path).absolute().is_relative_to(folder):
            count += 1
            if count == at:
                gate.send(count)
                gate.recv()

    sys.addaudithook(hook)
    return lambda: count


class Run:
    """A forked run of an undertaking."""

    def __init__(self, undertaking, attempt, *, at=None, powerless=False, number=0):
        server = multiprocessing.get_context("forkserver")
        server.set_forkserver_preload(list(PRELOADED))
        self._gate, other = server.Pipe()
        self._output = f"{attempt.folder}.{number}"
        arguments = (
            attempt.words(undertaking), undertaking.program, str(attempt.folder), attempt.environment,
            self._output, powerless, other,
        )  # fmt: skip
        self._process = server.Process(target=_run, args=arguments)
        self._process.start()
        other.close()
        self.pid = self._process.pid
        self._gate.send(at)
        self._gate.recv()

    def reach(self, seconds, at):
        """Wait for a moment: some seconds, or a change of a file."""
        if self._gate.poll(seconds if at is None else 60.0) and at is not None:
            with suppress(EOFError):
                self._gate.recv()

    def release(self):
        """Let it go on."""
        with suppress(OSError):
            self._gate.send(0)

    def strike(self, number, *, group=False):
        with suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(self.pid, number)

    def end(self, limit):
        """Wait for the end; the exit status, or None if it hangs."""
        self._process.join(limit)
        status = self._process.exitcode
        if status is None:
            self.strike(signal.SIGKILL, group=True)
            self._process.join(10.0)
        return status

    def changes(self):
        """Number of changes of files, of a run that has ended."""
        found = 0
        with suppress(EOFError):
            while self._gate.poll():
                found = self._gate.recv()
        return found

    def errors(self):
        return Path(f"{self._output}.2").read_text(errors="replace")

    def orphans(self, patience=5.0):
        """Processes of its session that outlive it; they are ended."""
        deadline = time.monotonic() + patience
        while (left := _session(self.pid)) and time.monotonic() < deadline:
            time.sleep(0.1)
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return left


class Container:
    """A run in a fresh interpreter and a PID namespace of its own."""

    def __init__(self, undertaking, attempt, number):
        self._errors = Path(f"{attempt.folder}.{number}.2")
        unshare = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc", sys.executable, "-c"]
        start = f"import sys; from {undertaking.program} import main; sys.exit(main(sys.argv[1:]))"
        with self._errors.open("w") as errors:
            self._process = subprocess.Popen(
                [*unshare, start, *attempt.words(undertaking)], cwd=attempt.folder, start_new_session=True,
                env={**os.environ, **attempt.environment}, stdout=subprocess.DEVNULL, stderr=errors,
            )  # fmt: skip
        self.pid = self._process.pid

    strike, orphans = Run.strike, Run.orphans

    def end(self, limit):
        try:
            return self._process.wait(limit)
        except subprocess.TimeoutExpired:
            self.strike(signal.SIGKILL, group=True)
            return None

    def errors(self):
        return self._errors.read_text()


def _session(leader):
    """Processes of a session that live."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, *_, session = path.read_text().rpartition(")")[2].split()[:4]
            if int(session) == leader and state != "Z":
                found.append(int(path.parent.name))
    return found


# --- what is on disk ---


class Attempt:
    """A folder to run an undertaking in, with a copy of the cache; on a small disk if it is to fill up."""

    def __init__(self, inputs, cache, folder, *, disk=None):
        self.inputs, self.folder = inputs, folder
        folder.mkdir(parents=True)
        self._mounted = disk is not None
        if self._mounted:
            size = ["-o", f"size={disk}", "none", str(folder)]
            subprocess.run(["mount", "-t", "tmpfs", *size], check=True, capture_output=True)
        shutil.copytree(cache, folder / CACHE)
        data_sets = folder / "minari"
        data_sets.mkdir()
        self.environment = {
            "DQ_SPACE_ARM_CACHE": str(folder / CACHE),
            "MINARI_DATASETS_PATH": str(data_sets),
            "COLUMNS": "200",
        }
        self._closed = {}

    def words(self, undertaking):
        return [word.format(inputs=self.inputs) for word in undertaking.command.split()]

    def fill(self, left):
        """Fill the disk but for some bytes."""
        with (self.folder / ".filler").open("wb") as file:
            disk = os.statvfs(self.folder)
            with suppress(OSError):
                os.posix_fallocate(file.fileno(), 0, max(disk.f_bavail * disk.f_frsize - left, 1))

    def forbid(self):
        """Take the permission to write away from all folders."""
        for folder, names, _ in os.walk(self.folder):
            names[:] = [name for name in names if name != CACHE]
            self._closed[Path(folder)] = Path(folder).stat().st_mode
            Path(folder).chmod(0o555)

    def heal(self):
        """Make room, give permissions back, and let a day pass: temporary files are stale then."""
        while self._closed:
            folder, mode = self._closed.popitem()
            folder.chmod(mode)
        (self.folder / ".filler").unlink(missing_ok=True)
        for path in self.folder.rglob(".*.part"):
            os.utime(path, (0.0, 0.0))

    def files(self):
        """Files outside of the cache, by their names."""
        paths = (path for path in self.folder.rglob("*") if path.is_file() or path.is_symlink())
        names = {path.relative_to(self.folder).as_posix(): path for path in paths}
        return {name: path for name, path in names.items() if not name.startswith(CACHE + "/")}

    def remove(self):
        if self._mounted:
            subprocess.run(["umount", "-l", str(self.folder)], check=True)
        shutil.rmtree(self.folder)
        for path in self.folder.parent.glob(f"{self.folder.name}.*"):
            path.unlink()


def content(path):
    """What a file holds, without times; fails if it is not complete."""
    data, kind = path.read_bytes(), path.suffix
    if kind == ".json":
        return _timeless(json.loads(data))
    if kind == ".jsonl":
        return [_timeless(json.loads(line)) for line in data.splitlines()]
    if kind == ".npz":
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: _array(arrays[name]) for name in arrays.files}
    if kind == ".zip":
        import torch

        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            assert archive.testzip() is None
            weights = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        return {name: array.numpy().tobytes() for name, array in weights.items()}
    if kind == ".hdf5":
        import h5py

        with h5py.File(path) as file:
            arrays = {}
            file.visititems(arrays.__setitem__)
            return {name: item[()].tobytes() for name, item in arrays.items() if hasattr(item, "dtype")}
    if kind == ".html":
        assert data.rstrip().endswith(b"</html>")
    if kind == ".png":
        assert data.endswith(b"IEND\xaeB`\x82")
    if kind in (".yaml", ".md", ".xml", ".urdf"):
        assert data.endswith(b"\n")
    return data


def _array(array):
    if array.dtype.names is not None:
        return {name: array[name].tobytes() for name in array.dtype.names if not TIMES.search(name)}
    text = str(array) if array.dtype.kind == "U" and array.ndim == 0 else ""
    return _timeless(json.loads(text)) if text.startswith("{") else array.tobytes()


def _timeless(value):
    if isinstance(value, dict):
        return {key: _timeless(part) for key, part in value.items() if not TIMES.search(key)}
    return [_timeless(part) for part in value] if isinstance(value, list) else value


def matches(name, patterns):
    return any(fnmatch(name, pattern) for pattern in patterns)


# --- disturbances ---

ALONE = ("SIGKILL", "SIGTERM", "SIGINT", "SIGSTOP", "full disk", "short files", "no memory", "no permission")
TOGETHER = ("two, one killed", "stopped, another started", "two containers, one killed")
DISTURBANCES = (*ALONE, *TOGETHER)
_SIGNALS = {"SIGKILL": False, "SIGTERM": False, "SIGINT": True, "two, one killed": False}
"""Whether a signal goes to the whole group, as from a terminal."""


@dataclass
class Undisturbed:
    """What a run leaves where nobody disturbs it."""

    status: int
    seconds: float
    changes: int
    files: dict[str, object]

    @classmethod
    def of(cls, undertaking, attempt, cache):
        """Run it; its compiled kernels join the cache of the attempts."""
        run = Run(undertaking, attempt)
        began = time.monotonic()
        status = run.end(600.0)
        seconds = time.monotonic() - began
        assert status in (0, 1), run.errors()
        for kernel in (attempt.folder / CACHE).glob("*.kernel"):
            if not (cache / kernel.name).exists():
                shutil.copy2(kernel, cache)
        files = {name: content(path) for name, path in attempt.files().items()}
        return cls(status, seconds, run.changes(), files)


class FailedError(AssertionError):
    """What must hold does not."""


def disturb(undertaking, whole, attempt, disturbance, rng):
    """Disturb a run at a random moment, repeat it, and judge both.

    Returns "finished" if it ended well all the same; else "same", or "refused" where its file was there.
    """
    limit = 60.0 + 20.0 * whole.seconds
    at = int(rng.integers(1, whole.changes + 1)) if rng.random() < 0.5 else None
    seconds = float(rng.uniform(0.0, whole.seconds))
    moment = f"{disturbance} at {f'{seconds:.3f} s' if at is None else f'change {at}'}"
    runs, allowed = _struck(undertaking, attempt, disturbance, rng, seconds, at, limit)
    try:
        for run, status in runs:
            _judge_run(run, status, allowed if run is runs[0][0] else ())
        attempt.heal()
        _judge_files(whole, undertaking, attempt.files(), complete=False)
        again = Run(undertaking, attempt, number=9)
        status = again.end(limit)
        _judge_run(again, status, ())
        if status != whole.status and not (undertaking.once and "exists" in again.errors()):
            raise FailedError(f"repeated: exit status {status}: {again.errors()[-500:]}")
        _judge_files(whole, undertaking, attempt.files(), complete=True, swept=status == whole.status)
    except FailedError as failure:
        raise FailedError(f"{undertaking.name}, {moment}: {failure}") from failure
    if runs[0][1] == whole.status:
        return "finished"
    return "same" if status == whole.status else "refused"


def _struck(undertaking, attempt, disturbance, rng, seconds, at, limit):
    """Run until the moment and beyond; runs with exit statuses, and what the first one may end with."""
    if disturbance == "two containers, one killed":
        both = [Container(undertaking, attempt, number) for number in range(2)]
        time.sleep(seconds + rng.uniform(0.0, 3.0))
        both[0].strike(signal.SIGKILL)
        return [(run, run.end(limit)) for run in both], (-signal.SIGKILL,)
    first = Run(undertaking, attempt, at=at, powerless=disturbance == "no permission")
    others = [Run(undertaking, attempt, number=1)] if disturbance == "two, one killed" else []
    first.reach(seconds, at)
    allowed = ()
    if disturbance in _SIGNALS:
        number = signal.Signals[disturbance] if disturbance in signal.Signals.__members__ else signal.SIGKILL
        first.strike(number, group=_SIGNALS[disturbance])
        allowed = (130,) if number == signal.SIGINT else (-number,)
    elif disturbance == "SIGSTOP":
        first.strike(signal.SIGSTOP, group=True)
        time.sleep(0.1)
        first.strike(signal.SIGCONT, group=True)
    elif disturbance == "stopped, another started":
        first.strike(signal.SIGSTOP, group=True)
        others.append(Run(undertaking, attempt, number=1))
        others = [(others[0], others[0].end(limit))]
        first.strike(signal.SIGCONT, group=True)
    elif disturbance == "full disk":
        attempt.fill(int(rng.integers(0, 2**15)))
    elif disturbance == "no permission":
        attempt.forbid()
    else:
        with suppress(ProcessLookupError, FileNotFoundError):
            _limit(first.pid, disturbance, rng)
        # Libraries that do not check what they allocate crash.
        allowed = (-signal.SIGABRT, -signal.SIGSEGV) if disturbance == "no memory" else ()
    first.release()
    ended = [(first, first.end(limit))]
    return ended + [run if isinstance(run, tuple) else (run, run.end(limit)) for run in others], allowed


def _limit(pid, what, rng):
    if what == "short files":
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (int(rng.integers(0, 8192)),) * 2)
        return
    size = int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()
    resource.prlimit(pid, resource.RLIMIT_AS, (size + int(rng.integers(0, 2**24)),) * 2)


def _judge_run(run, status, allowed):
    """A run ends as it may, says so in a sentence, and leaves no process."""
    said = run.errors()
    if status is None:
        raise FailedError(f"it hangs: {said[-500:]}")
    if left := run.orphans():
        raise FailedError(f"it leaves processes: {left}")
    if status in allowed and status < 0:
        return
    # Without memory the interpreter complains of callbacks that fail.
    excused = -signal.SIGABRT in allowed and (status == 0 or re.search("^Error: ", said, re.MULTILINE))
    if ("Traceback" in said or "Exception ignored" in said) and not excused:
        raise FailedError(f"exit status {status} with a traceback: {said[-3000:]}")
    if status == 130 and status in allowed:
        if len(re.findall("^Interrupted: ", said, re.MULTILINE)) != 1:
            raise FailedError(f"interrupted without a sentence: {said[-500:]}")
    elif status not in (0, 1, 2):
        raise FailedError(f"exit status {status}: {said[-500:]}")
    elif status == 2 and len(re.findall("^Error: ", said, re.MULTILINE)) != 1:
        raise FailedError(f"exit status {status} without a sentence: {said[-500:]}")


def _judge_files(whole, undertaking, files, *, complete, swept=True):
    """Every file with a proper name is whole; at the end they are those of an undisturbed run."""
    found = {}
    for name, path in files.items():
        if matches(name, undertaking.loose) or path.name.startswith(".") or "/." in f"/{name}":
            continue
        try:
            found[name] = content(path)
        except Exception as error:
            raise FailedError(f"{name} is not whole: {error!r}") from error
    if not complete:
        return
    names = {name for name in files if not matches(name, undertaking.loose)}
    if not swept:  # a refused run does not sweep
        names = {name for name in names if not name.endswith(".part")}
    expected = {name for name in whole.files if not matches(name, undertaking.loose)}
    if names != expected:
        raise FailedError(f"left over: {sorted(names - expected)}; missing: {sorted(expected - names)}")
    for name, value in found.items():
        if matches(name, undertaking.exact) and value != whole.files[name]:
            raise FailedError(f"{name} differs from an undisturbed run's")
