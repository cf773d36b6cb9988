"""What goes wrong outside: damaged files, folders that cannot be written, output that nobody takes."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.completion import completion
from dq_space_arm_env.command_line.simulated_episode import read_state
from dq_space_arm_env.common.console import FAILURE, INTERNAL, SUCCESS, UNUSABLE, table_console
from dq_space_arm_env.common.files import check_writable
from experts.command_line.solving import solve, table

ROOT = Path(__file__).parents[2]


def command_line(*words: str, redirection: str = "", **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own, by a shell."""
    code = "import sys; from dq_space_arm_env.command_line import main; sys.exit(main(sys.argv[1:]))"
    line = f'exec "$0" -c "$1" "${{@:2}}" {redirection}'
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), **variables}
    return subprocess.run(
        ["bash", "-c", line, sys.executable, code, *words], capture_output=True, text=True, env=environment
    )


def test_end_of_file_is_no_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def cut_off(shell: str) -> None:
        raise EOFError("No data left in file")

    monkeypatch.setattr(completion, "callback", cut_off)
    assert main(["completion", "bash"]) == INTERNAL
    error = capsys.readouterr().err
    assert "EOFError: No data left in file" in error
    assert "Interrupted" not in error


@pytest.mark.parametrize("ending", [".npz", ".npy", ".json"])
@pytest.mark.parametrize("damage", ["empty", "cut", "changed", "missing"])
def test_a_damaged_start_is_named(tmp_path: Path, ending: str, damage: str) -> None:
    file = tmp_path / f"start{ending}"
    if ending == ".npz":
        np.savez_compressed(file, states=np.random.default_rng(0).normal(size=(50, 4)))
    elif ending == ".npy":
        np.save(file, np.arange(4.0))
    else:
        file.write_text(json.dumps([1.0, 2.0, 3.0, 4.0]))
    content = file.read_bytes()
    middle = len(content) // 2
    first = middle if ending == ".npz" else 0  # an archive knows what its members should be
    end = first + 9
    changed = content[:first] + bytes(255 - byte for byte in content[first:end]) + content[end:]
    file.unlink()
    if damage != "missing":
        file.write_bytes({"empty": b"", "cut": content[:middle], "changed": changed}[damage])
    with pytest.raises(ValueError, match=rf"--start .*start\{ending}: (should be 4|there is no such)"):
        read_state(str(file), 4)


def test_a_warning_is_a_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def warn(shell: str) -> None:
        warnings.warn("the cache cannot be written", stacklevel=1)

    monkeypatch.setattr(completion, "callback", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["completion", "bash"]) == SUCCESS
        assert capsys.readouterr().err == "Warning: the cache cannot be written\n"
        with pytest.warns(UserWarning, match="the cache cannot be written"):
            assert main(["--debug", "completion", "bash"]) == SUCCESS
        assert capsys.readouterr().err == ""


def test_where_folders_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    file.write_text("")
    check_writable(tmp_path / "new" / "deep")
    with pytest.raises(ValueError, match=r"cannot create .*deep: .*file is not a folder"):
        check_writable(file / "deep")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # the superuser may write everywhere
    with pytest.raises(ValueError, match=r"new: no permission to write in "):
        check_writable(tmp_path / "new")
    with pytest.raises(ValueError, match=r": no permission to write there"):
        check_writable(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "line",
    [
        "solve planar --out {file}/x",
        "simulate planar --policy zero --out {file}/x.npz",
        "replay a.npz --out {file}/page.html",
        "scenes new {file}/my.yaml",
        "demonstrations generate -n 1 --out {file}/x",
        "train cloning --out {file}/x",
        "evaluate ppo --out {file}/x",
        "evaluate show ppo --out {file}/x",
        "compare agents ppo --out {file}/x",
        "compare residual a.npz --out {file}/x",
    ],
)
def test_no_work_for_what_cannot_be_written(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert main(line.format(file=file).split()) == UNUSABLE
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.endswith("is not a folder\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_takes_one_sentence() -> None:
    result = command_line("scenes", "list", redirection="> /dev/full")
    assert (result.returncode, result.stderr) == (FAILURE, "Error: No space left on device\n")


@pytest.mark.parametrize("redirection", [">&-", "2>&-", ">&- 2>&-"])
def test_a_process_without_output_runs(redirection: str) -> None:
    result = command_line("scenes", "list", redirection=redirection)
    assert (result.returncode, result.stderr) == (SUCCESS, "")


def test_a_document_in_any_encoding(tmp_path: Path) -> None:
    file = tmp_path / "größe.yaml"
    result = command_line("scenes", "new", str(file), "--json", PYTHONIOENCODING="ascii", PYTHONUTF8="1")
    assert result.returncode == SUCCESS
    assert result.stdout.isascii()
    assert json.loads(result.stdout)["file"] == str(file)


@pytest.mark.parametrize("verb", [["simulate", "planar", "--policy"], ["replay", "--scene", "planar"]])
def test_a_policy_flies_its_own_scene(verb: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*verb, "ppo"]) == UNUSABLE
    assert "it was trained for scene 'paper'); scene 'planar' has 14" in capsys.readouterr().err


def test_a_solve_tells_what_long_steps_prepared() -> None:
    scene = load_scene("planar").replace(name="small", simulation={"dt": 0.1, "steps": 150})
    run = solve(scene, table_console(stderr=True))
    assert run.preparation_iterations
    long_steps = sum(attempt["iterations"] for attempt in run.solution.metadata["long_steps"])
    assert run.solution.iterations < long_steps
    console = table_console()
    with console.capture() as captured:
        console.print(table(run))
    words = " ".join(captured.get().split())
    assert f"its own start, {run.preparation_iterations} iterations in long steps" in words
    assert f"after {long_steps} in long steps" in words
