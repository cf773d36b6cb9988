"""What scenes leave out: sizes, operations, imports, and programs that are there or not; never how long."""

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from agents.command_line import main
from dq_space_arm_env import Scene, compile_scene, list_scenes, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.kernels.environment_programs import EnvironmentPrograms
from dq_space_arm_env.kernels.programs import ScenePrograms
from experts.report import to_json
from experts.report.command import INTERRUPTED, SUCCESS, UNUSABLE
from experts.report.scene_cost import command, measurement
from experts.report.scene_cost.measurement import (
    OUTPUTS,
    Effort,
    SceneCostReport,
    SceneRow,
    measure,
    programs_and_integrators,
)
from experts.report.scene_cost.processes import IMPORT, MAKE, STEP, WRENCHES, ProcessStage
from experts.report.scene_cost.programs import compile_cold
from experts.report.scene_cost.records import ratios, report_record
from experts.report.scene_cost.sizes import COMPARED_INTEGRATORS, measure_size
from experts.report.scene_cost.tables import tables
from experts.report.throughput import timing
from experts.report.throughput.features import feature_variants

SHORT = Effort(("paper",), timing.Effort((1,), 1, 1e-4), compilations=1, processes=1)


@pytest.fixture(scope="module")
def report(short_scene: Scene) -> SceneCostReport:
    return measure(SHORT, {"short": short_scene})


@cache
def operations(scene: Scene) -> Mapping[str, int]:
    """Of each program that every scene has."""
    programs, environments = ScenePrograms(scene), EnvironmentPrograms(scene)
    counts = {name: programs.build("step", name).operation_count for name in COMPARED_INTEGRATORS}
    counts["dynamics"] = programs.build("forward_dynamics").operation_count
    counts["environment"] = environments.build("environment_step", "rk4").operation_count
    return counts


@pytest.mark.parametrize(
    "name",
    [
        "paper",
        "random-masses",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("payload", "planar", "six-joint", "tip-load")
        ),
    ],
)
def test_a_part_never_makes_a_scene_cheaper(name: str) -> None:
    scene = load_scene(name)
    whole = operations(scene)
    variants = feature_variants(scene)
    assert operations(variants.pop(f"{name}, as it is")) == whole
    for title, variant in variants.items():
        added = title.startswith("with ") and "link" not in title
        for program, count in operations(variant).items():
            assert (count >= whole[program]) if added else (count <= whole[program]), (title, program)


def test_shorter_arms_are_cheaper_the_shorter_they_are() -> None:
    variants = feature_variants(load_scene("paper"))
    counts = [operations(variants[f"with {count}"]) for count in ("0 links", "1 link", "2 links")]
    counts.append(operations(load_scene("paper")))
    for shorter, longer in pairwise(counts):
        assert all(shorter[program] < longer[program] for program in shorter)


def test_starts_that_are_not_random_change_no_step_and_masses_only_that_of_the_environment() -> None:
    variants = feature_variants(load_scene("paper"))
    whole = operations(variants["paper, as it is"])
    assert operations(variants["without random starts"]) == whole
    for title in ("with random target", "with random masses"):
        changed = operations(variants[title]).items() - whole.items()
        assert dict(changed).keys() == {"environment"}
        assert dict(changed)["environment"] > whole["environment"]


# States, tangent states, inputs, entries of an observation; the pose has 8 numbers and 6 directions.
SIZES = {
    "without wrist": (20, 18, 9, 21),
    "without base force and torque": (23, 21, 6, 24),
    "with 0 links": (17, 15, 9, 18),
    "in the plane, without wrist": (13, 12, 6, 14),
}


@pytest.mark.parametrize("title", SIZES)
def test_sizes_of_parts(title: str) -> None:
    size = measure_size(feature_variants(load_scene("paper"))[title])
    assert (size.states, size.tangent_states, size.inputs, size.observations) == SIZES[title]
    assert size.state_bytes == 8 * size.states


@pytest.mark.parametrize("name", ["planar", "tip-load"])
def test_sizes_of_scenes_are_those_of_kernels_and_environment(name: str) -> None:
    scene = load_scene(name)
    size, kernels, env = measure_size(scene), compile_scene(scene), DQSpaceArmEnv(scene)
    assert (size.states, size.tangent_states, size.inputs) == (kernels.n_x, kernels.n_t, kernels.n_u)
    assert (size.observations,) == env.observation_space.shape
    assert size.environment_step.operations == kernels.operation_count("environment_step")
    assert size.step.operations == size.step_operations[scene.simulation.integrator]


