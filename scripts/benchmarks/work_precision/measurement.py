"""Error and time of methods on a motion, for steps from coarse to where rounding dominates.

From these follow observed orders, the cheapest choice for an accuracy, and the integrator of a scene.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.kernels.adaptive import CATCH_NOW
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from experts.report.integrator_precision import (
    ACCURACIES,
    BATCH,
    LARGEST_FLOOR,
    LOST,
    cheapest,
    observed_order,
)
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim
from scripts.benchmarks.subjects import OURS, STEP, Case, Subject, time_cases
from scripts.benchmarks.work_precision.methods import Method, Walk, methods_of
from scripts.benchmarks.work_precision.motions import DEFAULT_ACCURACY, MotionCase, scene_case
from scripts.benchmarks.work_precision.references import Reference, reference_of

SINGLE_ROWS = 256  # timed steps of a single motion in a row
ORDER_TOLERANCE = 0.3  # largest deficit of an observed order below the claimed one
ERRORS = {
    "tip_position_error_m": "position",
    "tip_attitude_error_rad": "attitude",
    "base_angular_velocity_error_rad_s": "angular velocity",
    "base_linear_velocity_error_m_s": "linear velocity",
    "center_velocity_error_m_s": "linear momentum per mass",
    "angular_momentum_error_kg_m2_s": "angular momentum about the center of mass",
    "relative_energy_error": "energy",
}
"""Errors of a state by name of their column; the pose error is the larger one of the tip's."""
LARGEST_RATIO = 1.2
"""Largest factor by which an estimated global error may be off, up or down."""
_ESTIMATED, _UNCERTAINTIES = 1e-11, 30.0  # errors that an estimate can tell
_REFERENCE = 0.1 * DEFAULT_ACCURACY  # largest uncertainty of the reference of a scene's maneuver
_FAR_OFF = 1e6  # entries of a lost state
_ROUNDING = 1e-9  # below, an error that no longer falls with the step is due to rounding
_LONG_RUN_SECONDS = 0.05
_SHORT_ENOUGH = 1e-5  # error that steps promise which must show an order


_Times = dict[tuple[str, float | None, int], tuple[float, float]]
"""ns per step of a single motion and of one of a batch, by method, tolerance, and steps per hold."""


@dataclass
class Curve:
    """A method on a motion."""

    method: Method
    step_ns: tuple[float, float]  # of a single motion, and of one of a batch; of the finest tolerance or step
    points: list[Row] = field(default_factory=list)  # coarsest first
    lost: list[float] = field(default_factory=list)  # steps [s] or tolerances that lose the motion
    long_run_ratio: float | None = None  # time of a whole run over that of its steps

    def observed_order(self, uncertainty: float | None) -> float | None:
        """Order of convergence; None for an adaptive method, or if no step shows it."""
        if self.method.is_adaptive or len(self.points) < 2:
            return None
        steps, errors = ([point[key] for point in self.points] for key in ("step_s", "error"))
        return observed_order(steps, errors, uncertainty or 0.0)

    def stagnates(self, uncertainty: float | None) -> bool:
        """Whether errors stop falling, by the order claimed much too early: that shows no order either."""
        if self.method.is_adaptive or len(self.points) < 2:
            return False
        first, last = self.points[0], self.points[-1]
        promised = first["error"] * (last["step_s"] / first["step_s"]) ** self.method.order
        least: float = min(point["error"] for point in self.points)
        return promised < _SHORT_ENOUGH and least > max(LARGEST_FLOOR, _UNCERTAINTIES * (uncertainty or 0.0))


@dataclass
class Result:
    """All methods on a motion."""

    case: MotionCase
    source: str  # of the reference
    uncertainty: float | None  # difference of two codes' references, m or rad
    curves: list[Curve]
    estimates: list[Row] = field(default_factory=list)  # of global errors, largest tolerance first

    @property
    def integrators(self) -> list[Curve]:
        """Methods that a scene can name: not the paper's redundant form."""
        return [curve for curve in self.curves if not curve.method.is_paper_form]


def measure_case(case: MotionCase, effort: Effort) -> Result:
    """Measure the methods of an effort on a motion."""
    reference = reference_of(case, second=effort.second_reference)
    kernels = Method("rk4", 4).kernels(case.scene)
    uncertainty = None
    if reference.second is not None:
        uncertainty = errors_of(kernels, reference.second, reference.state)["error"]
    methods = methods_of(case, effort.methods)
    times = _step_times(methods, case, _passed(case, kernels), effort)
    curves = [
        _adaptive_curve(method, case, reference, times, effort)
        if method.is_adaptive
        else _stepped_curve(method, case, reference, times, effort)
        for method in methods
    ]
    return Result(case, reference.source, uncertainty, curves, [*_estimates(case, reference, effort)])


