"""The work-precision report: references, arithmetic of choices, orders, formulations."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest

from dq_space_arm_env import compile_scene, list_scenes, load_scene
from dq_space_arm_env.integrators import INTEGRATORS
from dq_space_arm_env.kernels.paper_programs import PaperPrograms
from experts.report.work_precision.benchmark import SCENES, WorkPrecision, measure, shortcomings
from experts.report.work_precision.cases import (
    CASES,
    DEFAULT_ACCURACY,
    chain_scene,
    make_case,
    scene_case,
    stiff_scene,
)
from experts.report.work_precision.choices import (
    cheapest,
    default_at_step,
    observed_order,
    order_of,
    own_choice,
)
from experts.report.work_precision.effort import QUICK
from experts.report.work_precision.formulations import (
    LIMITS,
    PINOCCHIO,
    Formulation,
    Formulations,
    measure_formulations,
)
from experts.report.work_precision.many_digits import evaluate
from experts.report.work_precision.measurement import (
    CaseResult,
    Curve,
    Errors,
    Point,
    errors_of,
    is_rounding,
    measure_case,
)
from experts.report.work_precision.methods import PAPER, PROJECTED, Method, Walk, methods_of
from experts.report.work_precision.references import reference_of
from experts.report.work_precision.rigid_body import torque_free_motion
from experts.report.work_precision.tables import notes, tables

SHORT = replace(
    QUICK, scenes=(), duration=1.0, most_steps=600, timing=replace(QUICK.timing, repeats=1), states=2
)


def point(step: float, error: float, time: float, tolerance: float | None = None) -> Point:
    """A point whose single motion takes ten times as long as one of a batch."""
    errors = Errors(error, 0.5 * error, 0.0, 0.0, 0.0, 0.0, 0.0)
    return Point(step, tolerance, round(1.0 / step), errors, 10.0 * time, time)


def curve(name: str, order: int, *points: Point, adaptive: bool = False) -> Curve:
    return Curve(name, name, order, adaptive, points, (), 1.0, 0.1, None)


def result(*curves: Curve, limit: float = 1e-8, uncertainty: float | None = None) -> CaseResult:
    origin = ("made up", "Made up", "none", 1.0, 0.1, "low")
    return CaseResult(*origin, limit, True, "nobody", uncertainty, curves)


LOW = curve("low", 1, *(point(0.1 / 2**k, 1e-2 / 2**k, 1.0 * 2**k) for k in range(6)))
HIGH = curve("high", 4, *(point(0.1 / 2**k, 1e-4 / 16**k, 5.0 * 2**k) for k in range(6)))


def test_the_cheapest_choice_reaches_the_accuracy_in_the_least_time() -> None:
    found = cheapest([LOW, HIGH], 1e-2, batch=True)
    assert found is not None
    assert (found.method, found.point.step) == ("low", 0.1)
    found = cheapest([LOW, HIGH], 1e-3, batch=True)
    assert found is not None
    assert (found.method, found.point.step) == ("high", 0.1)  # low needs 16 times its first step
    found = cheapest([LOW, HIGH], 1e-6, batch=False)
    assert found is not None
    assert (found.method, found.point.single_ns) == ("high", 200.0)
    assert cheapest([LOW, HIGH], 1e-12, batch=True) is None


def test_the_larger_error_of_position_and_attitude_counts() -> None:
    turned = replace(point(0.1, 0.0, 1.0), errors=Errors(1e-9, 1e-2, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert cheapest([curve("turned", 1, turned)], 1e-3, batch=True) is None


def test_a_default_is_cheap_at_the_step_of_the_scene_and_no_method_of_the_papers_form() -> None:
    paper = curve("paper", 4, point(0.1, 1e-9, 0.1))
    adaptive = curve("free", 5, point(1.0, 1e-9, 0.1, 1e-9), adaptive=True)
    good = curve("good", 6, point(0.1, 1e-8, 7.0))
    better = curve("better", 8, point(0.1, 1e-12, 9.0))
    coarse = curve("coarse", 4, point(0.1, 2.0 * DEFAULT_ACCURACY, 5.0))
    choice = default_at_step(result(LOW, coarse, paper, adaptive, good, better), 0.1)
    assert choice is not None
    assert choice.method == "good"
    choice = default_at_step(result(LOW, coarse, paper), 0.1)
    assert choice is not None
    assert choice.method == "coarse"  # not good enough, but the most accurate one
    assert default_at_step(result(LOW), 0.9) is None


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
    assert order_of(HIGH, None) == pytest.approx(4.0)
    assert order_of(replace(HIGH, is_adaptive=True), None) is None
    assert order_of(curve("lost", 4), None) is None


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
    np.testing.assert_allclose(reference.second, reference.state, atol=1e-12)
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
    assert errors.pose < 1e-11
    assert errors.linear_velocity < 1e-12


@pytest.mark.parametrize("name", CASES)
def test_cases_move(name: str) -> None:
    case = make_case(name, 1.0)
    assert case.duration == pytest.approx(1.0, abs=0.05)
    walk = Walk(Method("rk4", 4), compile_scene(case.scene), case)
    walk.run(512 if len(case.controls) == 1 else 8)
    assert np.isfinite(walk.state).all()
    assert np.abs(walk.state - case.start).max() > 1e-4  # the maneuver begins at rest


def test_scenes_of_cases_are_what_they_say() -> None:
    assert [link.stiffness for link in stiff_scene().links] == [0.0, 1e4, 0.0]
    assert stiff_scene(500.0).links[1].damping == 500.0
    chain = chain_scene()
    assert len(chain.links) == len(chain.initial_state.joint_angles) == 8


def test_a_walk_takes_the_steps_of_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also across the end of the rows that are taken at a time."""
    monkeypatch.setattr("experts.report.work_precision.methods._ROWS", 7)
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


