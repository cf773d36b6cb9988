"""The documentation tells the truth: its code runs, commands exist, recipes apply, and keys have units."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import click
import pytest
from pydantic import BaseModel

import agents
import dq_space_arm_env
import experts
from agents.configuration import Configuration, ImitationConfiguration
from agents.configuration.gradients import GradientConfiguration
from agents.configuration.residual import ResidualConfiguration
from agents.suite import Suite
from agents.zoo import list_policies
from agents.zoo.shelf import policy_file
from dq_space_arm_env.command_line.verb import DefaultGroup
from dq_space_arm_env.scene.constraints import Constraint, Plume
from dq_space_arm_env.task.step_report import grouped, report_names
from dq_space_arm_env.validation import parse_yaml

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(path.stem for path in DOCS.glob("*.md"))
TEXTS = {page: (DOCS / f"{page}.md").read_text(encoding="utf-8") for page in PAGES}
WITH_README = TEXTS | {"README": (ROOT / "README.md").read_text(encoding="utf-8")}
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", TEXTS["extending"], re.MULTILINE | re.DOTALL))
RECIPES = {title: text for title, text in SECTIONS.items() if "```diff" in text}
PACKAGES = ("agents", "configs", "dq_space_arm_env", "experts")

sys.path.insert(0, str(DOCS))
commands = import_module("extensions.commands")
keys = import_module("extensions.keys")
policies = import_module("extensions.policies")
write_generated = import_module("write_generated")

DIMENSIONLESS = {
    "Cost.pose",
    "Cost.terminal_pose",
    "OtherTip.pose",
    "OtherTip.terminal_pose",
    "Cost.base_velocity",
    "Cost.terminal_base_velocity",
    "Tumbling.inertia",
    "Spread.base_mass",
    "Spread.base_inertia",
    "Spread.link_masses",
    "Spread.link_inertias",
    "Spread.payload_mass",
    "Spread.payload_inertia",
    "Axis.direction",
    "Thruster.direction",
    "Wheel.axis",
    "LineOfSight.boresight",
    "ApproachCorridor.direction",
    "AxisLimits.limit",
} | {
    f"{model.__name__}.{name}"
    for model in keys.models_of(dq_space_arm_env.Scene)
    for name in ("margin", "tolerance")
    if issubclass(model, Constraint)
}
"""Keys of a scene without a unit, or, the last ones, with that of an actuator's limit or a residual."""


