"""A run in numbers: as tables on the terminal, and as JSON values for `summary.json`."""

import math
from collections.abc import Iterable
from typing import Any

from rich.console import Console

from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.tables import plain_table
from experts.maneuver import ActuatorHistory
from experts.report.maneuver_run import ManeuverRun
from experts.report.paper_numbers import Value, compare_with_paper, numbers, own_choices

ACTUATOR_TITLES = {
    "base_force": "base force",
    "base_torque": "base torque",
    "joint_torque": "joint torques",
    "wrist_rate": "Euler rates",
    "wheel_torque": "wheel torques",
    "thruster_force": "thruster forces",
}


def print_tables(console: Console, run: ManeuverRun) -> None:
    """Print the paper's numbers, our own choices, the result, and the inputs."""
    name = run.scene.name
    console.print(
        plain_table("The paper's numbers (section V)", ("", "paper", f"scene {name}"), _paper_rows(run)),
        plain_table(
            "Our own choices: the paper does not print them",
            ("", f"scene {name}"),
            own_choices(run.scene).items(),
        ),
        plain_table("Result", ("", "", ""), _result_rows(run)),
        plain_table("Inputs", ("", "largest", "limit", "at a limit", "cost"), _input_rows(run)),
    )


def _paper_rows(run: ManeuverRun) -> Iterable[tuple[str, str, str]]:
    for row in compare_with_paper(run.scene):
        unit = "" if row.unit in ("", "1") else f" {row.unit}"
        yield row.quantity, _text(row.paper) + unit, "the same" if row.agrees else _text(row.scene) + unit


def _text(value: Value) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g}" if isinstance(value, float) else numbers(value)


def _result_rows(run: ManeuverRun) -> Iterable[tuple[str, str, str]]:
    solution, maneuver, replay, success = run.solution, run.maneuver, run.replay, run.scene.success
    terms = run.cost_terms
    yield "cost J", f"{solution.cost:.6f}", f"doing nothing costs {run.zero_control_cost:.6g}"
    yield "  tip pose", f"{terms['cost_pose']:.6f}", f"at T {terms['terminal_cost_pose']:.2e}"
    velocity = terms["terminal_cost_base_velocity"]
    yield "  base velocity", f"{terms['cost_base_velocity']:.6f}", f"at T {velocity:.2e}"
    if any(name.endswith("tip_twist") for name in terms):
        running, final = (terms.get(f"{stage}cost_tip_twist", 0.0) for stage in ("", "terminal_"))
        yield "  tip twist", f"{running:.6f}", f"at T {final:.2e}"
    yield "  inputs", f"{terms['cost_control']:.6f}", ""
    verdict = "converged" if solution.converged else f"NOT converged ({solution.stop_reason.value})"
    yield "solver", verdict, solution.message
    seconds = f"{run.solve_seconds:.2g} s"
    yield (
        "iterations",
        str(solution.iterations),
        f"in {seconds}, after {run.preparation_seconds:.1f} s of preparation",
    )
    first, last = (math.degrees(maneuver.angle[k]) for k in (0, -1))
    errors = (
        ("attitude error", first, last, success.attitude_error_deg, "°"),
        ("position error", maneuver.distance[0], maneuver.distance[-1], success.position_error, " m"),
    )
    for name, start, end, most, unit in errors:
        verdict = "within" if end <= most else "NOT within"
        yield name, f"{start:.3g}{unit} → {end:.3g}{unit}", f"{verdict} the tolerance of {most:g}{unit}"
    if all(end <= most for _, _, end, most, _ in errors) and not replay.is_success[0]:
        yield "success", "NO", "a velocity is not within its tolerance, or a catch has failed"
    if run.finer_errors is None:
        yield "the same plan, RK4, Δt/4", "-", "delays of actuators are whole steps"
    else:
        angle, distance = run.finer_errors
        yield "the same plan, RK4, Δt/4", f"{angle:.3g}°, {distance:.3g} m", "error of the integrator"
    agreement = "= -J" if run.replay_agrees else "DIFFERS from -J"
    yield (
        "return in DQSpaceArm-v0",
        f"{-run.replay_cost:.6f}",
        f"{agreement}, relative difference {run.replay_difference:.1e}",
    )


def _input_rows(run: ManeuverRun) -> Iterable[tuple[str, str, str, str, str]]:
    for actuator in run.maneuver.actuators:
        yield (
            f"{ACTUATOR_TITLES[actuator.name]} [{actuator.unit}]",
            ", ".join(f"{value:.3g}" for value in actuator.largest),
            ", ".join(f"{limit:g}" for limit in dict.fromkeys(actuator.limits.tolist())),
            f"{actuator.clamped_share:.1%}",
            f"{actuator.effort:.4f}",
        )


def summarize(run: ManeuverRun) -> dict[str, Any]:
    """Collect the numbers of a run: JSON values, units in the keys, None where a number is not finite."""
    solution, replay, maneuver = run.solution, run.replay, run.maneuver
    success = run.scene.success
    attitude, position = run.finer_errors or (None, None)
    summary = {
        "scene": run.scene.name,
        "result": {
            "cost": solution.cost,
            "cost_terms": run.cost_terms,
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
            "is_success": bool(replay.is_success[0]),
        },
        "replay": {
            "return": -run.replay_cost,
            "relative_difference": run.replay_difference,
            "agrees": run.replay_agrees,
            "diverged": bool(replay.diverged[0]),
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


def _actuator(actuator: ActuatorHistory) -> dict[str, Any]:
    return {
        "unit": actuator.unit,
        "inputs": list(actuator.inputs),
        "largest": actuator.largest.tolist(),
        "limits": actuator.limits.tolist(),
        "clamped_share": actuator.clamped_share,
        "cost": actuator.effort,
    }