@pytest.fixture(scope="module")
def body() -> CaseResult:
    return measure_case(make_case("body", 2.0), replace(SHORT, most_steps=12_000))


def test_every_integrator_shows_its_order_on_the_free_body(body: CaseResult) -> None:
    assert [curve.method for curve in body.curves] == list(INTEGRATORS)
    shown = [(curve, order_of(curve, body.uncertainty)) for curve in body.curves if not curve.is_adaptive]
    assert len(shown) > 1
    for each, order in shown:
        assert order is not None, each.method
        assert order > each.order - 0.3, each.method
        # Methods that keep the momentum may converge faster where nothing else moves.
        assert "momentum" in each.method or order < each.order + 0.6, each.method


def test_the_free_body_is_right_to_rounding(body: CaseResult) -> None:
    assert "30 digits" in body.reference
    rk4 = next(curve for curve in body.curves if curve.method == "rk4")
    assert min(point.errors.pose for point in rk4.points) < 1e-12
    assert shortcomings(WorkPrecision(SHORT, None, (body,), None)) == []


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
        assert errors_of(kernels, walk.state, reference).pose < 1e-8
        y = walk._states[:1]
        again = method.own_state(kernels, method.minimal_state(kernels, y))
        off = np.abs(again - y).max()
        assert (off < 1e-14) if name == PROJECTED else (1e-14 < off < 1e-5)


