"""The README tells the truth: its code runs, its table has the right numbers, its pictures exist."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from agents.command_line import main
from dq_space_arm_env import compile_scene, list_scenes

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_code_runs(number, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # results of older code would be refused
    if "stable_baselines3" in BLOCKS[number]:
        pytest.importorskip("stable_baselines3")
    exec(compile(BLOCKS[number], f"README block {number}", "exec"), {})
    capsys.readouterr()


def test_there_is_code_to_run():
    assert len(BLOCKS) >= 4


def test_table_of_scenes_is_right():
    rows = re.findall(r"^\| `([\w-]+)` \|[^|]*\| (\d+), (\d+) \| (\d+) \|$", README, flags=re.MULTILINE)
    assert sorted(row[0] for row in rows) == sorted(list_scenes())
    for name, *numbers in rows:
        kernels = compile_scene(name)
        expected = [kernels.n_x, kernels.n_u, kernels.operation_count("forward_dynamics")]
        assert [int(number) for number in numbers] == expected, name


def test_pictures_and_pages_exist():
    targets = re.findall(r"\]\(([^):]+)\)", README)
    assert any(target.startswith("docs/") for target in targets)
    for target in targets:
        path, _, heading = target.partition("#")
        assert (ROOT / path).exists(), target
        headings = re.findall(r"^#+ (.+)$", (ROOT / path).read_text("utf-8"), re.MULTILINE) if heading else []
        assert not heading or heading in [text.lower().replace(" ", "-") for text in headings]


def test_commands_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for command in re.findall(r"^make (\w+)", README, flags=re.MULTILINE):
        assert re.search(rf"^{command}:", makefile, flags=re.MULTILINE)
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["dq_space_arm", "goal"])
def test_examples_in_the_docstrings_of_environments_run(name):
    import doctest
    from importlib import import_module

    results = doctest.testmod(import_module(f"dq_space_arm_env.environment.{name}"))
    assert results.attempted >= 5
    assert results.failed == 0


@pytest.mark.slow
def test_the_first_ten_minutes_go_as_written(tmp_path, monkeypatch):
    """What a newcomer types after `make paper`, line by line, in a folder with nothing but the examples."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    tour = README.partition("## The first ten minutes")[2].partition("```bash\n")[2].partition("```")[0]
    lines = [shlex.split(line, comments=True) for line in tour.splitlines()]
    assert ["source", ".venv/bin/activate"] in lines
    commands = [words[1:] for words in lines if words[:1] == ["dq-space-arm"]]
    assert {command[0] for command in commands} >= {"replay", "simulate", "scenes", "solve"}
    for command in [["report", "paper"], *commands]:
        assert main(command) == 0, shlex.join(command)
    for words in commands:
        if words[0] == "replay":
            assert (tmp_path / words[words.index("--out") + 1]).stat().st_size < 2_000_000
    for name in ("results/both.html", "results/small-arm.html"):
        assert (tmp_path / name).is_file()
