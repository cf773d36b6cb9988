"""What scenes and their parts cost, and how long processes take to start, as tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median

from rich.console import Console

from experts.report.peak import Peak
from experts.report.tables import plain_table
from experts.report.throughput.formats import integrator_title, per_second, three_digits
from experts.report.throughput.records import share_of_peak
from experts.report.throughput.scene_costs import BATCH, SceneCost


def print_scene_costs(console: Console, costs: Sequence[SceneCost], peaks: Mapping[str, Peak]) -> None:
    """Print what scenes cost.

    Args:
        console: Where to print.
        costs: It.
        peaks: Peak of a core for each precision.
    """
    headings = ["scene", "", "states,\ninputs"]
    for title in ("dynamics", "step", "env. step"):
        headings += [f"{title}\nops", "ns"]
    headings += ["of\npeak", "make_vec\nper s"]
    rows = (
        (
            cost.title,
            integrator_title(cost.integrator),
            f"{cost.states}, {cost.inputs}",
            *(text for pair in _sizes(cost) for text in pair),
            f"{share_of_peak(cost.environment_step, peaks):.0%}",
            "" if cost.environment is None else per_second(cost.environment.best_ns),
        )
        for cost in costs
    )
    title = f"What scenes cost: operations and ns per state, best, kernels and make_vec with {BATCH:,} states"
    console.print(plain_table(title, headings, rows, right=2))


def _sizes(cost: SceneCost) -> Iterator[tuple[str, str]]:
    for timing in (cost.dynamics, cost.step, cost.environment_step):
        yield f"{timing.operations:,}", three_digits(timing.best_ns)


def print_feature_costs(console: Console, costs: Sequence[SceneCost]) -> None:
    """Print what the parts of a scene cost.

    Args:
        console: Where to print.
        costs: Those of the whole scene first.
    """
    whole = costs[0]
    headings = ["", "states", "inputs"]
    for title in ("env. step", "dynamics"):
        headings += [f"{title}\nops", "ns", "of whole"]
    rows = []
    for cost in costs:
        row = [cost.title, str(cost.states), str(cost.inputs)]
        for timing, reference in (
            (cost.environment_step, whole.environment_step),
            (cost.dynamics, whole.dynamics),
        ):
            share = timing.best_ns / reference.best_ns
            row += [f"{timing.operations:,}", three_digits(timing.best_ns), f"{share:.2f}"]
        rows.append(row)
    integrator = integrator_title(whole.integrator)
    title = f"What parts cost: vector kernels on {BATCH:,} states, {integrator}, ns per state, best"
    console.print(plain_table(title, headings, rows, right=1))


def print_start_up(console: Console, scene: str, start_up: Mapping[str, Sequence[float]]) -> None:
    """Print how long new processes take.

    Args:
        console: Where to print.
        scene: Name of the scene.
        start_up: From `measure_start_up`.
    """
    rows = ((name, f"{min(times):.2f} s", f"{median(times):.2f} s") for name, times in start_up.items())
    console.print(plain_table(f"New processes, scene {scene}", ("", "best", "median"), rows, right=1))
