"""The program as a whole: how soon it is there, how it helps, and how every run ends."""

import errno
import importlib.metadata
import json
import logging
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from agents.command_line.agent_policies import configuration_files
from agents.command_line.compare import compare
from agents.command_line.evaluate import evaluate
from agents.configuration import list_configurations
from dq_space_arm_env import __version__, list_scenes, load_scene
from dq_space_arm_env.command_line import info as info_module
from dq_space_arm_env.command_line import main
from dq_space_arm_env.command_line.names import description_of, scene_files
from dq_space_arm_env.command_line.verb import DefaultGroup
from dq_space_arm_env.command_line.verb_program import program, run_to_end
from dq_space_arm_env.common.console import FAILURE, INTERNAL, INTERRUPTED, SUCCESS, UNUSABLE
from dq_space_arm_env.common.entry_points import entry_points

ROOT = Path(__file__).parents[2]
FLIGHT = ["simulate", "planar", "--policy", "zero"]
HEAVY = ["casadi", "gymnasium", "matplotlib", "numba", "numpy", "pydantic", "rich", "ruamel.yaml", "torch"]


def walk(command: click.Command, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Every verb, with those above it."""
    if not isinstance(command, click.Group):
        return [path]
    context = click.Context(command)
    names = command.list_commands(context)
    inner = {name: command.get_command(context, name) for name in names}
    return [path, *(found for name, sub in inner.items() if sub for found in walk(sub, (*path, name)))]


def process(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in a new process."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), **variables}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["scenes", "list"], ["solve", "--help"]])
def test_it_starts_without_loading_anything_heavy(arguments: list[str]) -> None:
    result = process(
        "import sys\n"
        "from dq_space_arm_env.command_line import main\n"
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
        "from dq_space_arm_env.command_line import main\n"
        "sys.exit(main([]))"
    )

    def completed(words: str, position: int) -> str:
        variables = {"COMP_WORDS": words, "COMP_CWORD": str(position)}
        result = process(code, _DQ_SPACE_ARM_COMPLETE="bash_complete", **variables)
        assert result.returncode == SUCCESS
        assert result.stderr == "[]\n"
        return result.stdout

    assert completed("dq-space-arm solve pla", 2) == "plain,planar\n"
    assert "plain,gains" in completed("dq-space-arm simulate paper --policy ", 4)
    assert (
        completed("dq-space-arm train pp", 2)
        == "plain,ppo\nplain,ppo-from-clone\nplain,ppo-lagrangian\nplain,ppo-tumbling-target\n"
    )
    assert completed("dq-space-arm evaluate --scene plan", 3) == "plain,planar\n"


def test_names_are_those_of_the_packages() -> None:
    assert list(scene_files()) == list_scenes()
    assert list(configuration_files()) == list_configurations()
    for name, path in scene_files().items():
        assert description_of(path) == load_scene(name).description
    assert info_module.package_version() == __version__


def test_the_program_leaves_it_to_its_verbs_what_falls_short() -> None:
    whole, solve = (
        " ".join(CliRunner().invoke(program, [*path, "--help"]).stdout.split()) for path in ((), ("solve",))
    )
    assert "1 the result falls short of what was asked, in the ways that the verb's help names; 2" in whole
    assert "A target that the optimum misses is no failure" in solve


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
        while isinstance(command, click.Group) and words:
            inner = command.get_command(click.Context(command, resilient_parsing=True), words[0])
            if inner is None:
                break
            command, words = inner, words[1:]
        if isinstance(command, DefaultGroup):
            command = command.default
        options = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= options


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["solv", "paper"], "No such command 'solv'. Did you mean 'solve'?"),
        (["solve", "paper", "--sed", "1"], "Did you mean one of: '--seed'"),
        (["solve", "papr"], "no scene is named 'papr'; did you mean 'paper'?"),
        (["solve", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (["simulate", "paper", "--policy", "gians"], "there is no such file; did you mean 'gains'?"),
        (["simulate", "planar", "--seed", "1", "--start", "0,0"], "--seed and --start exclude each other"),
        (["simulate", "planar", "--seed", "-1"], "-1 is not in the range x>=0"),
        ([*FLIGHT, "--start", "1,2,3"], "--start: has shape (3,), should be the scene's (13,)"),
        ([*FLIGHT, "--start", ",".join(13 * "0")], "--start has a base pose with |q_r| = 0"),
        ([*FLIGHT, "--start", "one"], "should be 13 numbers separated by commas"),
        ([*FLIGHT, "--noise", "-1"], "--noise is -1.0"),
        (["demonstrations", "generate", "--shard", "3/2"], "use I/K"),
        (["demonstrations", "generate", "my.yaml"], "(my.yaml); here a scene is given as --scene SCENE"),
        (["replay", "a.npz", "--label", "one", "--label", "two"], "2 labels for 1 flights"),
        (["train"], "give a configuration: a YAML file, or one of act, apg, apg-from-clone, apg-robust,"),
        (["evaluate"], "name a policy to evaluate"),
        (["evaluate", "gains"], "`dq-space-arm compare --controller gains` flies it"),
        (["evaluate", "a.npz", "--condition", "training", "spinn"], "did you mean 'spin'?"),
        (["evaluate", "show", "nobody"], "the zoo has no policy 'nobody'"),
        (["compare", "--controller", "gain"], "'gain' is unknown; did you mean 'gains'?"),
    ],
)
def test_mistakes_end_with_one_sentence(
    arguments: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING, "dq_space_arm_env")  # some compile a scene first
    assert main(arguments) == UNUSABLE
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("Error: ")
    assert sentence in captured.err
    assert captured.err.count("\n") == 1


def test_debug_shows_tracebacks(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "show", "papr", "--debug"]) == UNUSABLE
    assert "Traceback" in capsys.readouterr().err
    for value, is_shown in (("1", True), ("0", False)):
        monkeypatch.setenv("DQ_SPACE_ARM_DEBUG", value)
        assert main(["scenes", "show", "papr"]) == UNUSABLE
        assert ("Traceback" in capsys.readouterr().err) == is_shown


def end_with(error: BaseException) -> int:
    def run() -> None:
        raise error

    return run_to_end(run)


class OurError(Exception):
    """An error that a package of this project defines."""

    __module__ = "experts.made_up"


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (ValueError("dt is -1"), UNUSABLE, "Error: dt is -1\n"),
        (ImportError("it needs torch"), UNUSABLE, "Error: it needs torch\n"),
        (OurError("the disk is full"), FAILURE, "Error: the disk is full\n"),
        (OSError(errno.ENOSPC, "No space left", "a.npz"), FAILURE, "Error: a.npz: No space left\n"),
        (OSError(errno.ENOSPC, "No space left"), FAILURE, "Error: No space left\n"),
        (FileNotFoundError(errno.ENOENT, "No such file", "a.npz"), UNUSABLE, "Error: a.npz: No such file\n"),
        (KeyboardInterrupt(), INTERRUPTED, "Interrupted: files are complete, or as they were.\n"),
        (SystemExit(7), 7, ""),
        (SystemExit(None), SUCCESS, ""),
    ],
)
def test_every_end_has_its_status(
    error: BaseException, status: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert end_with(error) == status
    assert capsys.readouterr().err == sentence


def test_a_mistake_of_our_own_asks_for_a_report(capsys: pytest.CaptureFixture[str]) -> None:
    assert end_with(KeyError("mass")) == INTERNAL
    error = capsys.readouterr().err
    assert "KeyError: 'mass'" in error
    assert "dq-space-arm info" in error
    assert "Traceback" not in error


def test_colors_only_on_a_terminal_that_wants_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    for variable, is_red in (("TERM", False), ("FORCE_COLOR", True), ("NO_COLOR", False)):
        monkeypatch.setenv(variable, "xterm-256color")
        assert main(["solv"]) == UNUSABLE
        assert ("\x1b[1;31mError" in capsys.readouterr().err) == is_red


def test_a_closed_pipe_ends_it_quietly() -> None:
    code = (
        "import os, sys\n"
        "reader, writer = os.pipe()\n"
        "os.close(reader)\n"
        "os.dup2(writer, 1)\n"
        "from dq_space_arm_env.command_line import main\n"
        "sys.exit(main(['scenes', 'list']))"
    )
    result = process(code)
    assert result.returncode == FAILURE
    assert result.stderr == ""


def test_ctrl_c_says_what_is_kept() -> None:
    code = (
        "import os, signal, sys\n"
        "from dq_space_arm_env.command_line import main\n"
        "from dq_space_arm_env.command_line.completion import completion\n"
        "from dq_space_arm_env.command_line.verb import keeping\n"
        "def interrupted(**_):\n"
        "    with keeping('the first part remains'):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "        import time; time.sleep(10)\n"
        "completion.callback = interrupted\n"
        "sys.exit(main(['completion', 'bash']))"
    )
    result = process(code)
    assert result.returncode == INTERRUPTED
    assert result.stderr.strip() == "Interrupted: the first part remains."


@pytest.mark.slow
def test_ctrl_c_in_a_finalizer_interrupts_all_the_same() -> None:
    code = (
        "import os, signal, sys, time\n"
        "from dq_space_arm_env.command_line.verb_program import run_to_end\n"
        "class Pressed:\n"
        "    def __del__(self):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "        time.sleep(10)\n"
        "def run():\n"
        "    Pressed()\n"
        "    time.sleep(10)\n"
        "sys.exit(run_to_end(run))"
    )
    result = process(code)
    assert result.returncode == INTERRUPTED
    assert result.stderr == "Interrupted: files are complete, or as they were.\n"


def test_ctrl_c_while_the_program_is_imported_is_a_sentence() -> None:
    result = process(
        "import sys\n"
        "class Press:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.endswith('verb_program'):\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Press())\n"
        "from dq_space_arm_env.command_line import main\n"
        "sys.exit(main(['scenes', 'list']))"
    )
    assert result.returncode == INTERRUPTED
    assert result.stderr == "Interrupted: nothing is saved.\n"


def _fail(error: Exception, cause: Exception | None = None) -> None:
    raise error from cause


@pytest.mark.parametrize(
    "run",
    [
        lambda: _fail(MemoryError()),
        lambda: _fail(RuntimeError("of a library"), MemoryError()),
        lambda: _fail(SystemError("error return without exception set")),
        lambda: _fail(OSError(errno.ENOMEM, "Cannot allocate memory")),
    ],
)
def test_running_out_of_memory_is_no_bug(run: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_to_end(run) == FAILURE
    said = capsys.readouterr().err
    assert said.startswith("Error: ")
    assert "memory" in said
    assert len(said.splitlines()) == 1


def test_info_is_one_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json"]) == SUCCESS
    found = json.loads(capsys.readouterr().out)
    assert found["dq-space-arm"]["version"] == __version__
    assert found["versions"]["numpy"]
    assert {"agents", "plots", "ray", "render"} <= set(found["extras"])
    assert main(["info"]) == SUCCESS
    assert re.search(r"python +\d+\.\d+", capsys.readouterr().out)


def test_another_package_adds_a_verb(tmp_path: Path) -> None:
    (tmp_path / "other.py").write_text(
        "import click\n@click.command()\ndef greet(): 'Greet.'; click.echo('hello')\n"
    )
    metadata = tmp_path / "other-1.0.dist-info"
    metadata.mkdir()
    (metadata / "entry_points.txt").write_text("[dq_space_arm.verbs]\ngreet = other:greet\n\n[x]\ny = z\n")
    found = importlib.metadata.entry_points(group="dq_space_arm.verbs")
    assert entry_points("dq_space_arm.verbs") == {each.name: each.value for each in found}
    run = "import sys; from dq_space_arm_env.command_line import main; sys.exit(main(sys.argv[1:]))"
    for words, expected in ((["greet"], "hello\n"), (["greet", "--help"], "--debug"), (["--help"], "Greet.")):
        result = process(f"import sys; sys.path.append({str(tmp_path)!r}); sys.argv[1:] = {words}; {run}")
        assert result.returncode == SUCCESS
        assert expected in result.stdout


@pytest.mark.parametrize("order", ["gymnasium, dq_space_arm_env", "dq_space_arm_env, gymnasium"])
def test_the_environments_are_registered_in_either_order(order: str) -> None:
    code = f"import {order}; print(*(name for name in gymnasium.registry if name.startswith('DQ')))"
    assert process(code).stdout == "DQSpaceArm-v0 DQSpaceArmGoal-v0\n"


def test_python_m_runs_the_program() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, "-m", "dq_space_arm_env", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
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


def test_what_the_disk_refuses_to_a_thread_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    def write() -> None:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))

    def run() -> None:
        thread = threading.Thread(target=write)
        thread.start()
        thread.join()

    assert run_to_end(run) == SUCCESS
    assert capsys.readouterr().err == "Warning: File too large\n"
