"""What follows from errors and times: observed orders, the cheapest choice for an accuracy, defaults."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from experts.report.work_precision.cases import DEFAULT_ACCURACY
from experts.report.work_precision.measurement import CaseResult, Curve, Point

ACCURACIES = (1e-3, 1e-6, 1e-9)
"""Errors of the tip to be reached, m and rad."""

_ASYMPTOTIC = 1e-3
_ROUNDING = 1e-11
_FLOORS, _UNCERTAINTIES = 6.0, 30.0
"""How many times the error at which a curve ends, and that of the reference, errors are that show a slope."""
_SLOPES = 3


@dataclass(frozen=True)
class Choice:
    """A method and its step.

    Attributes:
        method: Name of the method.
        title: What tables call it.
        point: The step, its errors and times.
    """

    method: str
    title: str
    point: Point


def observed_order(steps: Sequence[float], errors: Sequence[float], uncertainty: float = 0.0) -> float | None:
    """Order of convergence that errors show.

    Args:
        steps: Descending lengths, s.
        errors: Of each, m or rad.
        uncertainty: Of the reference, m or rad.

    Returns:
        Slope of log error over log step among the finest three pairs between 1e-3 and what rounding and the
        uncertainty blur: the median, or the finest one if that is larger, for a leading term that changes its
        sign spoils one or two; None if there is none.
    """
    floor = min(errors) if errors[-1] > 0.5 * errors[-2] else 0.0  # it falls no more
    smallest = max(_ROUNDING, _UNCERTAINTIES * uncertainty, _FLOORS * floor)
    slopes = [
        float(np.log(errors[i] / errors[i + 1]) / np.log(steps[i] / steps[i + 1]))
        for i in range(len(steps) - 1)
        if errors[i] < _ASYMPTOTIC and errors[i + 1] > smallest
    ]
    return max(float(np.median(slopes[-_SLOPES:])), slopes[-1]) if slopes else None


def order_of(curve: Curve, uncertainty: float | None) -> float | None:
    """Order of convergence that a method shows on a motion.

    Args:
        curve: The method.
        uncertainty: Of the reference, m or rad; None if not known.

    Returns:
        The order; None for an adaptive method, or if no steps are in the range where it can be seen.
    """
    if curve.is_adaptive or len(curve.points) < 2:
        return None
    steps, errors = zip(*((point.step, point.errors.pose) for point in curve.points), strict=True)
    return observed_order(steps, errors, uncertainty or 0.0)


def cheapest(curves: Iterable[Curve], accuracy: float, *, batch: bool) -> Choice | None:
    """The fastest method and step that reach an accuracy.

    Args:
        curves: The methods.
        accuracy: Largest error of the tip, m and rad.
        batch: Whether many motions run side by side.

    Returns:
        The choice; None if nothing measured is that accurate.
    """
    found = [
        Choice(curve.method, curve.title, point)
        for curve in curves
        for point in curve.points
        if point.errors.pose <= accuracy
    ]
    key = "batch_ns" if batch else "single_ns"
    return min(found, key=lambda choice: float(getattr(choice.point, key)), default=None)


def integrators_of(result: CaseResult) -> list[Curve]:
    """Those methods that a scene can name: not the paper's redundant form."""
    return [curve for curve in result.curves if not curve.method.startswith("paper")]


def own_choice(result: CaseResult) -> Choice | None:
    """A scene's own integrator, at its own step.

    Args:
        result: The scene's maneuver.

    Returns:
        Its error and times; None if it was not measured, or got lost.
    """
    for curve in result.curves:
        if curve.method == result.integrator:
            for point in curve.points:
                if curve.is_adaptive or abs(point.step - result.dt) < 1e-9:
                    return Choice(curve.method, curve.title, point)
    return None


def default_at_step(result: CaseResult, step: float) -> Choice | None:
    """The integrator that a scene with a given time step should have.

    Args:
        result: A motion.
        step: The scene's time step, s.

    Returns:
        The cheapest fixed-step integrator in a batch that reaches `DEFAULT_ACCURACY` with steps no longer
        than this and no shorter than half of it; the most accurate one if none does; None if none was
        measured.
    """
    near = [
        Choice(curve.method, curve.title, point)
        for curve in integrators_of(result)
        for point in curve.points
        if not curve.is_adaptive and 0.5 * step < point.step <= 1.0001 * step
    ]
    good = [choice for choice in near if choice.point.errors.pose <= DEFAULT_ACCURACY]
    if good:
        return min(good, key=lambda choice: choice.point.batch_ns)
    return min(near, key=lambda choice: choice.point.errors.pose, default=None)
