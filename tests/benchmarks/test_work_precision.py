"""Work-precision: references, arithmetic of choices, orders, formulations."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.kernels.adaptive import CATCH_NOW
from dq_space_arm_env.kernels.programs.paper_programs import PaperPrograms
from dq_space_arm_env.scene import INTEGRATORS
from experts.report.integrator_precision import observed_order
from scripts.benchmarks import work_precision
from scripts.benchmarks.effort import QUICK, Sampling
from scripts.benchmarks.harness import Row, select, shortcomings
from scripts.benchmarks.robots import OTHER_MOTIONS, robots
from scripts.benchmarks.work_precision.formulations import LIMITS, PINOCCHIO, measure_formulations
from scripts.benchmarks.work_precision.many_digits import evaluate, torque_free_motion
from scripts.benchmarks.work_precision.measurement import (
    Curve,
    Result,
    _estimates,
    default_at_step,
    errors_of,
    is_rounding,
    measure_case,
    own_choice,
    rows_of,
)
from scripts.benchmarks.work_precision.methods import PAPER, PROJECTED, Method, Walk, methods_of
from scripts.benchmarks.work_precision.motions import (
    CASES,
    DEFAULT_ACCURACY,
    MotionCase,
    make_case,
    scene_case,
)
from scripts.benchmarks.work_precision.references import Reference, reference_of

pytestmark = pytest.mark.slow  # they compile many variants of scenes

SHORT = replace(QUICK, duration=1.0, most_steps=600, step_timing=Sampling(1, 1e-3), accuracy_states=2)


def point(step: float, error: float, time: float, tolerance: float | None = None) -> Row:
    """A point whose single motion takes ten times as long as one of a batch."""
    times = {"single_ns_per_s": 1e4 * time, "batch_us_per_s": time}
    return {"step_s": step, "tolerance": tolerance, "error": error, **times}


def curve(name: str, order: int, *points: Row, adaptive: bool = False) -> Curve:
    named = [{"table": "points", "method": name, **each} for each in points]
    others = {"angular_momentum_error_kg_m2_s": 0.0, "relative_energy_error": 0.0}
    return Curve(Method(name, order, adaptive), (1.0, 0.1), [{**each, **others} for each in named])


def result(*curves: Curve, integrator: str = "rk4", step: float = 0.1, shipped: bool = False) -> Result:
    scene = load_scene("planar").replace(simulation={"dt": step, "steps": 10, "integrator": integrator})
    still = np.zeros(1)
    case = MotionCase("up", "Made up", scene, still, still[None], 1.0, 1, 1e-8, has_other_code=not shipped)
    return Result(case, "nobody", 1e-12 if shipped else None, list(curves))


LOW = curve("symplectic_euler", 1, *(point(0.1 / 2**k, 1e-2 / 2**k, 1.0 * 2**k) for k in range(6)))
HIGH = curve("rk4", 4, *(point(0.1 / 2**k, 1e-4 / 16**k, 5.0 * 2**k) for k in range(6)))


def test_choices_reach_the_accuracy_in_the_least_time() -> None:
    rows = select(rows_of(result(LOW, HIGH, curve("lost", 4))), table="cheapest")
    # The low order would need 16 times its first step.
    assert [row["batch"] for row in rows] == ["rk4, 0.1", "rk4, 0.025", "rk4, 0.00313"]
    assert [row["batch_us"] for row in rows] == [5.0, 20.0, 160.0]
    assert [row["single_us"] for row in rows] == [50.0, 200.0, 1600.0]
    coarse = select(rows_of(result(LOW)), table="cheapest")
    assert (coarse[-1]["batch"], coarse[-1]["single_us"]) == (None, None)


def test_a_default_is_cheap_at_the_step_of_the_scene_and_no_method_of_the_papers_form() -> None:
    paper = curve(PAPER, 4, point(0.1, 1e-9, 0.1))
    adaptive = curve("free", 5, point(1.0, 1e-9, 0.1, 1e-9), adaptive=True)
    good = curve("good", 6, point(0.1, 1e-8, 7.0))
    better = curve("better", 8, point(0.1, 1e-12, 9.0))
    coarse = curve("coarse", 4, point(0.1, 2.0 * DEFAULT_ACCURACY, 5.0))
    choice = default_at_step(result(LOW, coarse, paper, adaptive, good, better))
    assert choice is not None
    assert choice["method"] == "good"
    choice = default_at_step(result(LOW, coarse, paper))
    assert choice is not None
    assert choice["method"] == "coarse"  # not good enough, but the most accurate one
    assert default_at_step(result(LOW, step=0.9)) is None


def test_the_observed_order_leaves_out_coarse_steps_and_rounding() -> None:
    steps = [0.1 / 2**k for k in range(8)]
    errors = [max(1e-2 / 64**k, 3e-14) for k in range(8)]
    assert observed_order(steps, errors) == pytest.approx(6.0)
    assert observed_order(steps, [0.5] * 8) is None
    floor = [max(error, 1e-9) for error in errors]
    assert observed_order(steps, floor, uncertainty=1e-10) == pytest.approx(6.0)
    growing = [max(error, 1e-10 * 2.0**k) for k, error in enumerate(errors)]
    assert observed_order(steps, growing) == pytest.approx(6.0)
    crossing = [error * (40.0 if k == 1 else 1.0) for k, error in enumerate(errors)]
    assert observed_order(steps, crossing) == pytest.approx(6.0)
    chain = [2e-1, 1e-4, 1.6e-6, 2.4e-8, 3.8e-10, 6e-11, 2e-11, 4e-12, 1e-10, 3e-11]  # of gauss6
    assert observed_order([2.0**-k for k in range(10)], chain, 1.7e-12) == pytest.approx(6.0, abs=0.1)
    assert HIGH.observed_order(None) == pytest.approx(4.0)
    assert curve("free", 4, *HIGH.points, adaptive=True).observed_order(None) is None
    assert curve("lost", 4).observed_order(None) is None


def test_rounding_is_told_from_errors_that_fall_slowly() -> None:
    assert is_rounding([1e-9, 1e-13, 2e-13, 1.5e-13])
    assert not is_rounding([1e-9, 1e-13, 2e-13, 0.5e-13])
    assert not is_rounding([1e-5, 2e-5, 3e-5])
    assert not is_rounding([1e-13, 2e-13])


def test_the_torque_free_body_follows_jacobis_elliptic_functions() -> None:
    """Landau and Lifshitz, Mechanics, section 37: rates about the axes of the moments 5 < 9 < 12."""
    moments, start, time = (5.0, 9.0, 12.0), (0.3, 0.0, 1.0), 7.5
    with mpmath.workdps(40):
        one, two, three = (mpmath.mpf(moment) for moment in moments)
        rates = [mpmath.mpf(rate) for rate in start]
        energy = one * rates[0] ** 2 + three * rates[2] ** 2  # twice the kinetic energy
        square = (one * rates[0]) ** 2 + (three * rates[2]) ** 2
        assert square > energy * two
        m = (two - one) * (energy * three - square) / ((three - two) * (square - energy * one))
        tau = mpmath.mpf(time) * mpmath.sqrt((three - two) * (square - energy * one) / (one * two * three))
        cn, sn, dn = (mpmath.ellipfun(kind, tau, m=m) for kind in ("cn", "sn", "dn"))
        amplitude = mpmath.sqrt((energy * three - square) / (two * (three - two)))
        expected = (rates[0] * cn, amplitude * sn, rates[2] * dn)
        q, omega = torque_free_motion(moments, start, (1.0, 0.0, 0.0, 0.0), time)
        assert mpmath.norm([a - b for a, b in zip(omega, expected, strict=True)]) < 1e-29
        assert abs(mpmath.norm(q) - 1) < 1e-29
        assert mpmath.norm(q[1:]) > 0.1


def test_the_angular_momentum_of_the_torque_free_body_stays_in_inertial_axes() -> None:
    moments, start = (12.0, 9.0, 5.0), (0.03, 1.0, 0.02)
    q, omega = torque_free_motion(moments, start, (0.6, 0.0, 0.8, 0.0), 12.0)

    def inertial(q: list[mpmath.mpf], rates: list[mpmath.mpf]) -> mpmath.matrix:
        w, x, y, z = q
        rotation = mpmath.matrix(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return rotation * mpmath.matrix([m * rate for m, rate in zip(moments, rates, strict=True)])

    with mpmath.workdps(40):
        before = inertial([mpmath.mpf(entry) for entry in (0.6, 0.0, 0.8, 0.0)], list(start))
        # 0.6 and 0.8 are rounded: their squares add up to one to 16 digits only.
        assert mpmath.norm(inertial(q, omega) - before) < 1e-14


def test_the_reference_of_an_arm_agrees_with_our_own_accelerations() -> None:
    pytest.importorskip("pinocchio")
    case = make_case("stiff", 0.5)
    reference = reference_of(case, second=True)
    assert "Pinocchio" in reference.source
    assert reference.second is not None
    np.testing.assert_allclose(reference.second, reference.state, rtol=0, atol=1e-12)
    assert np.abs(reference.state - case.start).max() > 0.05


@pytest.mark.slow
def test_the_reference_follows_inputs_and_wrist() -> None:
    case = make_case("maneuver", 0.3)
    assert len(case.controls) == 20
    kernels = compile_scene(case.scene)
    x = case.start
    for u in np.repeat(case.controls, 8, axis=0):
        x = kernels.step(x, u, case.hold / 8, "rk4")
    errors = errors_of(kernels, x, reference_of(case).state)
    assert errors["error"] < 1e-11
    assert errors["base_linear_velocity_error_m_s"] < 1e-12


def test_a_missing_package_is_told_and_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work_precision, "find_spec", lambda name: None)
    (row,) = work_precision.measure(SHORT)
    assert row["note"].startswith("The references need scipy and mpmath: pip install")


def test_only_integrators_that_take_the_robot_follow_its_motion() -> None:
    still = np.zeros(1)
    case = MotionCase("up", "Made up", load_scene("heavy-wrist"), still, still[None], 1.0, 1, 1e-8)
    assert [method.name for method in methods_of(case)] == ["rk4", "rk6", "rk8", "dormand_prince"]


@pytest.mark.parametrize("name", CASES)
def test_cases_move(name: str) -> None:
    case = make_case(name, 1.0)
    assert case.duration == pytest.approx(1.0, abs=0.05)
    walk = Walk(Method("rk4", 4), compile_scene(case.scene), case)
    walk.run(512 if len(case.controls) == 1 else 8)
    assert np.isfinite(walk.state).all()
    assert np.abs(walk.state - case.start).max() > 1e-4  # the maneuver begins at rest


def test_a_walk_takes_the_steps_of_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also across the end of the rows that are taken at a time."""
    monkeypatch.setattr("scripts.benchmarks.work_precision.methods._ROWS", 7)
    case = make_case("maneuver", 0.3)
    kernels = compile_scene(case.scene)
    walk = Walk(Method("rk4", 4), kernels, case)
    walk.run(2)
    states = [case.start]
    for u in np.repeat(case.controls, 2, axis=0):
        states.append(kernels.step(states[-1], u, case.hold / 2, "rk4"))
    assert np.array_equal(walk.state, states[-1])
    passed, inputs = walk.passed(2, 5)
    assert np.array_equal(passed, np.array(states)[[0, 9, 19, 29, 39]])
    assert np.array_equal(inputs, case.controls[[0, 4, 9, 14, 19]])


