"""A run in numbers, for `summary.json`."""

import json
import math
from typing import Any

from experts.report.comparison import compare_with_paper, own_choices
from experts.report.maneuver import ActuatorHistory
from experts.report.provenance import provenance
from experts.report.run import ManeuverRun


def summarize(run: ManeuverRun) -> dict[str, Any]:
    """Collect what there is to know about a run.

    Args:
        run: The run.

    Returns:
        JSON values, units in the keys; `None` where a number is not finite.
    """
    solution, replay, maneuver = run.solution, run.replay, run.maneuver
    success = run.scene.success
    attitude, position = run.finer_errors
    summary = {
        "scene": run.scene.name,
        "result": {
            "cost": solution.cost,
            "cost_terms": replay.cost_terms,
            "zero_control_cost": run.zero_control_cost,
            "converged": solution.converged,
            "stop_reason": solution.stop_reason.value,
            "message": solution.message,
            "optimality": solution.optimality,
            "iterations": solution.iterations,
            "solve_seconds": run.solve_seconds,
            "preparation_seconds": run.preparation_seconds,
            "initial_attitude_error_deg": math.degrees(maneuver.angle[0]),
            "initial_position_error_m": float(maneuver.distance[0]),
            "final_attitude_error_deg": math.degrees(maneuver.angle[-1]),
            "final_position_error_m": float(maneuver.distance[-1]),
            "tolerated_attitude_error_deg": success.attitude_error_deg,
            "tolerated_position_error_m": success.position_error,
            "is_success": replay.is_success,
        },
        "replay": {
            "return": replay.total_reward,
            "relative_difference": run.replay_difference,
            "agrees": run.replay_agrees,
            "diverged": replay.diverged,
        },
        "finer_integration": {"final_attitude_error_deg": attitude, "final_position_error_m": position},
        "actuators": {actuator.name: _actuator(actuator) for actuator in maneuver.actuators},
        "comparison_with_paper": [
            {**row._asdict(), "agrees": row.agrees} for row in compare_with_paper(run.scene)
        ],
        "own_choices": own_choices(run.scene),
        "resolved_scene": run.scene.model_dump(mode="json"),
        **provenance(),
    }
    return {key: json_value(value) for key, value in summary.items()}


def to_json(summary: dict[str, Any]) -> str:
    """Write a summary.

    Args:
        summary: From `summarize`.

    Returns:
        JSON text.
    """
    return json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def json_value(value: Any) -> Any:
    """Replace what JSON does not have.

    Args:
        value: Numbers, texts, lists and dictionaries, nested.

    Returns:
        The same with None for infinity and NaN.
    """
    if isinstance(value, dict):
        return {key: json_value(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _actuator(actuator: ActuatorHistory) -> dict[str, Any]:
    return {
        "unit": actuator.unit,
        "inputs": list(actuator.inputs),
        "largest": actuator.largest.tolist(),
        "limits": actuator.limits.tolist(),
        "clamped_share": actuator.clamped_share,
        "cost": actuator.effort,
    }
