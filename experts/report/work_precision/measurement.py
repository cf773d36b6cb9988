"""Error and time of methods on a motion, for steps from coarse to where rounding dominates."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dq_space_arm_env import Kernels
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.kernels.bound import KernelCall
from experts.problem import FloatArray
from experts.report.throughput.timing import OURS, STEP, Case, Subject, time_cases
from experts.report.work_precision.cases import MotionCase
from experts.report.work_precision.effort import Effort
from experts.report.work_precision.methods import Method, Walk, methods_of
from experts.report.work_precision.references import Reference, reference_of

BATCH = 1024
"""Motions side by side on one core."""
SINGLE_ROWS = 256
"""Steps in a row of a single motion whose time is taken."""
LOST = 1.0
"""Beyond this error, m or rad, a motion has nothing to do with the right one."""
_FAR_OFF = 1e6  # entries of a state that has got lost
_ROUNDING = 1e-9
"""Below this error, one that no longer falls with the step is due to rounding."""
_LONG_RUN_SECONDS = 0.05

_Times = dict[tuple[str, float | None], tuple[float, float]]
"""Time of a step of a single motion and of each of a batch, ns, by method and tolerance."""


@dataclass(frozen=True)
class Errors:
    """How far a state is from the reference, absolute.

    Attributes:
        position: Of the tip, m.
        attitude: Of the tip, rad.
        angular_velocity: Of the base, rad/s.
        linear_velocity: Of the base, m/s.
        momentum: Linear momentum per mass of base and links, m/s.
        angular_momentum: About the center of mass, kg m^2/s.
        energy: Relative.
    """

    position: float
    attitude: float
    angular_velocity: float
    linear_velocity: float
    momentum: float
    angular_momentum: float
    energy: float

    @property
    def pose(self) -> float:
        """The larger one of those of the tip, m or rad."""
        return max(self.position, self.attitude)


@dataclass(frozen=True)
class Point:
    """A motion with one step.

    Attributes:
        step: Its length, s.
        tolerance: Relative tolerance of an adaptive method; None for others.
        steps: Number of steps.
        errors: At the end.
        single_ns: Time of a single motion, ns per simulated second.
        batch_ns: Time of one of 1024 motions side by side on one core, ns per simulated second.
    """

    step: float
    tolerance: float | None
    steps: int
    errors: Errors
    single_ns: float
    batch_ns: float


@dataclass(frozen=True)
class Curve:
    """A method on a motion.

    Attributes:
        method: Name of the method.
        title: What tables call it.
        order: Order that it claims.
        is_adaptive: Whether tolerances, not steps, differ from point to point.
        points: Those that follow the motion, coarsest first.
        lost: Steps [s] (or tolerances) with which the motion is lost.
        single_step_ns: Time of a step of a single motion, ns; of the finest tolerance.
        batch_step_ns: The same for each of 1024 side by side.
        long_run_ratio: Wall-clock time of a whole long run over what follows from the time of a step; None
            if no run was long enough.
    """

    method: str
    title: str
    order: int
    is_adaptive: bool
    points: tuple[Point, ...]
    lost: tuple[float, ...]
    single_step_ns: float
    batch_step_ns: float
    long_run_ratio: float | None


@dataclass(frozen=True)
class CaseResult:
    """All methods on a motion.

    Attributes:
        case: Name of the motion.
        title: What it is.
        scene: Name of its scene.
        duration: How long it is, s.
        dt: Time step of the scene, s.
        integrator: The scene's own.
        limit: Error that some method must stay below.
        is_smooth: Whether methods must show their order.
        reference: Who says where it ends.
        uncertainty: Difference of the tip's pose between two codes' references, m or rad; None if there is
            one.
        curves: The methods.
    """

    case: str
    title: str
    scene: str
    duration: float
    dt: float
    integrator: str
    limit: float
    is_smooth: bool
    reference: str
    uncertainty: float | None
    curves: tuple[Curve, ...]


def measure_case(case: MotionCase, effort: Effort, names: Sequence[str] | None = None) -> CaseResult:
    """Measure methods on a motion.

    Args:
        case: The motion.
        effort: How much to measure.
        names: Names of the methods; all if None.

    Returns:
        Errors and times.
    """
    reference = reference_of(case, second=effort.second_reference)
    kernels = Method("rk4", 4).kernels(case.scene)
    passed = _passed(case, kernels)
    uncertainty = None
    if reference.second is not None:
        uncertainty = errors_of(kernels, reference.second, reference.state).pose
    methods = methods_of(case, names)
    times = _step_times(methods, case, passed, effort)
    return CaseResult(
        case=case.name,
        title=case.title,
        scene=case.scene.name,
        duration=case.duration,
        dt=case.scene.simulation.dt,
        integrator=case.scene.simulation.integrator,
        limit=case.limit,
        is_smooth=case.is_smooth,
        reference=reference.source,
        uncertainty=uncertainty,
        curves=tuple(
            _adaptive_curve(method, case, reference, times, effort)
            if method.is_adaptive
            else _stepped_curve(method, case, reference, times[method.name, None], effort)
            for method in methods
        ),
    )


def errors_of(kernels: Kernels, x: FloatArray, reference: FloatArray) -> Errors:
    """How far a state is from another.

    Args:
        kernels: Functions of the scene.
        x: State, shape (n_x,).
        reference: The right one, shape (n_x,).

    Returns:
        The errors; infinite for a state that is not finite, or huge.
    """
    if not np.abs(x).max() < _FAR_OFF:  # NaN is neither
        return Errors(*(math.inf,) * 7)
    tip, right_tip = (tuple(kernels.tip_pose(each).tolist()) for each in (x, reference))
    part = kernels.layout.state.base_velocity
    velocity = x[part] - reference[part]
    momentum = kernels.momentum(x) - kernels.momentum(reference)
    energy = float(kernels.energy(reference))
    mass = kernels.scene.base.mass + sum(link.mass for link in kernels.scene.links)
    return Errors(
        position=float(poses.error_distance(tip, right_tip)),
        attitude=float(poses.error_angle(tip, right_tip)),
        angular_velocity=float(np.linalg.norm(velocity[:3])),
        linear_velocity=float(np.linalg.norm(velocity[3:])),
        momentum=float(np.linalg.norm(momentum[:3])) / mass,
        angular_momentum=float(np.linalg.norm(momentum[3:])),
        energy=abs(float(kernels.energy(x)) - energy) / energy,
    )


def _passed(case: MotionCase, kernels: Kernels) -> tuple[FloatArray, FloatArray]:
    """States along the motion for the batches that are timed, and the inputs there."""
    per_hold = math.ceil(BATCH / len(case.controls))
    per_hold *= max(math.ceil(case.hold / per_hold / 1e-3), 1)
    return Walk(Method("rk4", 4), kernels, case).passed(per_hold, BATCH)


def _adaptive_curve(
    method: Method, case: MotionCase, reference: Reference, times: _Times, effort: Effort
) -> Curve:
    """Steps as long as at most, tolerances smaller and smaller."""
    points: list[Point] = []
    lost: list[float] = []
    for tolerance in effort.tolerances:
        kernels = method.kernels(case.scene, tolerance)
        walk = Walk(method, kernels, case)
        walk.run(case.coarsest)
        errors = errors_of(kernels, walk.state, reference.state)
        if errors.pose < LOST:
            points.append(_point(case, case.coarsest, errors, times[method.name, tolerance], tolerance))
        else:
            lost.append(tolerance)
    return _curve(method, points, lost, times[method.name, effort.tolerances[-1]], None)


def _stepped_curve(
    method: Method, case: MotionCase, reference: Reference, times: tuple[float, float], effort: Effort
) -> Curve:
    """Steps shorter and shorter."""
    points: list[Point] = []
    lost: list[float] = []
    kernels = method.kernels(case.scene)
    walk, ratio = Walk(method, kernels, case), None
    for per_hold in _ladder(case, effort):
        began = time.perf_counter()
        walk.run(per_hold)
        seconds = time.perf_counter() - began
        errors = errors_of(kernels, walk.state, reference.state)
        if not errors.pose < LOST:
            lost.append(case.hold / per_hold)
            continue
        points.append(_point(case, per_hold, errors, times, None))
        if seconds > _LONG_RUN_SECONDS:
            ratio = 1e9 * seconds / (points[-1].steps * times[0])
        if is_rounding([point.errors.pose for point in points]):
            break
    return _curve(method, points, lost, times, ratio)


def _curve(
    method: Method,
    points: Sequence[Point],
    lost: Sequence[float],
    times: tuple[float, float],
    ratio: float | None,
) -> Curve:
    names = (method.name, method.title, method.order, method.is_adaptive)
    return Curve(*names, tuple(points), tuple(lost), *times, ratio)


def is_rounding(errors: Sequence[float]) -> bool:
    """Whether smaller steps would not help.

    Args:
        errors: For smaller and smaller steps.

    Returns:
        Whether the last two are both no smaller than one before, and all three tiny.
    """
    return len(errors) > 2 and max(errors[-3:]) < _ROUNDING and min(errors[-2:]) >= errors[-3]


def _ladder(case: MotionCase, effort: Effort) -> Iterator[int]:
    """Steps per hold: twice as many each time."""
    per_hold = case.coarsest
    while per_hold * len(case.controls) <= effort.most_steps:
        yield per_hold
        per_hold *= 2


def _point(
    case: MotionCase, per_hold: int, errors: Errors, times: tuple[float, float], tolerance: float | None
) -> Point:
    steps = per_hold * len(case.controls)
    per_second = steps / case.duration
    single, batch = (per_second * each for each in times)
    return Point(case.hold / per_hold, tolerance, steps, errors, single, batch)


def _step_times(
    methods: Sequence[Method], case: MotionCase, passed: tuple[FloatArray, FloatArray], effort: Effort
) -> _Times:
    """Times of steps, of all methods in turns."""
    keys: list[tuple[str, float | None]] = []
    cases: list[Case] = []
    for method in methods:
        for tolerance in effort.tolerances if method.is_adaptive else (None,):
            keys.append((method.name, tolerance))
            per_hold = case.coarsest if method.is_adaptive else max(_ladder(case, effort))
            kernels = method.kernels(case.scene, tolerance)
            cases += _step_cases(method, kernels, case, passed, per_hold)
    timings = [timing.best_ns for timing in time_cases(cases, effort.timing)]
    return dict(zip(keys, zip(timings[::2], timings[1::2], strict=True), strict=True))


def _step_cases(
    method: Method,
    kernels: Kernels,
    case: MotionCase,
    passed: tuple[FloatArray, FloatArray],
    per_hold: int,
) -> list[Case]:
    """Steps of a single motion, each after the one before; and a step of each of a batch.

    The batch has states from all along the motion: where a method adapts itself, it is to what comes.
    """
    states, inputs = passed
    x = method.own_state(kernels, states)
    line = np.zeros((min(SINGLE_ROWS, per_hold * len(case.controls)) + 1, x.shape[1]))
    line[0] = method.own_state(kernels, case.start[None])[0]
    cases = []
    for lanes, own, result in ((1, line, line[1:]), (None, x, np.zeros_like(x))):
        kernel, count = method.step_kernel(kernels, lanes), len(result)
        step = np.array([case.hold / per_hold])
        arrays = {"x": own, "u": np.ascontiguousarray(inputs[:count]), "h": step}
        call = KernelCall(kernel, {**arrays, kernel.outputs[0].name: result})
        subject = Subject(what=STEP, engine=OURS, way="rows", integrator=method.name, batch=count)
        cases.append(Case(subject, partial(call, count)))
    return cases