def staged(name: str) -> MotionCase:
    """Nothing is done in a scene, from its start, whatever its phases change."""
    scene = load_scene(name)
    kernels, still = compile_scene(scene), np.zeros((scene.simulation.steps, compile_scene(scene).n_u))
    start = kernels.layout.initial_state.astype(np.float64)
    rows = kernels.stage_parameters()[:-1]
    return MotionCase(name, name, scene, start, still, scene.simulation.dt, 1, 0.0, parameters=rows)


def test_a_walk_goes_through_the_phases_of_a_scene_and_catches_once() -> None:
    """The parameters are those of the hold; where its steps are divided, a catch follows the last of them."""
    case = staged("capture-and-detumble")
    kernels, rows = compile_scene(case.scene), case.parameters
    assert rows is not None
    now = kernels.parameters.names.index(CATCH_NOW)
    assert rows[:, now].sum() == 1.0
    walk, before = Walk(Method("rk4", 4), kernels, case), rows.copy()
    before[:, now] = 0.0
    for per_hold in (1, 2):
        walk.run(per_hold)
        x = case.start
        for row, u in enumerate(case.controls):
            for p in [before[row]] * (per_hold - 1) + [rows[row]]:
                x = kernels.step(x, u, case.hold / per_hold, "rk4", p=p)
        assert np.array_equal(walk.state, x)
        assert np.abs(x - case.start).max() > 1e-3  # caught


