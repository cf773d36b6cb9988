"""A run as tables on the terminal: the paper's numbers, our own choices, the result, and the effort."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experts.report.comparison import Value, compare_with_paper, numbers, own_choices
from experts.report.run import ManeuverRun

ACTUATOR_TITLES = {
    "base_force": "base force",
    "base_torque": "base torque",
    "joint_torque": "joint torques",
    "wrist_rate": "Euler rates",
}


@dataclass(frozen=True)
class TextTable:
    """A table of plain text, for a terminal or a page.

    Attributes:
        title: What it shows.
        headings: A heading for each column.
        rows: The cells.
        right: First of the columns that are flush right; None for none.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: int | None = None

    def for_terminal(self) -> Table:
        """The table as `rich` prints it."""
        return plain_table(self.title, self.headings, self.rows, self.right)


def print_tables(console: Console, run: ManeuverRun) -> None:
    """Print a run.

    Args:
        console: Where to print.
        run: The run.
    """
    name = run.scene.name
    console.print(
        plain_table("The paper's numbers (section V)", ("", "paper", f"scene {name}"), _paper_rows(run)),
        plain_table(
            "Our own choice: the paper prints none of it",
            ("", f"scene {name}"),
            own_choices(run.scene).items(),
        ),
        plain_table("Result", ("", "", ""), _result_rows(run)),
        plain_table("Inputs", ("", "largest", "limit", "at a limit", "cost"), _input_rows(run)),
    )


def plain_table(
    title: str, headings: Iterable[str], rows: Iterable[Iterable[str]], right: int | None = None
) -> Table:
    """Make a table whose cells are plain text: brackets in the name of a link are no markup.

    Args:
        title: Title above the table.
        headings: A heading for each column; none is shown if all are empty.
        rows: The cells.
        right: First of the columns that are flush right; None for none.

    Returns:
        The table.
    """
    headings = list(headings)
    table = Table(
        title=Text(title),
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        show_header=any(headings),
    )
    for index, heading in enumerate(headings):
        flush_right = right is not None and index >= right
        table.add_column(Text(heading), overflow="fold", justify="right" if flush_right else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


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
    terms = replay.cost_terms
    start, end = math.degrees(maneuver.angle[0]), math.degrees(maneuver.angle[-1])
    yield "cost J", f"{solution.cost:.6f}", f"doing nothing costs {run.zero_control_cost:.6g}"
    yield "  tip pose", f"{terms['cost_pose']:.6f}", f"at T {terms['terminal_cost_pose']:.2e}"
    velocity = terms["terminal_cost_base_velocity"]
    yield "  base velocity", f"{terms['cost_base_velocity']:.6f}", f"at T {velocity:.2e}"
    yield "  inputs", f"{terms['cost_control']:.6f}", ""
    verdict = "converged" if solution.converged else f"NOT converged ({solution.stop_reason.value})"
    yield "solver", verdict, solution.message
    seconds = f"{run.solve_seconds:.2g} s"
    yield (
        "iterations",
        str(solution.iterations),
        f"in {seconds}, after {run.preparation_seconds:.1f} s of preparation",
    )
    tolerance = f"tolerance {success.attitude_error_deg:g}°, {success.position_error:g} m"
    yield "attitude error", f"{start:.3g}° → {end:.3g}°", tolerance
    reached = "within the tolerance" if replay.is_success else "NOT within the tolerance"
    yield "position error", f"{maneuver.distance[0]:.3g} m → {maneuver.distance[-1]:.3g} m", reached
    angle, distance = run.finer_errors
    yield "the same plan, RK4, Δt/4", f"{angle:.3g}°, {distance:.3g} m", "error of the integrator"
    agreement = "= -J" if run.replay_agrees else "DIFFERS from -J"
    yield (
        "return in DQSpaceArm-v0",
        f"{replay.total_reward:.6f}",
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
