"""What goes wrong outside: damaged files, folders that cannot be written, output that nobody takes."""

import errno
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from agents.command_line import main
from agents.command_line.output import check_writable
from agents.command_line.program import program, run_to_end
from agents.command_line.solving import solve, table
from agents.command_line.starts import read_state
from agents.command_line.verb import FAILURE, INTERNAL, SUCCESS, UNUSABLE, Session
from dq_space_arm_env import load_scene
from experts.report.command import table_console

ROOT = Path(__file__).parents[2]


def command_line(*words: str, redirection: str = "", **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own, by a shell."""
    code = "import sys; from agents.command_line import main; sys.exit(main(sys.argv[1:]))"
    line = f'exec "$0" -c "$1" "${{@:2}}" {redirection}'
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        ["bash", "-c", line, sys.executable, code, *words], capture_output=True, text=True, env=environment
    )


def failing(error: Exception) -> int:
    def run() -> None:
        raise error

    return run_to_end(run, Session())


def test_the_end_of_a_file_is_no_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def cut_off(shell: str) -> None:
        raise EOFError("No data left in file")

    monkeypatch.setattr(program.commands["completion"], "callback", cut_off)
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
    if damage == "missing":
        file.unlink()
    else:
        kept = {"empty": b"", "cut": content[: len(content) // 2], "changed": b"\x80" + content[1:]}[damage]
        if damage == "changed" and ending == ".npz":
            middle = len(content) // 2
            kept = content[:middle] + bytes(255 - byte for byte in content[middle : middle + 9])
            kept += content[middle + 9 :]
        file.write_bytes(kept)
    with pytest.raises(ValueError, match=rf"--start .*start\{ending}: (should be 4|there is no such)"):
        read_state(str(file), 4)


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "a.npz"),
            FAILURE,
            "a.npz: No space left on device",
        ),
        (OSError(errno.ENOSPC, "No space left on device"), FAILURE, "No space left on device"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a.npz"), UNUSABLE, "a.npz: No such file"),
        (OSError("made up"), UNUSABLE, "made up"),
    ],
)
def test_errors_of_the_system_in_words(
    error: OSError, status: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert failing(error) == status
    assert capsys.readouterr().err == f"Error: {sentence}\n"


def test_a_warning_is_a_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(
        program.commands["completion"],
        "callback",
        lambda shell: warnings.warn("the cache cannot be written", stacklevel=1),
    )
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
    with pytest.raises(ValueError, match=r"deep cannot be made: .*file is no folder"):
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
        "report paper --out {file}/x",
        "report throughput --out {file}/x",
    ],
)
def test_what_cannot_be_written_is_not_worked_for(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert main(line.format(file=file).split()) == UNUSABLE
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.endswith("is no folder\n")


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


@pytest.mark.parametrize("words", [["evaluate"], ["evaluate", "--json"], ["evaluate", "policies"]])
def test_evaluate_says_how_it_is_used(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == UNUSABLE
    error = capsys.readouterr().err
    assert "ppo-from-clone" in error
    assert error.endswith("(see dq-space-arm evaluate --help)\n")


def test_a_comparison_with_nobody_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["compare", "nobody"]) == UNUSABLE
    assert not [*tmp_path.iterdir()]
    capsys.readouterr()


@pytest.mark.parametrize("verb", [["simulate", "planar", "--policy"], ["replay", "--scene", "planar"]])
def test_a_policy_flies_its_own_scene(verb: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*verb, "ppo"]) == UNUSABLE
    assert "it was trained for scene 'paper'; scene 'planar' shows 14" in capsys.readouterr().err


def test_a_solve_from_the_start_of_its_preparation_says_so() -> None:
    scene = load_scene("planar").replace(name="small", simulation={"dt": 0.1, "steps": 150})
    run = solve(scene, table_console(stderr=True))
    assert run.solution.iterations == 0
    assert run.preparation_iterations
    console = table_console()
    with console.capture() as captured:
        console.print(table(run))
    words = " ".join(captured.get().split())
    assert f"its own start, {run.preparation_iterations} iterations" in words
    assert "what it began with is the optimum already" in words
    assert "with its feedback gains" in words