@pytest.mark.parametrize("name", ["motors", "capture-and-detumble"])
def test_global_errors_are_not_estimated_where_adaptive_steps_do_not_follow(name: str) -> None:
    case = staged(name)
    assert list(_estimates(case, Reference(case.start, "nobody"), SHORT)) == []


def test_the_maneuver_of_a_scene_has_the_parameters_of_its_stages() -> None:
    case = scene_case("planar")
    assert case.parameters is not None
    assert len(case.parameters) == len(case.controls)


@pytest.fixture(scope="module")
def body() -> Result:
    return measure_case(make_case("body", 2.0), replace(SHORT, most_steps=12_000))


def test_every_integrator_shows_its_order_on_the_free_body(body: Result) -> None:
    assert [curve.method.name for curve in body.curves] == list(INTEGRATORS)
    shown = [(curve.method, curve.observed_order(body.uncertainty)) for curve in body.curves]
    for method, order in shown:
        if not method.is_adaptive:
            assert order is not None, method.name
            # Methods that keep the momentum may converge faster where nothing else moves.
            assert "momentum" in method.name or order < method.order + 0.6, method.name
    assert shortcomings(rows_of(body)) == []
    assert "30 digits" in body.source
    rk4 = next(curve for curve in body.curves if curve.method.name == "rk4")
    assert min(point["error"] for point in rk4.points) < 1e-12