def test_single_precision_halves_the_memory() -> None:
    scene = load_scene("planar")
    single = scene.replace(simulation={**scene.simulation.model_dump(), "precision": "float32"})
    double_cost, single_cost = (compile_cold(each, "step", "rk4") for each in (scene, single))
    assert double_cost.memory_bytes == 2 * single_cost.memory_bytes
    assert double_cost.operations == single_cost.operations


def test_memory_is_that_of_rows_and_intermediate_results(short_scene: Scene) -> None:
    kernels = compile_scene(short_scene)
    cost = compile_cold(short_scene, "tip_pose")  # of one graph: nothing in between
    assert cost.memory_bytes == 8 * (kernels.n_x + 8)
    assert cost.code_bytes > 0


def test_report_has_every_row(report: SceneCostReport, short_scene: Scene) -> None:
    assert [row.title for row in report.scenes] == ["paper", "short"]
    assert [row.title for row in report.features] == list(feature_variants(short_scene))
    assert report.output_scene == "short"
    assert [program.name for program in report.outputs] == list(OUTPUTS)
    for row in (*report.scenes, *report.features):
        assert row.cost.environment_step.operations == row.size.environment_step.operations
    own = ratios(report.features[0], report.features[0])
    assert set(vars(own).values()) == {1.0}


def test_derivatives_cost_more_than_the_step_and_the_step_does_not_pay(report: SceneCostReport) -> None:
    step, *_ = (program.operations for program in report.outputs)
    by_name = {program.name: program.operations for program in report.outputs}
    assert step < by_name["linearize"] < by_name["lagrangian_hessian"]
    assert by_name["tip_pose"] < step
    # Reactions need the accelerations, all but the turning of the base's axes: omega x v in the plane.
    assert by_name["forward_dynamics"] - 4 <= by_name["reaction_wrenches"]


def test_the_default_scenes_are_those_of_the_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def rows(scenes: list[tuple[str, Scene]], effort: Effort) -> list[Any]:
        asked.append([title for title, _ in scenes])
        raise KeyboardInterrupt

    monkeypatch.setattr(measurement, "_measure_rows", rows)
    with pytest.raises(KeyboardInterrupt):
        measure(measurement.QUICK)
    parts = list(feature_variants(load_scene("paper")))
    assert asked == [["paper", "no-wrist", "planar", *parts]]
    assert set(measurement.FULL.scenes) == set(list_scenes())


@pytest.fixture
def processes(report: SceneCostReport) -> dict[tuple[str, bool], ProcessStage]:
    return {(stage.title, stage.cached): stage for stage in report.processes}


def test_only_what_is_called_is_compiled(processes: dict[tuple[str, bool], ProcessStage]) -> None:
    compiled = {title: stage.kernels for (title, cached), stage in processes.items() if not cached}
    assert compiled == {
        IMPORT: (),
        MAKE: ("environment_observe", "environment_start", "environment_step"),
        STEP: ("step",),
        WRENCHES: ("reaction_wrenches",),
    }
    assert not any(stage.kernels for (_, cached), stage in processes.items() if cached)


def test_nothing_optional_is_imported(processes: dict[tuple[str, bool], ProcessStage]) -> None:
    assert len(processes) == 8
    assert not any(stage.optional for stage in processes.values())
    for cached in (False, True):
        imported = processes[IMPORT, cached].packages
        assert {"gymnasium", "numpy"} <= set(imported)
        assert not {"casadi", "llvmlite", "pydantic"} & set(imported)
    assert "casadi" in processes[MAKE, False].packages


def test_casadi_is_not_imported_where_all_kernels_are_cached(
    processes: dict[tuple[str, bool], ProcessStage],
) -> None:
    used = {name for (_, cached), stage in processes.items() if cached for name in stage.packages}
    assert "llvmlite" in used
    assert "casadi" not in used


def test_record_is_finite_json(report: SceneCostReport) -> None:
    record = json.loads(to_json(report_record(report)))
    assert [row["title"] for row in record["scenes"]] == ["paper", "short"]
    assert record["outputs"]["scene"] == "short"
    found = list(numbers(record))
    assert len(found) > 100
    assert all(math.isfinite(number) and number >= 0 for number in found)


