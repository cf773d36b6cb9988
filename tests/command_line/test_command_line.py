"""The program as a whole: how soon it is there, how it helps, and how every run ends."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from agents.command_line import info as info_module
from agents.command_line import main
from agents.command_line.comparing import compare
from agents.command_line.learning import evaluate
from agents.command_line.names import configuration_files, description_of, scene_files
from agents.command_line.program import program, run_to_end
from agents.command_line.verb import (
    FAILURE,
    INTERNAL,
    INTERRUPTED,
    SUCCESS,
    UNUSABLE,
    Session,
    VerbsWithDefault,
)
from agents.configuration import list_configurations
from dq_space_arm_env import __version__, list_scenes, load_scene

ROOT = Path(__file__).parents[2]
HEAVY = ["casadi", "gymnasium", "matplotlib", "numba", "numpy", "pydantic", "rich", "torch", "yaml"]


def walk(command: click.Command, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every verb, with those above it."""
    if not isinstance(command, click.Group):
        return [path]
    return [path, *(found for name, sub in command.commands.items() for found in walk(sub, (*path, name)))]


def process(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a new process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["scenes", "list"], ["solve", "--help"]])
def test_it_starts_without_loading_anything_heavy(arguments: list[str]) -> None:
    result = process(
        "import sys\n"
        "from agents.command_line import main\n"
        f"status = main({arguments})\n"
        f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)\n"
        "sys.exit(status)"
    )
    assert result.returncode == SUCCESS
    assert result.stderr == "[]\n"
    assert result.stdout


def test_completion_loads_nothing_heavy_and_knows_the_names() -> None:
    code = (
        "import sys, atexit\n"
        f"atexit.register(lambda: print([n for n in {HEAVY} if n in sys.modules], file=sys.stderr))\n"
        "from agents.command_line import main\n"
        "sys.exit(main([]))"
    )

    def completed(words: str, position: int) -> str:
        variables = {"COMP_WORDS": words, "COMP_CWORD": str(position)}
        result = process(code, _DQ_SPACE_ARM_COMPLETE="bash_complete", **variables)
        assert result.returncode == SUCCESS
        assert result.stderr == "[]\n"
        return result.stdout

    assert completed("dq-space-arm solve pl", 2) == "plain,planar\n"
    assert "plain,gains" in completed("dq-space-arm simulate paper --policy ", 4)
    assert completed("dq-space-arm train pp", 2) == "plain,ppo\nplain,ppo-from-clone\n"
    assert completed("dq-space-arm evaluate --scene plan", 3) == "plain,planar\n"


def test_names_are_those_of_the_packages() -> None:
    assert list(scene_files()) == list_scenes()
    assert list(configuration_files()) == list_configurations()
    for name, path in scene_files().items():
        assert description_of(path) == load_scene(name).description
    assert info_module.package_version() == __version__


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_shell_gets_its_script(shell: str) -> None:
    result = CliRunner().invoke(program, ["completion", shell])
    assert result.exit_code == SUCCESS
    assert "_DQ_SPACE_ARM_COMPLETE" in result.stdout
    assert "dq-space-arm" in result.stdout


@pytest.mark.parametrize("path", walk(program), ids=" ".join)
def test_every_verb_helps_with_examples_that_it_understands(path: tuple[str, ...]) -> None:
    result = CliRunner().invoke(program, [*path, "--help"])
    assert result.exit_code == SUCCESS
    _, _, examples = result.stdout.partition("Examples:\n")
    lines = [line for line in examples.splitlines() if line.startswith("  ")]
    assert lines
    for line in lines:
        first, *words = takewhile(lambda word: word != "|", shlex.split(line, comments=True))
        assert first == "dq-space-arm"
        command: Any = program
        while isinstance(command, click.Group) and words and words[0] in command.commands:
            command, words = command.commands[words[0]], words[1:]
        if isinstance(command, VerbsWithDefault):
            command = command.default
        options = {
            name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)
        }
        assert {word for word in words if word.startswith("--")} <= options