def test_steps_of_a_method_that_iterates_are_timed_at_each_length(body: Result) -> None:
    of_a_step = {
        curve.method.name: {round(1e3 * each["batch_us_per_s"] * each["step_s"], 6) for each in curve.points}
        for curve in body.curves
    }
    assert len(of_a_step["gauss6"]) > 1 == len(of_a_step["rk4"])


@pytest.mark.slow
def test_the_paper_form_follows_the_maneuver_and_projection_keeps_the_joints_together() -> None:
    case = make_case("maneuver", 0.6)
    kernels = compile_scene(case.scene)
    reference = reference_of(case).state
    for name in (PAPER, PROJECTED):
        (method,) = methods_of(case, [name])
        assert method.order == 4
        walk = Walk(method, kernels, case)
        walk.run(1)
        assert errors_of(kernels, walk.state, reference)["error"] < 1e-8
        y = walk._states[:1]
        again = method.own_state(kernels, method.minimal_state(kernels, y))
        off = np.abs(again - y).max()
        assert (off < 1e-14) if name == PROJECTED else (1e-14 < off < 1e-5)


@pytest.mark.parametrize("scene", ["paper", "planar", "payload", "no-wrist"])
def test_the_whole_system_20_and_its_schur_complement_give_the_accelerations(scene: str) -> None:
    kernels = compile_scene(scene)
    rng = np.random.default_rng(0)
    x = kernels.layout.initial_state.copy()
    moving = (kernels.layout.state.base_velocity, kernels.layout.state.joint_rates)
    for part in moving:
        x[part] = rng.uniform(-0.5, 0.5, part.stop - part.start)
    u = rng.uniform(-1.0, 1.0, kernels.n_u)
    programs = PaperPrograms(kernels.scene)
    graphs = {
        name: programs.build(name).calls[0].graph
        for name in ("from_minimal", "to_minimal", "system", "free_accelerations", "accelerations")
    }
    with mpmath.workdps(30):
        (y,) = evaluate(graphs["from_minimal"], x.tolist())
        (back,) = evaluate(graphs["to_minimal"], y)
        matrix, right = evaluate(graphs["system"], y, u.tolist())
        (schur,) = evaluate(graphs["accelerations"], y, u.tolist())
        n = len(right)
        rows = mpmath.matrix([matrix[n * i : n * i + n] for i in range(n)])
        solution = list(mpmath.lu_solve(rows, mpmath.matrix(right)))
        size = 8 * (len(kernels.scene.links) + 1)
        (whole,) = evaluate(graphs["free_accelerations"], y, solution[:size])
    expected = kernels.forward_dynamics(x, u)
    np.testing.assert_allclose([float(entry) for entry in back], x, rtol=0, atol=1e-15)
    np.testing.assert_allclose([float(entry) for entry in schur], expected, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose([float(entry) for entry in whole], expected, rtol=1e-11, atol=1e-13)


@pytest.mark.endurance  # the quick benchmark, which CI runs, judges the same
def test_formulations_agree_within_their_precision() -> None:
    rows = list(measure_formulations(SHORT))
    assert shortcomings(rows) == []
    found = select(rows, table="formulations")
    ours = [row for row in found if row["formulation"] != PINOCCHIO]
    assert [row["precision"] for row in ours] == ["float64"] * 5 + ["float32"] * 5
    for row in found:
        assert 0.0 < row["median_error"] <= row["largest_error"] < LIMITS[row["precision"]]
        assert 0.0 < row["backward_error"] <= row["largest_error"]
        assert row["single_ns"] > 0.0
    assert min(row["largest_error"] for row in ours if row["precision"] == "float32") > 1e-9


def test_shortcomings_name_what_is_inaccurate() -> None:
    slow = curve("rk6", 4, *(point(0.1 / 2**k, 1e-4 / 4**k, 1.0) for k in range(6)))
    assert shortcomings(rows_of(result(slow))) == [
        "motions: up, best integrator: the error 9.8e-08 is above 1e-08 m, rad.",
        "orders: up, rk6: the error 2.0e+00 is above 0.3. shows order 2.00, claims 4",
    ]
    assert len(shortcomings(rows_of(result(slow), all_methods=False))) == 1  # of one method, only the order
    (sentence,) = shortcomings(rows_of(result(curve("lost", 4))))
    assert sentence == "motions: up, best integrator: the error is not finite."


@pytest.mark.parametrize("floor", [2e-3, 3e-5, 1e-7, 1e-9])
def test_a_method_that_stops_converging_fails_its_claim(floor: float) -> None:
    """Above rounding, wherever that is."""
    rows = [point(0.96 / 2**k, max(0.9 / 16**k, floor), 1.0) for k in range(12)]
    found = shortcomings(rows_of(result(curve("rk4", 4, *rows)), all_methods=False))
    assert [sentence.partition(":")[0] for sentence in found] == ["orders"] * (floor > 1e-8)
    few = result(curve("rk4", 4, *rows[:3]))  # steps too long to tell
    assert shortcomings(rows_of(few, all_methods=False)) == []


def test_a_scene_is_judged_by_its_own_integrator() -> None:
    own = result(LOW, HIGH, integrator="symplectic_euler", shipped=True)
    (row,) = select(rows_of(own), table="defaults")
    found = (row["own"], row["own_error"], row["best"], row["best_error"])
    assert found == ("symplectic_euler", 1e-2, "rk4", 1e-4)
    (sentence,) = shortcomings(rows_of(own))
    assert sentence.startswith("scenes: up, symplectic_euler: the error 1.0e-02 is above 0.0001 m, rad")
    assert shortcomings(rows_of(result(LOW, HIGH, shipped=True))) == []
    poor = replace(result(LOW, HIGH, shipped=True), uncertainty=1e-3)
    (sentence,) = shortcomings(rows_of(poor))
    assert sentence.startswith("references: up, nobody: the error 1.0e-03 is above 1e-05 m, rad")
    unmeasured = result(LOW, HIGH, integrator="rk8", shipped=True)
    assert own_choice(unmeasured) is None
    assert shortcomings(rows_of(unmeasured)) == []
    for lost, said in ((0.1, ["scenes: up, rk4: the error is not finite. its own"]), (1.0, [])):
        blown_up = replace(HIGH, points=HIGH.points[1:], lost=[lost])
        found = shortcomings(rows_of(result(LOW, blown_up, shipped=True)))
        assert [sentence[: len(start)] for sentence, start in zip(found, said, strict=True)] == said


def test_the_maneuver_of_a_scene_is_followed() -> None:
    methods = ("rk4", "rk6", "dormand_prince")
    changes = {"maneuvers": ("planar",), "maneuver_steps": 2000, "methods": methods}
    rows = list(work_precision.measure(replace(SHORT, only=("scenes",), **changes)))
    assert shortcomings(rows) == []
    points = [row["method"] for row in select(rows, table="points")]
    assert [points.count(name) for name in methods] == [2, 2, 3]
    (reference,) = select(rows, table="references")
    assert reference["second_reference_off_by"] < 1e-11


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("name", [*robots(), *OTHER_MOTIONS])
def test_the_integrator_of_each_robot_follows_from_the_errors(name: str) -> None:
    case = scene_case(name)
    own = Method(case.scene.simulation.integrator, 4)
    walk = Walk(own, own.kernels(case.scene), case)
    walk.run(1)
    errors = errors_of(own.kernels(case.scene), walk.state, reference_of(case).state)
    assert errors["error"] < DEFAULT_ACCURACY


def test_a_lost_state_has_no_finite_error() -> None:
    kernels = compile_scene(load_scene("paper"))
    x = kernels.layout.initial_state
    lost = x.copy()
    lost[0] = np.nan
    assert errors_of(kernels, lost, x)["error"] == np.inf
