"""A data set as tables: distributions, guesses, times, failures, and what it follows from."""

from __future__ import annotations

from collections import Counter

import numpy as np

from experts.report.demonstrations.facts import Facts, Quantity
from experts.report.tables import TextTable

SHARES = (0.05, 0.5, 0.95)
MOST_FAILURES = 20
"""Failures that are listed one by one."""


def contents(facts: Facts) -> TextTable:
    """What the data set is.

    Args:
        facts: The data set in numbers.

    Returns:
        A row for each fact.
    """
    demonstrations, settings = facts.demonstrations, facts.demonstrations.settings
    simulation = demonstrations.scene.simulation
    size = sum(shard["bytes"] for shard in demonstrations.manifest["shards"])
    rows = (
        ("scene", demonstrations.scene.name),
        ("problems", f"{facts.problems}, drawn with seed {settings['seed']}"),
        ("demonstrations", f"{len(demonstrations)} ({share(len(demonstrations), facts.problems)})"),
        ("failures", str(len(facts.failures["index"]))),
        ("stages", f"{simulation.steps} of {simulation.dt:g} s"),
        ("files", f"{len(demonstrations.manifest['shards'])} shards, {number(size / 1e6)} MB"),
        ("versions", ", ".join(f"{name} {version}" for name, version in settings["versions"].items())),
    )
    return TextTable("The data set", ("", ""), rows)


def distributions(facts: Facts, *, with_times: bool = True) -> TextTable:
    """Distribution of each quantity.

    Args:
        facts: The data set in numbers, M > 0.
        with_times: Whether to show what comes from the log.

    Returns:
        A row for each quantity that is known.
    """
    shown = (q for q in facts.quantities if len(q.values) and (with_times or not q.from_log))
    rows = tuple(_distribution(quantity) for quantity in shown)
    headings = ("", "least", *(f"{100 * part:g} %" for part in SHARES), "most", "mean", "bound")
    return TextTable("Distributions", headings, rows, right=1)


def _distribution(quantity: Quantity) -> tuple[str, ...]:
    values = quantity.values
    numbers = (values.min(), *np.quantile(values, SHARES), values.max(), values.mean())
    bound = "" if quantity.bound is None else number(quantity.bound)
    return (quantity.label, *(number(float(value)) for value in numbers), bound)


def guesses(facts: Facts) -> TextTable:
    """What the solves began with.

    Args:
        facts: The data set in numbers, M > 0.

    Returns:
        A row for each guess that led to a demonstration, the most frequent first.
    """
    title = "What the solves began with\nneighbor: solved again, the way of a neighbor's policy"
    return _groups(title, "guess", facts.guesses.tolist(), facts)


def emphases(facts: Facts) -> TextTable:
    """How much the final pose was emphasized.

    Args:
        facts: The data set in numbers, M > 0.

    Returns:
        A row for each power of ten that a factor is in, the most frequent first.
    """
    title = (
        "Emphasis of the final pose\nwhere the cheapest maneuver ends outside of the tolerances, the weights "
        "of the pose at its end are multiplied until it does not"
    )
    decades = np.floor(np.log10(facts.emphases)).astype(np.int64).tolist()
    names = [
        "1" if emphasis == 1.0 else f"{10.0**decade:g} to {10.0 ** (decade + 1):g}"
        for emphasis, decade in zip(facts.emphases.tolist(), decades, strict=True)
    ]
    return _groups(title, "factor", names, facts)


def _groups(title: str, heading: str, names: list[str], facts: Facts) -> TextTable:
    """Number, iterations and cost of the demonstrations with each name."""
    cost, iterations = (facts.quantity(name).values for name in ("cost J", "iterations"))
    rows, each = [], np.array(names)
    for name, count in Counter(names).most_common():
        mine = each == name
        medians = (number(float(np.median(values[mine]))) for values in (iterations, cost))
        rows.append((name, str(count), share(count, len(names)), *medians))
    headings = (heading, "demonstrations", "share", "iterations, median", "cost, median")
    return TextTable(title, headings, tuple(rows), right=1)


def times(facts: Facts) -> TextTable:
    """What making the shards took.

    Args:
        facts: The data set in numbers, with a log.

    Returns:
        A row for each part of the work.
    """
    log = facts.log
    total = sum(log.seconds.values())
    problems = len(log.solve_seconds)
    rows = [
        (part, f"{seconds:.2f}", share(seconds, total), f"{1e3 * seconds / problems:.2f}")
        for part, seconds in log.seconds.items()
    ]
    rows.append(("together", f"{total:.2f}", "", f"{1e3 * total / problems:.2f}"))
    explained = (
        f"wall clock, {log.shards} of {len(facts.demonstrations.manifest['shards'])} shards, on "
        f"{', '.join(log.machines)}; {problems / total:.2f} problems a second and process"
    )
    headings = ("", "s", "share", "ms a problem")
    return TextTable(f"Times\n{explained}", headings, tuple(rows), right=1)


def failure_reasons(facts: Facts) -> TextTable:
    """Why problems led to no demonstration.

    Args:
        facts: The data set in numbers.

    Returns:
        A row for each reason.
    """
    found = facts.demonstrations.manifest["failures"]
    rows = tuple((reason, str(count), share(count, facts.problems)) for reason, count in found.items())
    return TextTable("Reasons", ("reason", "problems", "share"), rows, right=1)


def failure_list(facts: Facts) -> TextTable:
    """The first failures, one by one.

    Args:
        facts: The data set in numbers.

    Returns:
        A row for each.
    """
    failures, rows = facts.failures, []
    for i in range(min(len(failures["index"]), MOST_FAILURES)):
        errors = (*failures["start_errors"][i], *failures["final_errors"][i], failures["cost"][i])
        rows.append(
            (
                str(failures["index"][i]),
                str(failures["seed"][i]),
                str(failures["reason"][i]),
                *(number(float(value)) for value in errors),
            )
        )
    rest = len(failures["index"]) - len(rows)
    headings = ("problem", "seed", "reason", "start [°]", "start [m]", "end [°]", "end [m]", "cost J")
    title = f"Failures\nenv.reset(seed=...) starts there{f'; {rest} more are not shown' if rest else ''}"
    return TextTable(title, headings, tuple(rows), right=3)


def number(value: float) -> str:
    """Write a number.

    Args:
        value: Any unit.

    Returns:
        Three digits.
    """
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def share(part: float, whole: float) -> str:
    """Write a share.

    Args:
        part: Any unit.
        whole: The same unit.

    Returns:
        Per cent.
    """
    return f"{part / whole:.1%}" if whole else "-"
