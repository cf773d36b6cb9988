"""The work-precision report in JSON's types, units in the keys."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from experts.report.summary import json_value
from experts.report.work_precision.benchmark import WorkPrecision, shortcomings
from experts.report.work_precision.choices import ACCURACIES, Choice, cheapest, default_at_step, order_of
from experts.report.work_precision.measurement import CaseResult, Curve, Point


def report_record(found: WorkPrecision) -> dict[str, Any]:
    """What is measured, and what follows from it.

    Args:
        found: It.

    Returns:
        JSON values.
    """
    record = {
        "effort": asdict(found.effort),
        "cases": [_case(case) for case in found.cases],
        "scenes": [_case(scene) for scene in found.scenes],
        "formulations": None if found.formulations is None else asdict(found.formulations),
        "shortcomings": shortcomings(found),
    }
    return {key: json_value(value) for key, value in record.items()}


def _case(case: CaseResult) -> dict[str, Any]:
    return {
        "case": case.case,
        "title": case.title,
        "scene": case.scene,
        "duration_s": case.duration,
        "scene_step_s": case.dt,
        "scene_integrator": case.integrator,
        "error_limit": case.limit,
        "reference": case.reference,
        "reference_uncertainty": case.uncertainty,
        "methods": [_curve(curve, case.uncertainty) for curve in case.curves],
        "cheapest": [
            {
                "error": accuracy,
                "batch": _choice(cheapest(case.curves, accuracy, batch=True)),
                "single": _choice(cheapest(case.curves, accuracy, batch=False)),
            }
            for accuracy in ACCURACIES
        ],
        "default": _choice(default_at_step(case, case.dt)),
    }


def _curve(curve: Curve, uncertainty: float | None) -> dict[str, Any]:
    return {
        "method": curve.method,
        "order": curve.order,
        "observed_order": order_of(curve, uncertainty),
        "adaptive": curve.is_adaptive,
        "single_ns_per_step": curve.single_step_ns,
        "batch_ns_per_step": curve.batch_step_ns,
        "long_run_over_steps": curve.long_run_ratio,
        "lost_at": list(curve.lost),
        "points": [_point(point) for point in curve.points],
    }


def _point(point: Point) -> dict[str, Any]:
    errors = point.errors
    return {
        "step_s": point.step,
        "tolerance": point.tolerance,
        "steps": point.steps,
        "tip_position_error_m": errors.position,
        "tip_attitude_error_rad": errors.attitude,
        "base_angular_velocity_error_rad_s": errors.angular_velocity,
        "base_linear_velocity_error_m_s": errors.linear_velocity,
        "center_velocity_error_m_s": errors.momentum,
        "angular_momentum_error_kg_m2_s": errors.angular_momentum,
        "relative_energy_error": errors.energy,
        "single_ns_per_s": point.single_ns,
        "batch_ns_per_s": point.batch_ns,
    }


def _choice(choice: Choice | None) -> dict[str, Any] | None:
    return None if choice is None else {"method": choice.method, **_point(choice.point)}