def code_of(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def blocks() -> list[tuple[str, int]]:
    return [
        (page, number)
        for page, text in WITH_README.items()
        for number, code in enumerate(code_of(text, "python"))
        # Run elsewhere: recipes below, the tutorial by test_own_robot, docstrings' examples by test_readme.
        if page not in ("extending", "own-robot") and not code.startswith(">>>")
    ]


@pytest.mark.sampled
@pytest.mark.parametrize(("page", "number"), blocks())
def test_code_in_the_documentation_runs(page, number, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # results of older code would be refused
    code = code_of(WITH_README[page], "python")[number]
    for package in ("jax", "pinocchio", "stable_baselines3", "torch"):
        if package in code:
            pytest.importorskip(package)
    exec(compile(code, f"{page}.md, block {number}", "exec"), {})
    capsys.readouterr()


def scene_files() -> list[tuple[str, str]]:
    files = [(page, file) for page in PAGES for file in code_of(TEXTS[page], "yaml")]
    return [(page, file) for page, file in files if re.search("^base:", file, flags=re.MULTILINE)]


def test_scene_files_in_the_documentation_are_scenes():
    assert {page for page, _ in scene_files()} == {"actuators", "maneuver", "scene"}
    for _, file in scene_files():
        scene = dq_space_arm_env.load_scene(parse_yaml(file))
        assert scene.simulation.dt == 0.015


@pytest.mark.endurance  # two minutes together; CI loads these scenes
@pytest.mark.parametrize(("page", "file"), scene_files())
def test_the_expert_flies_scene_files_in_the_documentation_to_their_targets(page, file):
    scene = dq_space_arm_env.load_scene(parse_yaml(file))
    solution = experts.GuidedDDP(scene).solve()
    env = dq_space_arm_env.DQSpaceArmEnv(scene)
    env.reset(options={"nominal": True})
    for action in env.kernels.layout.to_action(solution.controls):
        *_, info = env.step(action)
    assert info["is_success"]


def test_suites_in_the_documentation_have_scenes_as_they_are():
    (file,) = code_of(TEXTS["suite"], "yaml")
    suite = Suite.model_validate(parse_yaml(file))
    assert [suite.scene(task).name for task in suite.tasks] == list(suite.tasks)


@pytest.mark.parametrize("page", PAGES)
def test_no_line_of_a_page_is_a_comment(page):
    """MyST drops a line that begins with %, as a wrapped one may."""
    assert not re.findall(r"^ *%.*", TEXTS[page], flags=re.MULTILINE)


def test_table_of_scenes_is_right():
    row = r"^\| `([\w-]+)` \|[^|]*\| (\d+), (\d+) \| (\d+) \|$"
    rows = re.findall(row, TEXTS["scene"], flags=re.MULTILINE)
    assert sorted(row[0] for row in rows) == sorted(dq_space_arm_env.list_scenes())
    for name, *numbers in rows:
        kernels = dq_space_arm_env.compile_scene(name)
        expected = [kernels.n_x, kernels.n_u, kernels.operation_count("forward_dynamics")]
        assert [int(number) for number in numbers] == expected, name


def shell_lines() -> list[tuple[str, str]]:
    blocks = [(page, block) for page, text in WITH_README.items() for block in code_of(text, "bash")]
    lines = [(page, line) for page, block in blocks for line in block.splitlines()]
    return [(page, line) for page, line in lines if line.strip() and not line.startswith(("#", "source "))]


@pytest.mark.parametrize(("page", "line"), shell_lines())
def test_commands_in_the_documentation_exist(page, line):
    words = shlex.split(line, comments=True)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    elif words[0] == "python":
        assert (ROOT / words[1]).is_file() or importable(words[2])
    elif words[:2] == ["pip", "install"]:
        extras = re.findall(r"[\w-]+", words[2].partition("[")[2])
        known = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        assert all(re.search(rf"^{name} = \[", known, re.MULTILINE) for name in extras)
    else:
        assert words[0] == commands.PROGRAM
        check_verb(words)


def importable(module: str) -> bool:
    return (ROOT / module.replace(".", "/") / "__main__.py").is_file()


def check_verb(words: list[str]) -> None:
    known = commands.all_commands()
    verb = max((name for name in known if words[: len(name.split())] == name.split()), key=len)
    command, rest = known[verb], words[len(verb.split()) :]
    if isinstance(command, DefaultGroup):
        command = command.default
    assert rest == [] or verb != commands.PROGRAM
    if command.params and getattr(command.params[0], "type", None) is click.UNPROCESSED:
        return  # its own parser is tested with the packages that it belongs to
    options = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
    used = {word.partition("=")[0] for word in rest if re.match(r"--?[a-z]", word)}
    assert used <= options | {"--help"}
    # Paths need not exist: only the command line is read.
    command.make_context(verb, list(rest), resilient_parsing=True, help_option_names=commands.HELP)


def test_generated_parts_are_up_to_date():
    # In a process of its own: Click keeps what other tests have asked of its commands.
    check = [sys.executable, str(DOCS / "write_generated.py"), "--check"]
    done = subprocess.run(check, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"run python docs/write_generated.py: {done.stdout}{done.stderr}"


def test_all_generated_parts_stand_in_a_page():
    marks = re.findall(r"^<!-- generated: ([\w-]+) -->$", "\n".join(TEXTS.values()), flags=re.MULTILINE)
    assert sorted(marks) == sorted(write_generated.TEXTS)


def test_every_page_is_in_the_index():
    listed = re.findall(r"^([\w-]+)$", "\n".join(code_of(TEXTS["index"], "{toctree}")), flags=re.MULTILINE)
    assert sorted([*listed, "index"]) == PAGES


@pytest.mark.parametrize("package", [agents, dq_space_arm_env, experts])
def test_every_public_name_is_described(package):
    described = set(re.findall(r"auto\w+:: ([\w.]+)", TEXTS["api"]))
    assert set(package.__all__) <= described


def models() -> list[type[BaseModel]]:
    trainings = (Configuration, GradientConfiguration, ImitationConfiguration, ResidualConfiguration)
    roots = (dq_space_arm_env.Scene, *trainings)
    return list(dict.fromkeys(model for root in roots for model in keys.models_of(root)))


@pytest.mark.parametrize("model", models(), ids=lambda model: model.__name__)
def test_every_key_has_a_description(model):
    for name, field in model.model_fields.items():
        assert field.description or name == "name", f"{model.__name__}.{name}"


def test_every_number_of_a_scene_has_a_unit():
    without = {
        f"{model.__name__}.{name}"
        for model in keys.models_of(dq_space_arm_env.Scene)
        for name, field in model.model_fields.items()
        if keys.holds_numbers(field) and not keys.units_of(field)
    }
    assert without == DIMENSIONLESS


def test_the_page_of_the_environment_names_every_key_of_info():
    scenes = [dq_space_arm_env.load_scene(name) for name in dq_space_arm_env.list_scenes()]
    found = {key for scene in scenes for key in grouped(dict.fromkeys(report_names(scene)[1:]))}
    assert {"phase", "caught", "shock", "cost", "constraints", "cost_tip_twist"} <= found
    text = TEXTS["environment"].partition("## DQSpaceArmGoal-v0")[0]
    assert {key for key in found if f"`{key}`" not in text and f'`info["{key}"]`' not in text} == set()


def test_tables_of_keys_are_complete():
    text = keys.key_tables(dq_space_arm_env.Scene)
    found = {}
    for section in text.split("### ")[1:]:
        heading, _, table = section.partition("\n")
        place = heading.partition(", ")[0]
        common = found.get(place, set()) if place != heading else set()
        found[heading] = common | set(re.findall(r"^\| `(\w+)` \|", table, flags=re.MULTILINE))
    assert found["`constraints[]`, `kind: plume`"] == set(Plume.model_fields) - {"kind"}
    assert found["`target.motion`, `kind: screw`"] == {"angular_velocity", "linear_velocity"}
    written = set().union(*found.values())
    named = {name for model in keys.models_of(dq_space_arm_env.Scene) for name in model.model_fields}
    assert written == named - {"kind"}
    assert len(found) == 1 + len(keys.models_of(dq_space_arm_env.Scene))  # and what all constraints have
    assert "| `mass` | mass of the base, kg | number | **required** |" in text


def test_the_table_of_policies_says_what_their_cards_say():
    rows = policies.policy_table().splitlines()[2:]
    assert len(rows) == len(list_policies())
    for row, name in zip(rows, list_policies(), strict=True):
        card = policy_file(name).with_suffix(".md").read_text(encoding="utf-8")
        measured = re.findall(r"^\| [^|]+ \| ([\d.]+) \[", card, flags=re.MULTILINE)
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[0] == f"`{name}`"
        shown = [float(cell.partition("&nbsp;")[0]) for cell in cells[1:6]]
        assert shown == [float(rate) for rate in measured[:5]]


def with_recipe(title: str, folder: Path) -> None:
    """Copy the packages and change the copy as a recipe says."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "recipe.diff").write_text("".join(code_of(RECIPES[title], "diff")), encoding="utf-8")
    surroundings = os.environ | {"GIT_CEILING_DIRECTORIES": str(folder.parent)}
    subprocess.run(["git", "apply", "recipe.diff"], cwd=folder, env=surroundings, check=True)


@pytest.mark.skipif(shutil.which("git") is None, reason="recipes are applied by git")
@pytest.mark.parametrize("title", RECIPES)
def test_recipes_apply(title, tmp_path):
    with_recipe(title, tmp_path)
    for line in re.findall(r"^\+\+\+ b/(.+)$", RECIPES[title], flags=re.MULTILINE):
        compile((tmp_path / line).read_text(encoding="utf-8"), line, "exec")


def test_places_of_other_additions_exist():
    text = SECTIONS["Other additions"]
    whats = re.findall(r"^\| (\w[\w ]+) \|", text, flags=re.MULTILINE)
    assert whats == ["what", "kind of constraint", "cost term", "observation entry", "scene to ship"]
    named = re.findall(r"`([^`]+)`", text)
    places = [ROOT / name for name in named if "/" in name and " " not in name]
    assert len(places) > 20
    assert [place for place in places if not place.exists()] == []
    code = "".join(place.read_text(encoding="utf-8") for place in places if place.suffix == ".py")
    words = [name for name in named if "/" not in name]
    assert [word for word in words if not re.search(rf"^ *(def|class)? *{word}\b", code, re.MULTILINE)] == []


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("git") is None, reason="recipes are applied by git")
@pytest.mark.parametrize("title", RECIPES)
def test_recipes_work(title, tmp_path):
    with_recipe(title, tmp_path)
    surroundings = os.environ | {"PYTHONPATH": str(tmp_path)}
    for code in code_of(RECIPES[title], "python"):
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=surroundings, check=True)


@pytest.mark.slow
def test_documentation_builds_without_warnings(tmp_path):
    pytest.importorskip("sphinx")
    build = [sys.executable, *shlex.split("-m sphinx -q -W -n -b html"), str(DOCS), str(tmp_path / "html")]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (tmp_path / "html").glob("*.html")}
    assert pages.keys() >= set(PAGES)
    for name, page in pages.items():
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', page)
        assert loaded == [], f"{name} asks the network for {loaded}"
        assert "<math" in page or "$$" not in TEXTS.get(name, "")