def test_a_number_sign_within_a_word_begins_no_comment() -> None:
    result = CliRunner().invoke(program, ["replay", "--help"], terminal_width=120)
    assert 'dq-space-arm replay "results/demonstrations/paper#3" --open ' in result.stdout
    assert "# a demonstration\n" in result.stdout


@pytest.mark.parametrize(
    "arguments", [["work-precision"], ["stability"], ["--part", "stability"]], ids=" ".join
)
def test_reports_name_the_extra_that_their_references_need(arguments: list[str], tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "sys.modules['mpmath'] = None  # as if it were not installed\n"
        "from agents.command_line import main\n"
        f"sys.exit(main(['report', *{arguments!r}, '--out', {str(tmp_path / 'out')!r}]))"
    )
    result = process(code)
    assert result.returncode == UNUSABLE
    assert result.stderr.strip() == 'Error: the references need mpmath: pip install "dq-space-arm[test]"'


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["solv", "paper"], "No such command 'solv'. Did you mean 'solve'?"),
        (["scenes", "shwo"], "Did you mean 'show'?"),
        (["solve", "paper", "--sed", "1"], "Did you mean one of: '--seed'"),
        (["solve", "papr"], "no scene is named 'papr'; did you mean 'paper'?"),
        (["solve", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (
            ["simulate", "paper", "--policy", "gians"],
            "there is no such file; did you mean 'gains'?",
        ),
        (["report", "--part", "stabilty"], "'stabilty' is unknown; did you mean 'stability'?"),
        (["report", "--quick", "expert"], "options go behind expert"),
        (["report", "expert", "--quick", "--full"], "--quick and --full exclude each other"),
        (["demonstrations", "generate", "--shard", "3/2"], "it should be I/K"),
        (["replay", "a.npz", "--label", "one", "--label", "two"], "2 labels for 1 flights"),
        (["train"], "give one configuration: a YAML file, or one of cloning,"),
        (["train", "pppo"], "did you mean 'ppo'"),
        (["evaluate"], "name a policy to evaluate"),
        (
            ["evaluate", "a.npz", "--condition", "training", "spinn"],
            "'spinn' is unknown; did you mean 'spin'?",
        ),
        (["evaluate", "show", "nobody"], "the zoo has no policy 'nobody'"),
        (["compare", "--controller", "gain"], "'gain' is unknown; did you mean 'gains'?"),
        (["evaluate", "show"], "name one policy"),
        (["compare", "residual", "nobody"], "the zoo has no policy 'nobody'"),
    ],
)
def test_a_mistake_ends_with_one_sentence(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == UNUSABLE
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("Error: ")
    assert sentence in captured.err
    assert captured.err.count("\n") == 1


def test_debug_shows_the_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["scenes", "show", "papr", "--debug"]) == UNUSABLE
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("DQ_SPACE_ARM_DEBUG", "1")
    assert main(["scenes", "show", "papr"]) == UNUSABLE
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("DQ_SPACE_ARM_DEBUG", "0")
    assert main(["scenes", "show", "papr"]) == UNUSABLE
    assert "Traceback" not in capsys.readouterr().err


def raising(error: BaseException) -> Callable[[], Any]:
    def run() -> None:
        raise error

    return run