def numbers(value: Any) -> Iterator[float]:
    """All numbers of a JSON value."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)
    elif isinstance(value, float | int):
        yield value


def test_tables_fit_a_terminal_of_110_columns(report: SceneCostReport) -> None:
    paper = report.scenes[0]
    steps = {
        name: dataclasses.replace(getattr(paper.cost, name), best_ns=123.4)
        for name in ("step", "environment_step")
    }
    parts = tuple(
        SceneRow(title, paper.size, dataclasses.replace(paper.cost, **steps))
        for title in feature_variants(load_scene("paper"))
    )
    wide = dataclasses.replace(report, scenes=parts, features=parts)
    pages = []
    for width in (110, 200):
        console = Console(width=width, file=StringIO(), highlight=False)
        for table in tables(wide)[:4]:  # the others have texts that may be folded
            console.print(table.for_terminal())
        assert isinstance(console.file, StringIO)
        lines = [line.rstrip() for line in console.file.getvalue().splitlines()]
        pages.append([line for line in lines if line.startswith("  ")])
    assert pages[0] == pages[1]


def test_a_scene_may_name_any_integrator(report: SceneCostReport) -> None:
    first = report.scenes[0]
    other = dataclasses.replace(first, cost=dataclasses.replace(first.cost, integrator="rodas4"))
    assert len(tables(dataclasses.replace(report, scenes=(first, other)))[0].rows) == 2
    curved = programs_and_integrators(load_scene("six-joint"))
    assert curved == {"step": "rk6", "linearize": "rk6", "lagrangian_hessian": "rk4"}
    settings = {**load_scene("planar").simulation.model_dump(), "integrator": "rodas4"}
    stiff = programs_and_integrators(load_scene("planar").replace(simulation=settings))
    assert stiff == {"step": "rodas4", "linearize": "rodas4"}


def test_every_row_of_a_table_has_a_cell_for_each_heading(report: SceneCostReport) -> None:
    for table in tables(report):
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.headings)}


def test_figure_is_a_png_with_bars_and_units(report: SceneCostReport) -> None:
    pytest.importorskip("matplotlib")
    from experts.report.figures.scene_cost import picture, scene_cost_figure

    assert picture(report).startswith(b"\x89PNG")
    for axes, rows in zip(scene_cost_figure(report).axes, (report.scenes, report.features), strict=True):
        assert [label.get_text() for label in axes.get_yticklabels()] == [row.title for row in rows]
        assert "[1]" in axes.get_xlabel()
        operations_bars, time_bars = axes.containers
        found = [ratios(row, rows[0]) for row in rows]
        assert [bar.get_width() for bar in operations_bars] == [
            ratio.environment_operations for ratio in found
        ]
        assert [bar.get_width() for bar in time_bars] == [ratio.environment_time for ratio in found]
        assert all(bar.get_hatch() for bar in time_bars)


@pytest.fixture(autouse=True)
def measured(report: SceneCostReport, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements are there already."""
    monkeypatch.setattr(command, "measure", lambda effort, scenes: report)


def run(arguments: Sequence[str]) -> int:
    return main(["report", "scene-cost", *arguments])


def test_script_writes_record_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "deep" / "out"
    assert run(["--quick", "--out", str(out)]) == SUCCESS
    record = json.loads((out / "scene_cost.json").read_text(encoding="utf-8"))
    assert {"scenes", "features", "outputs", "processes", "installation"} <= set(record)
    assert record["machine"]["processor_name"]
    assert record["versions"]["casadi"]
    assert record["effort"]["scenes"] == ["paper", "no-wrist", "planar"]
    assert (out / "scene_cost.png").read_bytes().startswith(b"\x89PNG")
    assert "lagrangian_hessian" in capsys.readouterr().out


def test_script_measures_the_scenes_that_are_named(
    report: SceneCostReport,
    short_scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(command, "measure", lambda *arguments: asked.append(arguments) or report)
    file = tmp_path / "short.yaml"
    file.write_text(short_scene.to_yaml())
    out = tmp_path / "out"
    common = ["--no-picture", "--out", str(out)]
    assert run(["--scene", str(file), "--scene", "planar", *common]) == SUCCESS
    assert run(common) == SUCCESS
    assert asked == [
        (measurement.FULL, {"short": short_scene, "planar": load_scene("planar")}),
        (measurement.FULL, None),
    ]
    assert [file.name for file in out.iterdir()] == ["scene_cost.json"]


def test_script_refuses_an_unknown_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--scene", "no such scene", "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "no such scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_interrupt_saves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "measure", interrupted)
    assert run(["--out", str(tmp_path)]) == INTERRUPTED
    assert not list(tmp_path.iterdir())
