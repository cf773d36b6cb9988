"""Throughput: rows are there and positive, results agree where they are timed; never how fast they are."""

import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene
from experts.report import timing as clock_module
from scripts.benchmarks.effort import QUICK, Sampling
from scripts.benchmarks.harness import Row, select, shortcomings
from scripts.benchmarks.peers.mujoco_peer import WRAPPED
from scripts.benchmarks.subjects import (
    COMPARED_INTEGRATORS,
    DYNAMICS,
    ENVIRONMENT,
    EPISODES,
    FLOAT32,
    FLOAT64,
    MAKE,
    MAKE_VEC,
    OURS,
    PLAIN,
    SCALAR,
    STEP,
    SYNCHRONOUS,
    VECTOR,
    Case,
    Subject,
    fastest,
    single_case,
    time_cases,
    vector_case,
)
from scripts.benchmarks.throughput.measurement import busy_process, measure_scene, ratios

pytestmark = pytest.mark.slow  # they compile many variants of scenes

SHORT = replace(QUICK, batch_sizes=(1, 5), kernel_timing=Sampling(2, 1e-4))
PEAKS = {FLOAT64: 100.0, FLOAT32: 200.0}


@pytest.fixture(scope="module")
def rows(short_scene: Scene) -> list[Row]:
    return list(measure_scene(short_scene, SHORT, PEAKS))


def test_times_are_positive_and_consistent(rows: list[Row]) -> None:
    for row in select(rows, table="timings"):
        assert 0.0 < row["best_ns"] <= row["median_ns"] < math.inf
        assert row["states_per_second"] * row["best_ns"] == pytest.approx(1e9)
        if row["operations"] is not None:
            share = row["operations"] / row["best_ns"] / PEAKS[row["precision"]]
            assert row["share_of_peak"] == pytest.approx(share / row["threads"])


def test_operation_counts_are_those_of_the_kernels(rows: list[Row], short_scene: Scene) -> None:
    dynamics = select(rows, table="timings", engine=OURS, what=DYNAMICS, precision=FLOAT64)
    expected = compile_scene(short_scene).operation_count("forward_dynamics")
    assert {row["operations"] for row in dynamics} == {expected}


def test_the_gradient_of_episodes_is_timed_by_decision(rows: list[Row]) -> None:
    pytest.importorskip("threadpoolctl")
    (found,) = select(rows, table="timings", what=EPISODES)
    assert found["batch"] == 128 * 50


def test_engines_agree(rows: list[Row]) -> None:
    assert shortcomings(rows) == []
    found = select(rows, table="agreements")
    assert [row["error"] for row in found if row["engine"] == VECTOR] == [0.0]
    rounding = np.finfo(np.float32).eps
    single = select(found, engine=f"{OURS}, {FLOAT32}")
    assert len(single) == 1 + len(COMPARED_INTEGRATORS)
    assert all(0.01 * rounding < row["error"] < 1e4 * rounding for row in single)
    errors = {(r["engine"], r["integrator"]): r["error"] for r in found if r["reference"].startswith("RK4")}
    assert errors[OURS, "rk4"] < errors[OURS, "symplectic_euler"]
    if ("MuJoCo", "rk4") in errors:
        for name in COMPARED_INTEGRATORS:
            # Both integrate the joints with the same formulas: the same error but for rounding.
            assert errors["MuJoCo", name] == pytest.approx(errors[OURS, name], rel=1e-6, abs=1e-11)


def test_time_of_a_call_is_shared_by_its_states(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(clock_module.time, "perf_counter", lambda: clock[0])
    durations = iter([9.0, 0.5, 9.0, 0.5, 9.0, 0.25, 9.0, 1.0])

    def run() -> None:
        clock[0] += next(durations)

    case = Case(Subject(what=DYNAMICS, engine=OURS, way=SCALAR, batch=1000), run)
    # A warm-up and a trial, then three samples: a warm-up each, and a call that counts.
    (found,) = time_cases([case], Sampling(3, 0.5))
    assert (found["best_ns"], found["median_ns"]) == pytest.approx((0.25e6, 0.5e6))


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


def timing(what: str, engine: str, integrator: str, batch: int, ns: float, way: str = VECTOR) -> Row:
    """A time made up."""
    subject = Subject(what=what, engine=engine, way=way, integrator=integrator, batch=batch)
    return {**vars(subject), "best_ns": ns, "median_ns": ns}


def test_ratios_compare_like_with_like_and_take_the_fastest_peer(short_scene: Scene) -> None:
    timings = [
        timing(DYNAMICS, OURS, "", 1, 500.0, SCALAR),
        timing(DYNAMICS, OURS, "", 64, 10.0),
        {**timing(DYNAMICS, OURS, "", 64, 1.0), "threads": 2},
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
    assert fastest(timings, what=STEP, engine=OURS) == timings[4]
    found = {(row["what"], row["theirs"]): row["speed"] for row in ratios(short_scene, timings)}
    assert found == {
        ("dynamics, one state", "Pinocchio: aba"): 2.0,
        ("dynamics, batch", "Pinocchio: abaInParallel, 1,024"): 80.0,
        ("rk4 step, batch", "MuJoCo: batch, 1,024"): 125.0,
        ("rk4 1,024 environments", "MuJoCo: batch, 1,024"): 50.0,
        ("rk4 64 environments", f"MuJoCo: {SYNCHRONOUS}, 64"): 40.0,
        ("rk4 one environment", f"MuJoCo: {WRAPPED}"): 4.5,
    }