def test_other_scenes_have_no_paper_form() -> None:
    case = make_case("body", 1.0)
    assert [method.name for method in methods_of(case)] == list(INTEGRATORS)
    assert methods_of(case, ["rk4"]) == [Method("rk4", 4)]


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
    np.testing.assert_allclose([float(entry) for entry in back], x, atol=1e-15)
    np.testing.assert_allclose([float(entry) for entry in schur], expected, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose([float(entry) for entry in whole], expected, rtol=1e-11, atol=1e-13)


@pytest.mark.slow
def test_formulations_agree_within_their_precision() -> None:
    found = measure_formulations(SHORT)
    assert found.reference_agreement < 1e-14
    ours = [each for each in found.results if each.name != PINOCCHIO]
    assert [each.precision for each in ours] == ["float64"] * 5 + ["float32"] * 5
    for each in found.results:
        assert 0.0 < each.median_error <= each.largest_error < LIMITS[each.precision]
        assert 0.0 < each.backward_error <= each.largest_error
        assert each.single_ns is not None
        assert each.single_ns > 0.0
    assert min(each.largest_error for each in ours if each.precision == "float32") > 1e-9
    assert shortcomings(WorkPrecision(SHORT, None, (), found)) == []


def test_shortcomings_name_what_is_inaccurate() -> None:
    slow = curve("slow", 4, *(point(0.1 / 2**k, 1e-4 / 4**k, 1.0) for k in range(6)))
    lost = replace(result(curve("lost", 4)), case="hopeless")
    bad = Formulation("minimal coordinates", "float64", 1e-9, 1e-10, 1e-11, 1.0, 1.0)
    formulations = Formulations("paper", 2, 0.0, (bad, replace(bad, largest_error=float("nan"))), ())
    found = WorkPrecision(SHORT, None, (result(slow), lost), formulations)
    assert [sentence.split(" ", 1)[1] for sentence in shortcomings(found)] == [
        "up: the smallest error of any integrator is 9.8e-08; it should be below 1e-08.",
        "up: slow shows order 2.00; it claims 4.",
        "the smallest error of any integrator is lost; it should be below 1e-08.",
        "coordinates in float64: relative error 1.0e-09 of accelerations; it should be below 1e-12.",
        "coordinates in float64: relative error nan of accelerations; it should be below 1e-12.",
    ]
    chosen = replace(found, methods=("slow",), formulations=None)
    assert len(shortcomings(chosen)) == 1  # of one method alone, only the order is judged


def test_tables_show_choices_and_what_is_not_reached() -> None:
    found = WorkPrecision(SHORT, None, (result(LOW, HIGH, curve("lost", 4), uncertainty=2e-13),), None)
    case, choices, defaults = tables(found)
    assert [row[0] for row in case.rows] == ["low", "high", "lost"]
    assert case.rows[2][4] == "lost"
    assert choices.rows[0] == ("Made up", "0.001", "high, 0.1", "0.00500", "high, 0.1", "0.0500")
    assert choices.rows[2][2:] == ("high, 0.00313", "0.160", "high, 0.00313", "1.60")
    coarse = replace(found, cases=(result(LOW),))
    assert tables(coarse)[1].rows[2] == ("", "1e-09", "not reached", "-", "not reached", "-")
    assert defaults.rows == (("Made up", "0.1", "high", "0.1", "1e-04"),)
    assert notes(found)[1:] == [
        "Made up: reference nobody; on our own accelerations it ends 2e-13 from there."
    ]


def test_a_scene_is_told_from_its_own_integrator_and_the_cheapest_that_is_right() -> None:
    coarse = result(LOW, HIGH)
    found = WorkPrecision(SHORT, None, (), None, (coarse,))
    *_, choices = tables(found)
    assert choices.rows == (("none", "low", "1e-02", "high", "1e-04"),)
    (sentence,) = shortcomings(found)
    assert sentence.startswith("scene none: low, its own integrator, ends the expert's maneuver 1e-02 off")
    good = replace(coarse, integrator="high")
    assert shortcomings(replace(found, scenes=(good,))) == []
    unmeasured = replace(coarse, integrator="other")
    assert own_choice(unmeasured) is None
    assert shortcomings(replace(found, scenes=(unmeasured,))) == []


def test_the_maneuver_of_a_scene_is_followed() -> None:
    effort = replace(SHORT, scenes=("planar",), scene_steps=2000)
    found = measure(effort, [SCENES], ["rk4", "rk6", "dormand_prince"])
    (planar,) = found.scenes
    assert [(curve.method, len(curve.points)) for curve in planar.curves][:2] == [("rk4", 2), ("rk6", 2)]
    assert planar.uncertainty is not None
    assert planar.uncertainty < 1e-11
    assert shortcomings(found) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", list_scenes())
def test_the_integrator_of_each_scene_follows_from_the_errors(name: str) -> None:
    case = scene_case(name)
    own = Method(case.scene.simulation.integrator, 4)
    walk = Walk(own, own.kernels(case.scene), case)
    walk.run(1)
    assert errors_of(own.kernels(case.scene), walk.state, reference_of(case).state).pose < DEFAULT_ACCURACY


def test_missing_packages_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    module = "experts.report.work_precision.benchmark.find_spec"
    monkeypatch.setattr(module, lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"scipy and mpmath: pip install .dq-space-arm\[test\]"):
        measure(SHORT)


def test_without_pinocchio_the_references_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pinocchio", None)
    case = make_case("spin", 0.05)
    assert "our own" in reference_of(case).source
    found = measure_formulations(SHORT)
    assert found.notes == ("Pinocchio's articulated body: left out, it is not installed (pip install pin).",)


def test_a_lost_state_has_no_finite_error() -> None:
    kernels = compile_scene(load_scene("paper"))
    x = kernels.layout.initial_state
    lost = x.copy()
    lost[0] = np.nan
    assert errors_of(kernels, lost, x).pose == np.inf