def errors_of(kernels: Kernels, x: FloatArray, reference: FloatArray) -> Row:
    """Distances of a state from another, by `ERRORS`; infinite for one that is not finite, or huge."""
    if not np.abs(x).max() < _FAR_OFF:  # NaN is neither
        return dict.fromkeys((*ERRORS, "error"), math.inf)
    tip, right_tip = (tuple(kernels.tip_pose(each).tolist()) for each in (x, reference))
    part = kernels.layout.state.base_velocity
    velocity = x[part] - reference[part]
    momentum = kernels.momentum(x) - kernels.momentum(reference)
    energy = float(kernels.energy(reference))
    mass = kernels.scene.base.mass + sum(link.mass for link in kernels.scene.links)
    position, attitude = float(poses.error_distance(tip, right_tip)), float(poses.error_angle(tip, right_tip))
    values = (
        position,
        attitude,
        float(np.linalg.norm(velocity[:3])),
        float(np.linalg.norm(velocity[3:])),
        float(np.linalg.norm(momentum[:3])) / mass,
        float(np.linalg.norm(momentum[3:])),
        abs(float(kernels.energy(x)) - energy) / energy,
    )
    return {"error": max(position, attitude), **dict(zip(ERRORS, values, strict=True))}


def _passed(case: MotionCase, kernels: Kernels) -> tuple[FloatArray, FloatArray]:
    """States along the motion for the batches that are timed, and the inputs there."""
    per_hold = math.ceil(BATCH / len(case.controls))
    per_hold *= max(math.ceil(case.hold / per_hold / 1e-3), 1)
    return Walk(Method("rk4", 4), kernels, case).passed(per_hold, BATCH)


def _adaptive_curve(
    method: Method, case: MotionCase, reference: Reference, times: _Times, effort: Effort
) -> Curve:
    """The longest steps, with smaller and smaller tolerances."""
    curve = Curve(method, times[method.name, effort.tolerances[-1], case.coarsest])
    for tolerance in effort.tolerances:
        kernels = method.kernels(case.scene, tolerance)
        walk = Walk(method, kernels, case)
        walk.run(case.coarsest)
        errors = errors_of(kernels, walk.state, reference.state)
        if errors["error"] < LOST:
            time_ns = times[method.name, tolerance, case.coarsest]
            curve.points.append(_point(method, case, case.coarsest, errors, time_ns, tolerance))
        else:
            curve.lost.append(tolerance)
    return curve


def _stepped_curve(
    method: Method, case: MotionCase, reference: Reference, times: _Times, effort: Effort
) -> Curve:
    """Shorter and shorter steps, until rounding dominates."""
    finest = times[method.name, None, max(_ladder(case, effort))]
    curve, kernels = Curve(method, finest), method.kernels(case.scene)
    walk = Walk(method, kernels, case)
    for per_hold in _ladder(case, effort):
        began = time.perf_counter()
        walk.run(per_hold)
        seconds = time.perf_counter() - began
        errors = errors_of(kernels, walk.state, reference.state)
        if not errors["error"] < LOST:
            curve.lost.append(case.hold / per_hold)
            continue
        time_ns = times.get((method.name, None, per_hold), finest)
        curve.points.append(_point(method, case, per_hold, errors, time_ns, None))
        if seconds > _LONG_RUN_SECONDS:
            curve.long_run_ratio = 1e9 * seconds / (curve.points[-1]["steps"] * time_ns[0])
        if is_rounding([point["error"] for point in curve.points]):
            break
    return curve


def is_rounding(errors: Sequence[float]) -> bool:
    """Whether the last two errors are both no smaller than the one before, and all three tiny."""
    return len(errors) > 2 and max(errors[-3:]) < _ROUNDING and min(errors[-2:]) >= errors[-3]


def _ladder(case: MotionCase, effort: Effort) -> Iterator[int]:
    """Steps per hold: twice as many each time."""
    per_hold = case.coarsest
    while per_hold * len(case.controls) <= effort.most_steps:
        yield per_hold
        per_hold *= 2


def _point(
    method: Method,
    case: MotionCase,
    per_hold: int,
    errors: Row,
    times: tuple[float, float],
    tolerance: float | None,
) -> Row:
    steps = per_hold * len(case.controls)
    single, batch = (steps / case.duration * each for each in times)
    labels = {"table": "points", "case": case.title, "scene": case.scene.name, "method": method.title}
    walked = {"step_s": case.hold / per_hold, "tolerance": tolerance, "steps": steps}
    return {**labels, **walked, **errors, "single_ns_per_s": single, "batch_us_per_s": 1e-3 * batch}


