"""The benchmark: rows are there and positive, results agree where they are timed; never how fast they are."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from io import StringIO
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from rich.console import Console

from agents.command_line import main
from dq_space_arm_env import Scene, compile_scene, list_scenes
from experts.report import to_json
from experts.report.command import UNUSABLE
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.peak import Peak
from experts.report.throughput import command
from experts.report.throughput import timing as timing_module
from experts.report.throughput.environments import MAKE, MAKE_VEC, UNWRAPPED, single_case, vector_case
from experts.report.throughput.kernels import SCALAR, VECTOR
from experts.report.throughput.measurement import SceneThroughput, busy_process, measure_scene
from experts.report.throughput.mujoco_peer import SYNCHRONOUS, WRAPPED
from experts.report.throughput.ratios import ratios
from experts.report.throughput.records import scene_record, share_of_peak
from experts.report.throughput.tables import print_scene
from experts.report.throughput.timing import (
    DYNAMICS,
    ENVIRONMENT,
    FLOAT32,
    FLOAT64,
    OURS,
    STEP,
    Case,
    Effort,
    Subject,
    Timing,
    fastest,
    select,
    time_cases,
)
from experts.report.throughput.variants import PLAIN, VARIANTS, Variant

SHORT = Effort(batch_sizes=(1, 5), repeats=2, sample_seconds=1e-4)
PEAKS = {FLOAT64: Peak(FLOAT64, 8, 12, 100.0), FLOAT32: Peak(FLOAT32, 16, 12, 200.0)}


@pytest.fixture(scope="module")
def result(short_scene: Scene) -> SceneThroughput:
    return measure_scene(short_scene, SHORT)


def timing(what: str, engine: str, integrator: str, batch: int, ns: float, way: str = VECTOR) -> Timing:
    """A time made up."""
    return Timing(
        what=what, engine=engine, way=way, integrator=integrator, batch=batch, best_ns=ns, median_ns=ns
    )


def test_every_row_of_ours_is_there(result: SceneThroughput) -> None:
    plain = ((PLAIN, way) for way in (SCALAR, VECTOR))
    kernels = [*plain, *((variant, VECTOR) for variant in VARIANTS[1:])]
    programs = [(DYNAMICS, ""), *((STEP, name) for name in COMPARED_INTEGRATORS), (ENVIRONMENT, "rk4")]
    expected = {
        (what, way, name, size, variant)
        for what, name in programs
        for variant, way in kernels
        for size in (1, 5)
    }
    for name in COMPARED_INTEGRATORS:
        expected |= {(ENVIRONMENT, MAKE_VEC, name, size, PLAIN) for size in (1, 5)}
        expected |= {(ENVIRONMENT, way, name, 1, PLAIN) for way in (MAKE, UNWRAPPED)}
    expected |= {(ENVIRONMENT, MAKE_VEC, "rk4", size, variant) for size in (1, 5) for variant in VARIANTS}
    rows = [
        (t.what, t.way, t.integrator, t.batch, Variant(t.precision, t.threads))
        for t in select(result.timings, engine=OURS)
    ]
    assert len(rows) == len(expected)
    assert set(rows) == expected


def test_times_are_positive_and_the_best_is_not_above_the_median(result: SceneThroughput) -> None:
    for row in (*result.timings, *result.busy_timings):
        assert 0.0 < row.best_ns <= row.median_ns < math.inf


def test_operation_counts_are_those_of_the_kernels(result: SceneThroughput, short_scene: Scene) -> None:
    kernels = compile_scene(short_scene)
    dynamics = select(result.timings, engine=OURS, what=DYNAMICS, precision=FLOAT64)
    assert {row.operations for row in dynamics} == {kernels.operation_count("forward_dynamics")}


def test_threads_are_timed_again_beside_a_busy_process(result: SceneThroughput) -> None:
    rows = {(t.what, t.way, t.integrator, t.batch, t.precision, t.threads) for t in result.busy_timings}
    assert rows == {
        (ENVIRONMENT, way, "rk4", 5, FLOAT64, threads) for way in (VECTOR, MAKE_VEC) for threads in (1, 2)
    }
    assert len(result.busy_timings) == len(rows)


def test_scalar_and_vector_kernels_give_the_same_bits(result: SceneThroughput) -> None:
    assert [a.error for a in result.agreements if a.engine == VECTOR] == [0.0]


def test_float32_is_off_by_its_rounding(result: SceneThroughput) -> None:
    errors = {(a.unit, a.integrator): a.error for a in result.agreements if a.engine == f"{OURS}, {FLOAT32}"}
    assert set(errors) == {("1", ""), *(("rad", name) for name in COMPARED_INTEGRATORS)}
    rounding = np.finfo(np.float32).eps
    assert all(0.01 * rounding < error < 1e4 * rounding for error in errors.values())


def test_engines_that_integrate_have_the_same_errors(result: SceneThroughput) -> None:
    errors = {(a.engine, a.integrator): a.error for a in result.agreements if a.reference.startswith("RK4")}
    assert errors[OURS, "rk4"] < errors[OURS, "symplectic_euler"]
    if ("MuJoCo", "rk4") in errors:
        for name in COMPARED_INTEGRATORS:
            # Both integrate the joints with the same formulas: the same error but for rounding.
            assert errors["MuJoCo", name] == pytest.approx(errors[OURS, name], rel=1e-6, abs=1e-11)


def test_record_is_json_with_rates(result: SceneThroughput) -> None:
    record = json.loads(to_json(scene_record(result, PEAKS)))
    assert record["scene"] == "short"
    assert len(record["timings"]) == len(result.timings)
    assert len(record["timings_beside_busy_process"]) == len(result.busy_timings)
    for row in record["timings"]:
        assert row["states_per_second"] * row["best_ns"] == pytest.approx(1e9)
        if row["operations"] is not None:
            assert row["operations_per_ns"] == pytest.approx(row["operations"] / row["best_ns"])


@pytest.mark.parametrize(
    ("precision", "threads", "share"), [(FLOAT64, 1, 0.5), (FLOAT64, 2, 0.25), (FLOAT32, 1, 0.25)]
)
def test_share_of_the_peak_counts_precision_and_threads(precision: str, threads: int, share: float) -> None:
    row = replace(timing(DYNAMICS, OURS, "", 64, 10.0), precision=precision, threads=threads)
    assert share_of_peak(replace(row, operations=500), PEAKS) == share
    assert share_of_peak(row, PEAKS) is None


def test_time_of_a_call_is_shared_by_its_states(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(timing_module.time, "perf_counter", lambda: clock[0])
    durations = iter([9.0, 0.5, 9.0, 0.5, 9.0, 0.25, 9.0, 1.0])

    def run() -> None:
        clock[0] += next(durations)

    case = Case(Subject(what=DYNAMICS, engine=OURS, way=SCALAR, batch=1000), run)
    # A warm-up and a trial, then three samples: a warm-up each, and a call that counts.
    (found,) = time_cases([case], Effort((1000,), repeats=3, sample_seconds=0.5))
    assert (found.best_ns, found.median_ns) == pytest.approx((0.25e6, 0.5e6))


@pytest.mark.parametrize(("period", "calls"), [(1, 10), (4, 12), (25, 25)])
def test_samples_are_whole_periods(monkeypatch: pytest.MonkeyPatch, period: int, calls: int) -> None:
    clock = [0.0]
    monkeypatch.setattr(timing_module.time, "perf_counter", lambda: clock[0])
    count = 0

    def run() -> None:
        nonlocal count
        count += 1
        clock[0] += 1.0

    time_cases([Case(Subject(what="", engine="", way=""), run, period)], Effort((1,), 1, 9.5))
    assert count == 2 + 1 + calls  # warm-up and trial, warm-up and sample


def test_copies_end_their_episodes_evenly_apart(short_scene: Scene) -> None:
    copies, steps = 6, short_scene.simulation.steps
    env = PLAIN.make_vec(short_scene, copies, "rk4")
    case = vector_case(Subject(what=ENVIRONMENT, engine=OURS, way=MAKE_VEC), env, steps)
    actions = np.zeros(env.action_space.shape)
    ends = np.array([env.step(actions)[2] for _ in range(steps + 1)])
    assert np.array_equal(ends.sum(axis=0), np.ones(copies))
    times = np.sort(np.argmax(ends, axis=0))
    apart = np.diff([*times, times[0] + steps + 1])
    assert set(apart) <= {steps // copies, steps // copies + 1}
    assert case.period == steps // copies + 1


def test_a_single_environment_is_reset_at_the_end_of_an_episode(short_scene: Scene) -> None:
    single = gymnasium.make("DQSpaceArm-v0", scene=short_scene)
    case = single_case(Subject(what=ENVIRONMENT, engine=OURS, way=MAKE), single, 60)
    for _ in range(2 * case.period + 1):
        case.run()
    assert case.period == short_scene.simulation.steps


def test_busy_process_ends_with_its_context() -> None:
    with busy_process() as process:
        assert process.poll() is None
    assert process.returncode is not None


def test_select_and_fastest_pick_by_attributes() -> None:
    timings = [timing(STEP, OURS, "rk4", size, ns) for size, ns in ((1, 9.0), (64, 3.0), (1024, 5.0))]
    assert select(timings, batch=64) == [timings[1]]
    assert fastest(timings, what=STEP) == timings[1]
    assert fastest(timings, what=DYNAMICS) is None


def test_ratios_compare_like_with_like_and_take_the_fastest_peer() -> None:
    slow = replace(timing(DYNAMICS, OURS, "", 64, 1.0), threads=2)
    timings = [
        timing(DYNAMICS, OURS, "", 1, 500.0, SCALAR),
        timing(DYNAMICS, OURS, "", 64, 10.0),
        slow,
        timing(STEP, OURS, "rk4", 1024, 40.0),
        timing(STEP, OURS, "rk4", 4096, 30.0),
        timing(ENVIRONMENT, OURS, "rk4", 1024, 20.0),  # the kernel, not the environment
        timing(ENVIRONMENT, OURS, "rk4", 64, 300.0, MAKE_VEC),
        timing(ENVIRONMENT, OURS, "rk4", 1024, 100.0, MAKE_VEC),
        timing(ENVIRONMENT, OURS, "rk4", 1, 2000.0, MAKE),
        timing(DYNAMICS, "Pinocchio", "", 1, 1000.0, "aba"),
        timing(DYNAMICS, "Pinocchio", "", 1024, 800.0, "abaInParallel"),
        timing(STEP, "MuJoCo", "rk4", 2048, 6000.0, "rollout"),
        timing(STEP, "MuJoCo", "rk4", 1024, 5000.0, "batch"),
        timing(STEP, "MuJoCo", "symplectic_euler", 1024, 1.0, "batch"),
        timing(ENVIRONMENT, "MuJoCo", "rk4", 1, 9000.0, WRAPPED),
        timing(ENVIRONMENT, "MuJoCo", "rk4", 64, 12000.0, SYNCHRONOUS),
    ]
    found = ratios(SceneThroughput("made up", "rk4", 0.01, timings, [], [], []))
    assert {(ratio.what, ratio.theirs.way): ratio.speed for ratio in found} == {
        ("dynamics, one state", "aba"): 2.0,
        ("dynamics, batch", "abaInParallel"): 80.0,
        ("step, batch", "batch"): 125.0,
        ("1,024 environments", "batch"): 50.0,
        ("64 environments", SYNCHRONOUS): 40.0,
        ("one environment", WRAPPED): 4.5,
    }
    assert len(found) == 6


def test_tables_fit_a_terminal_of_110_columns(result: SceneThroughput) -> None:
    # As wide as numbers get; nothing may be folded.
    def typical(row: Timing) -> Timing:
        ns = 4321.0 if row.batch == 1 else 51.3
        return replace(row, batch=16384 if row.batch == 5 else row.batch, best_ns=ns, median_ns=ns)

    wide = replace(
        result,
        scene="reaction-wheels",
        timings=[typical(row) for row in result.timings],
        busy_timings=[typical(row) for row in result.busy_timings],
    )
    pages = []
    for width in (110, 200):
        console = Console(width=width, file=StringIO(), highlight=False)
        print_scene(console, wide, PEAKS)
        assert isinstance(console.file, StringIO)
        pages.append([line.rstrip() for line in console.file.getvalue().splitlines()])
    assert pages[0] == pages[1]


def test_picture_shows_engines_as_lines_whose_names_do_not_overlap(result: SceneThroughput) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.text import Text

    from experts.report.figures.style import house_style
    from experts.report.figures.throughput import throughput_figure

    ours = select(result.timings, engine=OURS)
    theirs = [
        timing(DYNAMICS, "Pinocchio", "", 1, 1001.0, "aba"),
        timing(DYNAMICS, "Pinocchio", "", 1024, 1000.0, "abaInParallel"),
        timing(DYNAMICS, "MuJoCo", "", 1, 1002.0, "mj_forward"),
        timing(STEP, "MuJoCo", "rk4", 1024, 5000.0, "batch"),
        timing(STEP, "MuJoCo", "rk4", 1024, 5500.0, "rollout"),
        timing(ENVIRONMENT, "MuJoCo", "rk4", 1, 9000.0, WRAPPED),
        timing(ENVIRONMENT, "MuJoCo", "rk4", 64, 9001.0, SYNCHRONOUS),
    ]
    with house_style():
        figure = throughput_figure([replace(result, timings=[*ours, *theirs])])
        figure.canvas.draw()
    left, right = figure.axes
    levels = [
        {line.get_ydata()[0] for line in axes.lines if list(line.get_xdata()) == [0, 1]}
        for axes in (left, right)
    ]
    assert levels[0] == {1e9 / 1001.0, 1e9 / 1000.0, 1e9 / 1002.0}
    assert levels[1] == {1e9 / 5000.0, 1e9 / 9000.0, 1e9 / 9001.0}
    for axes in (left, right):
        # Of an annotation, the text without the line that leads to it.
        boxes = sorted((Text.get_window_extent(text) for text in axes.texts), key=lambda box: box.y0)
        assert len(boxes) == 3
        assert all(below.y1 <= above.y0 for below, above in pairwise(boxes))


def run(arguments: Sequence[str]) -> int:
    return main(["report", "throughput", *arguments])


def test_script_writes_record_and_picture(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(command, "QUICK", replace(SHORT, repeats=1))
    scene = tmp_path / "short.yaml"
    scene.write_text(short_scene.to_yaml())
    out = tmp_path / "out"
    assert run(["--quick", "--features", "--scene", str(scene), "--out", str(out)]) == 0
    record = json.loads((out / "throughput.json").read_text(encoding="utf-8"))
    assert [result["scene"] for result in record["scenes"]] == ["short"]
    assert [cost["title"] for cost in record["scene_costs"]] == ["short"]
    assert record["feature_costs"][0]["title"] == "short, as it is"
    assert set(record["peaks"]) == {FLOAT64, FLOAT32}
    assert len(record["start_up"]["durations"]) == 5
    assert record["machine"]["processor_name"]
    assert record["machine"]["vector_lanes"] >= 1
    assert {"numpy", "pin", "mujoco"} <= set(record["versions"])
    assert (out / "throughput.png").read_bytes().startswith(b"\x89PNG")


def test_script_compares_all_shipped_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def measure_costs(scenes: dict[str, Scene], *_: object, **__: object) -> list[object]:
        asked.append(list(scenes))
        raise ValueError("enough")

    empty = SceneThroughput("short", "rk4", 0.01, [], [], [], [])
    monkeypatch.setattr(command, "measure_peak", lambda repeats: PEAKS)
    monkeypatch.setattr(command, "measure_scene", lambda scene, effort: empty)
    monkeypatch.setattr(command, "print_scene", lambda *_: None)
    monkeypatch.setattr(command, "measure_costs", measure_costs)
    assert run(["--all-scenes", "--out", str(tmp_path)]) == UNUSABLE
    assert asked == [["paper", *(name for name in list_scenes() if name != "paper")]]


def test_script_refuses_an_unknown_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--scene", "no such scene", "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "no such scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