class OurError(Exception):
    """An error that a package of this project defines."""

    __module__ = "experts.made_up"


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (ValueError("dt is -1"), UNUSABLE, "Error: dt is -1\n"),
        (ImportError("it needs torch"), UNUSABLE, "Error: it needs torch\n"),
        (OurError("the disk is full"), FAILURE, "Error: the disk is full\n"),
        (KeyboardInterrupt(), INTERRUPTED, "Interrupted: nothing is saved.\n"),
        (SystemExit(7), 7, ""),
        (SystemExit(None), SUCCESS, ""),
    ],
)
def test_every_end_has_its_status(
    error: BaseException, status: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_to_end(raising(error), Session()) == status
    assert capsys.readouterr().err == sentence


def test_a_mistake_of_our_own_asks_for_a_report(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_to_end(raising(KeyError("mass")), Session()) == INTERNAL
    error = capsys.readouterr().err
    assert "KeyError: 'mass'" in error
    assert "dq-space-arm info" in error
    assert "Traceback" not in error


def test_colors_only_on_a_terminal_that_wants_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for variable in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(variable, raising=False)
    assert main(["solv"]) == UNUSABLE
    assert "\x1b" not in capsys.readouterr().err  # no terminal
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    assert main(["solv"]) == UNUSABLE
    assert "\x1b[1;31mError" in capsys.readouterr().err
    monkeypatch.setenv("NO_COLOR", "1")
    assert main(["solv"]) == UNUSABLE
    assert "\x1b[1;31m" not in capsys.readouterr().err


def test_a_closed_pipe_ends_it_quietly() -> None:
    code = (
        "import os, sys\n"
        "reader, writer = os.pipe()\n"
        "os.close(reader)\n"
        "os.dup2(writer, 1)\n"
        "from agents.command_line import main\n"
        "sys.exit(main(['scenes', 'list']))"
    )
    result = process(code)
    assert result.returncode == FAILURE
    assert result.stderr == ""


def test_ctrl_c_says_what_is_kept() -> None:
    code = (
        "import os, signal, sys\n"
        "from agents.command_line import main\n"
        "from agents.command_line.program import program\n"
        "from agents.command_line.verb import keeping\n"
        "def interrupted(**_):\n"
        "    with keeping('the first part remains'):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "        import time; time.sleep(10)\n"
        "program.commands['completion'].callback = interrupted\n"
        "sys.exit(main(['completion', 'bash']))"
    )
    result = process(code)
    assert result.returncode == INTERRUPTED
    assert result.stderr.strip() == "Interrupted: the first part remains."


def test_info_is_one_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json"]) == SUCCESS
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["dq-space-arm"]["version"] == __version__
    assert found["versions"]["numpy"]
    assert {"folder", "writable", "compiled kernels"} <= set(found["caches"])
    assert set(found["extras"]) == set(info_module.EXTRAS)
    assert captured.err == ""
    assert main(["info"]) == SUCCESS
    assert re.search(r"python +\d+\.\d+", capsys.readouterr().out)


def test_python_m_and_scripts_are_the_same_program() -> None:
    script = str(ROOT / "scripts" / "report.py")
    for arguments in (["-m", "dq_space_arm_env", "--version"], [script, "--help"]):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        result = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment)
        assert result.returncode == SUCCESS
        assert "dq-space-arm" in result.stdout


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("a b --condition training spin -n 3", {"policies": ("a", "b"), "n": 3}),
        ("--policy a b --condition training spin", {"policies": (), "more": ("a", "b")}),
        ("--condition training --no-expert --condition spin", {"policies": (), "expert": False}),
    ],
)
def test_repeatable_options_take_several_words(line: str, expected: dict[str, Any]) -> None:
    parameters = evaluate.default.make_context("evaluate", line.split()).params
    assert parameters["conditions"] == ("training", "spin")
    assert {name: parameters[name] for name in expected} == expected


def test_a_group_with_a_default_can_do_without_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[tuple[str, dict[str, Any]]] = []
    for name, command in compare.commands.items():
        monkeypatch.setattr(command, "callback", lambda name=name, **options: done.append((name, options)))
    for line in ("", "agents", "--debug", "ppo -n 3", "--debug agents ppo -n 3", "residual ppo", "cloning"):
        assert main(["compare", *line.split()]) == SUCCESS
    assert [name for name, _ in done] == [*["agents"] * 5, "residual", "cloning"]
    assert [options["policies"] for _, options in done[:5]] == [(), (), (), ("ppo",), ("ppo",)]
    assert [options["n"] for _, options in done[3:5]] == [3, 3]
