"""`dq-space-arm demonstrations generate`: its messages, and that an interrupted run can be resumed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main
from experts import load_demonstrations

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "dq_space_arm_env", "demonstrations", "generate"]


def run(arguments: Sequence[str]) -> int:
    return main(["demonstrations", "generate", *arguments])


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "quick.yaml"
    load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150}).to_yaml(path)
    return str(path)


def contents(folder: Path) -> dict[str, bytes]:
    """What follows from the settings: not who took how long."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    names = ("log", "summary")
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in files if path.parent.name not in names
    }


@pytest.mark.slow
def test_it_generates_says_so_and_resumes(scene_file: str, tmp_path: Path, capsys):
    arguments = ["--scene", scene_file, "-n", "6", "--shard-size", "2", "--workers", "1"]
    arguments += ["--out", str(tmp_path / "data")]
    assert run([*arguments, "--shard", "2/2"]) == 0
    assert "this part is done; other parts are still missing" in " ".join(capsys.readouterr().out.split())
    assert run(arguments) == 0
    output = capsys.readouterr().out
    assert "6 of 6 problems (2 found), 100.0% demonstrations" in output
    assert "6 demonstrations." in output
    assert len(load_demonstrations(tmp_path / "data", verify=True)) == 6
    assert run([*arguments, "--seed", "1"]) == 1
    errors = " ".join(capsys.readouterr().err.split())
    assert "was started with different settings: seed is 0 there and 1 here" in errors


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--scene", "papper"], "did you mean 'paper'"),
        (["-n", "0"], "n: 0, should be at least 1"),
    ],
)
def test_unusable_input_ends_with_a_sentence(arguments: list[str], sentence: str, tmp_path: Path, capsys):
    assert run([*arguments, "--out", str(tmp_path / "data")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("part", ["0/2", "3/2", "1-2", "one"])
def test_a_part_has_to_be_one(part: str, capsys):
    assert run(["--shard", part]) == 2
    assert "use I/K" in " ".join(capsys.readouterr().err.split())


def test_a_folder_that_cannot_be_written_ends_with_a_sentence(scene_file: str, tmp_path: Path, capsys):
    (tmp_path / "file").touch()
    assert run(["--scene", scene_file, "-n", "2", "--out", str(tmp_path / "file" / "data")]) == 2
    assert "file is not a folder" in " ".join(capsys.readouterr().err.split())


def start(scene_file: str, out: Path, n: int, workers: int) -> subprocess.Popen[str]:
    """Start a run in its own process group."""
    arguments = ["--scene", scene_file, "-n", str(n), "--shard-size", "4", "--workers", str(workers)]
    command = [*COMMAND, *arguments, "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env=environment,
    )


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def shards(out: Path) -> int:
    """Number of shards that are written; names of unfinished ones begin with a dot."""
    return len([path for path in (out / "shards").glob("*") if not path.name.startswith(".")])


@pytest.mark.endurance
@pytest.mark.parametrize(
    ("workers", "spread"), [(1, {}), (2, {}), (2, {"target_position": 0.15, "base_mass": 0.1})]
)
def test_killed_at_random_moments_it_ends_with_the_same_bytes(
    scene_file: str, workers: int, spread: dict[str, float], tmp_path: Path
):
    rng, n = np.random.default_rng(workers), 48
    if spread:  # draws more than the start
        scene = load_scene(scene_file).replace(spread=spread)
        scene_file = str(tmp_path / "drawing.yaml")
        scene.to_yaml(scene_file)
    whole, out = tmp_path / "whole", tmp_path / "killed"
    size = ["--shard-size", "4", "--workers", "1"]
    assert run(["--scene", scene_file, "-n", str(n), *size, "--out", str(whole)]) == 0
    for _ in range(3):
        before = shards(out)
        with start(scene_file, out, n, workers) as process:
            wait_until(lambda least=before + 1: shards(out) >= least, process)
            time.sleep(rng.uniform(0.0, 0.3))
            os.killpg(process.pid, signal.SIGKILL)
    assert 3 <= shards(out) < 12
    assert not (out / "manifest.json").exists()
    with start(scene_file, out, n, workers) as process:
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert contents(out) == contents(whole)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_ends_it_soon_with_a_sentence(scene_file: str, workers: int, tmp_path: Path):
    with start(scene_file, tmp_path, 4000, workers) as process:
        wait_until(lambda: shards(tmp_path) >= 2, process)
        pressed = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert time.monotonic() - pressed < 10.0
    assert "Interrupted: complete shards remain" in " ".join(output.split())
    assert "Traceback" not in output
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