def _estimates(case: MotionCase, reference: Reference, effort: Effort) -> Iterator[Row]:
    """True and estimated global errors of `Kernels.integrate`, with smaller and smaller tolerances.

    None where the scene has a lag, a delay or a catch, which adaptive steps do not follow.
    """
    kernels = Method("rk4", 4).kernels(case.scene)
    if kernels.layout.chains or CATCH_NOW in kernels.parameters.names:
        return
    of_places = slice(kernels.layout.tangent.base_velocity.start)  # pose and angles
    for tolerance in effort.tolerances:
        keys = INTEGRATORS["dormand_prince"].within(tolerance)
        motion = kernels.integrate(
            case.start,
            case.controls,
            case.duration,
            rtol=keys["rtol"],
            atol=keys["atol"],
            max_steps=effort.most_steps,
            p=case.parameters,
        )
        errors = kernels.difference(reference.state, motion.x[-1]), motion.global_error()[-1]
        true, estimated = (float(np.abs(each[of_places]).max()) for each in errors)
        labels = {"table": "estimates", "case": case.title, "tolerance": tolerance}
        yield {**labels, "error": true, "estimate": estimated, "ratio": estimated / true}


def _step_times(
    methods: Sequence[Method], case: MotionCase, passed: tuple[FloatArray, FloatArray], effort: Effort
) -> _Times:
    """Times of steps, of all methods in turns; of a method that does not iterate, any step takes the same."""
    keys: list[tuple[str, float | None, int]] = []
    cases: list[Case] = []
    ladder = list(_ladder(case, effort))
    for method in methods:
        for tolerance in effort.tolerances if method.is_adaptive else (None,):
            kernels = method.kernels(case.scene, tolerance)
            timed = [case.coarsest] if method.is_adaptive else ladder if method.iterates else ladder[-1:]
            for per_hold in timed:
                keys.append((method.name, tolerance, per_hold))
                cases += _step_cases(method, kernels, case, passed, per_hold)
    timings = [timing["best_ns"] for timing in time_cases(cases, effort.step_timing)]
    return dict(zip(keys, zip(timings[::2], timings[1::2], strict=True), strict=True))


def _step_cases(
    method: Method, kernels: Kernels, case: MotionCase, passed: tuple[FloatArray, FloatArray], per_hold: int
) -> list[Case]:
    """Steps of a single motion, each after the one before; and a step of each of a batch.

    The batch has states from all along the motion, to which adaptive methods adapt their shares of a step.
    """
    states, inputs = passed
    x = method.own_state(kernels, states)
    line = np.zeros((min(SINGLE_ROWS, per_hold * len(case.controls)) + 1, x.shape[1]))
    line[0] = method.own_state(kernels, case.start[None])[0]
    cases = []
    for lanes, own, result in ((1, line, line[1:]), (None, x, np.zeros_like(x))):
        kernel, count = method.step_kernel(kernels, lanes), len(result)
        arrays = {"x": own, "u": np.ascontiguousarray(inputs[:count]), "h": np.array([case.hold / per_hold])}
        arrays["parameters"] = np.tile(kernels.parameters.nominal, (count, 1))
        call = KernelCall(kernel, {**arrays, kernel.outputs[0].name: result})
        subject = Subject(what=STEP, engine=OURS, way="rows", integrator=method.name, batch=count)
        cases.append(Case(subject, partial(call, count)))
    return cases


def own_choice(result: Result) -> Row | None:
    """The scene's own integrator at its own step; None if it was not measured, or lost the motion."""
    simulation = result.case.scene.simulation
    for curve in result.curves:
        for point in curve.points if curve.method.name == simulation.integrator else ():
            if curve.method.is_adaptive or abs(point["step_s"] - simulation.dt) < 1e-9:
                return point
    return None


def _own_is_lost(result: Result) -> bool:
    """Whether the scene's own integrator was measured at its own step, and lost the motion."""
    simulation = result.case.scene.simulation
    return own_choice(result) is None and any(
        curve.method.is_adaptive or abs(lost - simulation.dt) < 1e-9
        for curve in result.curves
        if curve.method.name == simulation.integrator
        for lost in curve.lost
    )


def default_at_step(result: Result) -> Row | None:
    """The integrator for a scene with this time step.

    The cheapest fixed-step integrator in a batch that reaches `DEFAULT_ACCURACY` with steps no longer than
    the scene's and no shorter than half of it; the most accurate one if none does.
    """
    step = result.case.scene.simulation.dt
    near = [
        point
        for curve in result.integrators
        for point in curve.points
        if not curve.method.is_adaptive and 0.5 * step < point["step_s"] <= 1.0001 * step
    ]
    good = [point for point in near if point["error"] <= DEFAULT_ACCURACY]
    if good:
        return min(good, key=lambda point: float(point["batch_us_per_s"]))
    return min(near, key=lambda point: float(point["error"]), default=None)


