"""The benchmark: rows are there and positive, engines agree where they are timed; never how fast they are."""

import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.scene import INTEGRATORS
from experts.report import throughput, to_json
from experts.report.start_up import measure_start_up
from experts.report.throughput import (
    DYNAMICS,
    ENVIRONMENT,
    MAKE,
    MAKE_VEC,
    OURS,
    SCALAR,
    STEP,
    UNWRAPPED,
    VECTOR,
    Case,
    Effort,
    SceneThroughput,
    Timing,
    measure_scene,
    ratios,
    sample_states,
    time_cases,
    to_record,
)
from experts.report.throughput_peers import peers_of

SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark_throughput.py"
SHORT = Effort(batch_sizes=(1, 5), repeats=2, sample_seconds=1e-4)


@pytest.fixture(scope="module")
def result(short_scene: Scene) -> SceneThroughput:
    return measure_scene(short_scene, SHORT)


def test_every_row_of_ours_is_there(result: SceneThroughput) -> None:
    expected = {(DYNAMICS, way, "", size) for way in (SCALAR, VECTOR) for size in (1, 5)}
    for name in INTEGRATORS:
        expected |= {(STEP, way, name, size) for way in (SCALAR, VECTOR) for size in (1, 5)}
        expected |= {(ENVIRONMENT, MAKE_VEC, name, size) for size in (1, 5)}
        expected |= {(ENVIRONMENT, way, name, 1) for way in (MAKE, UNWRAPPED)}
    rows = [(t.what, t.way, t.integrator, t.batch) for t in result.timings if t.engine == OURS]
    assert len(rows) == len(expected)
    assert set(rows) == expected


def test_times_are_positive_and_the_best_is_not_above_the_median(result: SceneThroughput) -> None:
    for timing in result.timings:
        assert 0.0 < timing.best_ns <= timing.median_ns < math.inf


def test_operation_counts_are_those_of_the_kernels(result: SceneThroughput, short_scene: Scene) -> None:
    kernels = compile_scene(short_scene)
    dynamics = {t.operations for t in result.timings if t.engine == OURS and t.what == DYNAMICS}
    assert dynamics == {kernels.operation_count("forward_dynamics")}


def test_scalar_and_vector_kernels_give_the_same_bits(result: SceneThroughput) -> None:
    assert [a.error for a in result.agreements if a.engine == VECTOR] == [0.0]


def test_record_is_json_with_speeds(result: SceneThroughput) -> None:
    record = json.loads(to_json(to_record(result)))
    assert record["scene"] == "short"
    assert len(record["timings"]) == len(result.timings)
    for timing in record["timings"]:
        assert timing["states_per_second"] * timing["best_ns"] == pytest.approx(1e9)


def test_time_of_a_call_is_shared_by_its_states(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(throughput.time, "perf_counter", lambda: clock[0])
    durations = iter([9.0, 0.5, 9.0, 0.5, 9.0, 0.25, 9.0, 1.0])

    def run() -> None:
        clock[0] += next(durations)

    case = Case(DYNAMICS, OURS, SCALAR, "", 1000, run)
    # A warm-up and a trial, then three samples: a warm-up each, and a call that counts.
    (timing,) = time_cases([case], Effort((1000,), repeats=3, sample_seconds=0.5))
    assert (timing.best_ns, timing.median_ns) == pytest.approx((0.25e6, 0.5e6))


def test_ratio_compares_calls_on_one_state_with_each_other_and_batches_with_the_fastest() -> None:
    def timing(what: str, engine: str, integrator: str, batch: int, ns: float) -> Timing:
        return Timing(what, engine, VECTOR, integrator, batch, None, ns, ns)

    timings = [
        timing(DYNAMICS, OURS, "", 1, 500.0),
        timing(DYNAMICS, OURS, "", 64, 10.0),
        timing(STEP, OURS, "rk4", 64, 50.0),
        timing(STEP, OURS, "rk4", 1024, 40.0),
        timing(ENVIRONMENT, OURS, "rk4", 1024, 100.0),
        timing(DYNAMICS, "other", "", 1, 1000.0),
        timing(STEP, "other", "rk4", 2048, 400.0),
    ]
    single, batched = ratios(SceneThroughput("made up", 0.01, timings, [], []))
    assert (single.kernel_speed, single.environment_speed) == (2.0, None)
    assert (batched.kernel_speed, batched.environment_speed) == (10.0, 4.0)


def test_start_up_is_measured_with_a_cache_of_its_own(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path))
    times = measure_start_up(short_scene, 1)
    assert {name: len(values) for name, values in times.items()} == {
        "import": 1,
        "make, warm cache": 1,
        "make, empty cache": 1,
    }
    assert all(0.0 < value < math.inf for values in times.values() for value in values)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("package", ["pinocchio", "mujoco"])
@pytest.mark.parametrize("name", ["paper", "planar", "payload"])
def test_peer_has_the_same_accelerations(package: str, name: str) -> None:
    # Eq. (22); also of a planar base and of merged bodies.
    pytest.importorskip(package)
    kernels = compile_scene(load_scene(name))
    x, u = sample_states(kernels, 16)
    (peer,) = (peer for peer in peers_of(kernels)[0] if peer.name.lower() == package)
    ours, theirs = kernels.forward_dynamics(x, u), peer.accelerations(x, u)
    error = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert error.max() < 1e-11


def test_mujoco_takes_the_same_steps(result: SceneThroughput) -> None:
    pytest.importorskip("mujoco")
    errors = {(a.engine, a.integrator): a.error for a in result.agreements if a.unit == "rad"}
    for name in INTEGRATORS:
        # Both integrate the joints with the same formulas: the same error but for rounding.
        assert errors["MuJoCo", name] == pytest.approx(errors[OURS, name], rel=1e-6, abs=1e-11)


def test_peers_are_left_out_with_a_sentence_where_they_cannot_follow() -> None:
    peers, notes = peers_of(compile_scene("tip-load"))
    assert not peers
    assert len(notes) == 1
    assert "wrench" in notes[0]


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_throughput", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_script_writes_record_and_picture(script: ModuleType, short_scene: Scene, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    scene = tmp_path / "short.yaml"
    scene.write_text(short_scene.to_yaml())
    out = tmp_path / "out"
    assert script.main(["--quick", "--scene", str(scene), "--out", str(out)]) == 0
    record = json.loads((out / "throughput.json").read_text(encoding="utf-8"))
    assert [result["scene"] for result in record["scenes"]] == ["short"]
    assert record["machine"]["processor_name"]
    assert record["machine"]["vector_lanes"] >= 1
    assert {"numpy", "pin", "mujoco"} <= set(record["versions"])
    assert (out / "throughput.png").read_bytes().startswith(b"\x89PNG")


def test_script_refuses_an_unknown_scene(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main(["--scene", "no such scene", "--out", str(tmp_path / "out")]) == script.UNUSABLE
    assert "no such scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