def maneuver_rows(name: str, effort: Effort) -> Iterator[Row]:
    """Follow the expert's maneuver in a scene."""
    yield from rows_of(measure_case(scene_case(name), effort))


def rows_of(result: Result, *, all_methods: bool = True) -> Iterator[Row]:
    """Points, methods, the cheapest choices, the default integrator, and the claims."""
    case, dt = result.case, result.case.scene.simulation.dt
    yield {
        "table": "references",
        "case": case.title,
        "scene": case.scene.name,
        "duration_s": case.duration,
        "reference": result.source,
        "second_reference_off_by": result.uncertainty,
    }
    yield from result.estimates
    for curve in result.curves:
        yield from curve.points
        yield _method_row(result, curve)
    points = [point for curve in result.curves for point in curve.points]
    for accuracy in ACCURACIES:
        row: Row = {"table": "cheapest", "case": case.title, "accuracy": accuracy}
        for key, name in (("batch_us_per_s", "batch"), ("single_ns_per_s", "single")):
            point = cheapest(points, accuracy, key)
            row |= {name: None, f"{name}_us": None}
            if point is not None:
                row[name] = f"{point['method']}, {step_text(point)}"
                row[f"{name}_us"] = point[key] * (1e-3 if name == "single" else 1.0)
        yield row
    best, own = default_at_step(result), own_choice(result)
    yield {
        "table": "defaults",
        "case": case.title,
        "dt_s": dt,
        "own": case.scene.simulation.integrator,
        "own_error": own and own["error"],
        "best": best and best["method"],
        "best_step_s": best and best["step_s"],
        "best_error": best and best["error"],
    }
    if not case.has_other_code:  # the expert's maneuver in a shipped scene
        second = "a second method ends as near to the reference"
        yield claim(
            "references", case.name, result.source, result.uncertainty, _REFERENCE, unit="m, rad", note=second
        )
        if own is not None or _own_is_lost(result):
            method, error = case.scene.simulation.integrator, math.inf if own is None else own["error"]
            note = "its own integrator must follow the expert's maneuver"
            yield claim("scenes", case.name, method, error, DEFAULT_ACCURACY, unit="m, rad", note=note)
        return
    if ratios := list(_shown_ratios(result)):
        worst = max(abs(math.log2(ratio)) for ratio in ratios)
        yield claim(
            "estimates",
            case.name,
            "dormand_prince",
            2.0**worst,
            LARGEST_RATIO,
            note="estimate over true error",
        )
    errors = [point["error"] for curve in result.integrators for point in curve.points]
    if all_methods:
        least = min(errors, default=math.inf)
        yield claim("motions", case.name, "best integrator", least, case.limit, unit="m, rad")
    for curve in result.curves:
        order = curve.observed_order(result.uncertainty)
        if case.is_smooth and (order is not None or curve.stagnates(result.uncertainty)):
            shown = "no order" if order is None else f"order {order:.2f}"
            note = f"shows {shown}, claims {curve.method.order}"
            missing = None if order is None else max(curve.method.order - order, 0.0)
            yield claim("orders", case.name, curve.method.title, missing, ORDER_TOLERANCE, note=note)


def _shown_ratios(result: Result) -> Iterator[float]:
    """Ratios of estimated to true errors where these are neither rounding errors nor the reference's."""
    floor = max(_ESTIMATED, _UNCERTAINTIES * (result.uncertainty or 0.0))
    return (row["ratio"] for row in result.estimates if floor < row["error"] < DEFAULT_ACCURACY)


def _method_row(result: Result, curve: Curve) -> Row:
    order = curve.observed_order(result.uncertainty)
    row: Row = {
        "table": "methods",
        "case": result.case.title,
        "duration_s": result.case.duration,
        "method": curve.method.title,
        "order": curve.method.order,
        "observed_order": order,
        "single_ns_per_step": curve.step_ns[0],
        "batch_ns_per_step": curve.step_ns[1],
        "long_run_over_steps": curve.long_run_ratio,
        "lost_at": ", ".join(f"{step:.3g}" for step in curve.lost),
    }
    if not curve.points:
        return {**row, "longest_step": "lost"}
    first, best = curve.points[0], min(curve.points, key=lambda point: float(point["error"]))
    return {
        **row,
        "longest_step": step_text(first),
        "error_there": first["error"],
        "least_error": best["error"],
        "least_at": step_text(best),
        "angular_momentum": best["angular_momentum_error_kg_m2_s"],
        "energy": best["relative_energy_error"],
    }


def step_text(point: Mapping[str, Any]) -> str:
    """The step or the tolerance of a point."""
    return f"{point['step_s']:.3g}" if point["tolerance"] is None else f"tol. {point['tolerance']:.0e}"
