"""The page of a suite: all tasks together, each task, and the same as JSON; and the check of such a file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.comparison_tables import COLUMNS, percent
from agents.suite.running import Score, SuiteRun
from agents.suite.tasks import Suite, SuiteError
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.common.files import differences, json_value
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Page, Section
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.tables import Column, Row, tabulate

WITHIN = (0.001, 0.01, 0.1)
"""Cost gaps of the profile in the table."""
_PROFILE = tuple(np.geomspace(1e-4, 1.0, 25).tolist())
_EQUAL = 1e-9  # relative difference
_ENTRANT = Column("entrant", "")
_TIMES = (COLUMNS["action_seconds"], COLUMNS["planning_seconds"], COLUMNS["training_seconds"])
_SCORES = (
    *(
        Column("condition"),
        _ENTRANT,
        Column("solved"),
        Column("runs"),
        COLUMNS["episodes"],
        COLUMNS["success_rate"],
    ),
    replace(COLUMNS["median_cost_gap"], key="interquartile_mean_cost_gap"),
    Column("tail", "95th perc.\n%", lambda gap: f"{100.0 * gap:.3g}"),
    *(COLUMNS["violating_episodes"], *_TIMES),
    Column("training_commits", "trained\nat", lambda hashes: ", ".join(each[:7] for each in hashes)),
)
_MEASURES = ("success_rate", "violating_episodes", "interquartile_mean_cost_gap")
_SAME = {"name", "starts", "receding_starts", "conditions", "limits", "tasks"}
"""What the suites of two runs share, where their scores compare."""


def suite_page(run: SuiteRun, *, picture: bool = True) -> Page:
    """The page of a suite's scores, with or without pictures; its record holds them as rows."""
    limits, sections = run.suite.limits, [_together(run, picture), _tasks(run)]
    claim = (
        f"A task is solved where at least {100 * limits.success:g} % of the flights reach the target, at "
        f"most {100 * limits.violating:g} % violate a constraint, and the cost gap is at most "
        f"{100 * limits.cost_gap:g} %."
    )
    return Page(run.suite.name, sections, provenance(), claim, "Missing")


def overall_rows(run: SuiteRun, condition: str) -> Iterator[Row]:
    """A row for each entrant under a condition: how many of its tasks it solves, and means over them."""
    for entrant in run.entrants:
        scores = run.of(entrant, condition)
        records = [score.record(run.suite.limits) for score in scores]
        trainings = [each["training_seconds"] for each in records if each["training_seconds"] is not None]
        yield {
            "condition": condition,
            "entrant": entrant,
            "tasks": len(scores),
            "solved": sum(each["solved"] for each in records),
            "success_rate": _mean([score.success_rate for score in scores]),
            **{
                f"within_{gap:g}": share for gap, share in zip(WITHIN, _profile(scores, WITHIN), strict=False)
            },
            "action_seconds": float(np.median([each["action_seconds"] for each in records])),
            "planning_seconds": float(np.median([each["planning_seconds"] for each in records])),
            "training_seconds": float(np.mean(trainings)) if trainings else None,
        }


def published(file: str | Path) -> tuple[dict[str, Any], dict[tuple[str, str, str], Row]]:
    """Read the JSON file of another run: its suite, and scores by task, condition and entrant.

    Raises:
        SuiteError: If the file is not one.
    """
    try:
        tasks = read_mapping(file)["parts"]["tasks"]
        if not isinstance(tasks["suite"], dict):
            raise TypeError(f"parts.tasks.suite: {shortened(tasks['suite'])}, should be a mapping")
        keys = [_checked_key(row) for row in tasks["scores"]]
        for (task, condition, entrant), count in Counter(keys).items():
            if count > 1:
                raise TypeError(f"{entrant} has {count} scores in {task}, {condition}")
        return tasks["suite"], dict(zip(keys, tasks["scores"], strict=True))
    except (UnreadableError, KeyError, TypeError) as error:
        raise SuiteError(f"{file}: is not the JSON file of a suite: {error}") from error


def _checked_key(row: Row) -> tuple[str, str, str]:
    """Task, condition and entrant of a score, whose measures are intervals; KeyError or TypeError if not."""
    key = row["task"], row["condition"], row["entrant"]
    if not all(isinstance(part, str) for part in key):
        raise TypeError(f"parts.tasks.scores: {shortened(list(key))}, should be texts")
    for name in _MEASURES:
        value = row.get(name)
        if value is not None and not _is_interval(value):
            raise TypeError(
                f"{name} of {key[2]} in {key[0]}: {shortened(value)}, should be three numbers, the first "
                "within the other two"
            )
    return key


def _is_interval(value: Any) -> bool:
    """Whether JSON values are an estimate between finite bounds, or one whose bounds are unknown."""
    numbers = value if isinstance(value, list) and len(value) == 3 else [None]
    if len(numbers) == 3 and numbers[1] is numbers[2] is None:
        numbers = numbers[:1] * 3
    if not all(isinstance(each, int | float) and not isinstance(each, bool) for each in numbers):
        return False
    estimate, low, high = map(float, numbers)
    return -math.inf < low <= estimate <= high < math.inf


def comparable(
    file: str | Path, suite: Suite, tasks: Iterable[str], names: Sequence[str]
) -> dict[tuple[str, str, str], Row]:
    """Read the JSON file of another run, which has to have scores of these names in these tasks.

    Raises:
        SuiteError: If the file is not one, contradicts itself, is of another suite, lacks a condition, or has
            no such score.
    """
    theirs_suite, theirs = published(file)
    mine = suite.model_dump(mode="json", include=_SAME)
    found = differences({key: theirs_suite.get(key) for key in mine}, mine)
    if found:
        raise SuiteError(f"{file}: is of another suite than {suite.name!r}: {'; '.join(found)}")
    flown = set(tasks)
    known = dict.fromkeys(name for task, _, name in theirs if task in flown)
    if not known:
        raise SuiteError(f"{file}: has no score in {', '.join(sorted(flown))}")
    if known.keys().isdisjoint(names):
        raise SuiteError(
            f"{file}: has no score of {', '.join(names)} in these tasks, but of {', '.join(known)}: put one "
            "of these names and = before the path of a policy"
        )
    for (task, condition, name), score in theirs.items():
        lacking = [each for each in suite.conditions if (task, each, name) not in theirs]
        if lacking:
            raise SuiteError(f"{file}: {name} flew in {task}, but not under {', '.join(lacking)}")
        success, *others = (None if score.get(key) is None else score[key][0] for key in _MEASURES)
        is_solved = success is not None and suite.limits.are_kept(success, *others)
        if score.get("solved") is not is_solved:
            wrong = f"solved is {shortened(score.get('solved'))}, should be {is_solved} by its numbers"
            raise SuiteError(f"{file}: {name} in {task}, {condition}: {wrong}")
    return theirs


def check(run: SuiteRun, file: str | Path) -> list[Row]:
    """Compare scores with those in the JSON file of another run.

    Returns:
        A row for each score that both have: `verdict` is "equal", "agrees" if all 95 % intervals overlap, or
        "differs". Then a row for each score of these tasks and entrants that the file alone has: "not flown".

    Raises:
        SuiteError: If the file is not one, or they have no score in common.
    """
    theirs = comparable(file, run.suite, run.descriptions, run.entrants)
    rows: list[Row] = []
    for score in run.scores:
        other = theirs.get((score.task, score.condition, score.entrant))
        if other is not None:
            record = score.record(run.suite.limits)
            verdicts = [_verdict(record[name], other.get(name)) for name in _MEASURES]
            worst = max(verdicts, key=("equal", "agrees", "differs").index)
            found = {f"their_{name}": other.get(name) for name in _MEASURES}
            rows.append({**record, **found, "verdict": worst})
    if not rows:  # the names fly, each in other tasks
        raise SuiteError(f"{file}: has no score of {', '.join(run.entrants)} in these tasks")
    return [*rows, *_not_flown(run, theirs)]


def _not_flown(run: SuiteRun, theirs: dict[tuple[str, str, str], Row]) -> Iterator[Row]:
    """Rows of the scores that others have in the tasks of a run, of its entrants, and that it lacks."""
    flown = {(score.task, score.condition, score.entrant) for score in run.scores}
    for key, other in theirs.items():
        task, condition, entrant = key
        if key not in flown and task in run.descriptions and entrant in run.entrants:
            found = {f"their_{name}": other.get(name) for name in _MEASURES}
            row = {"task": task, "condition": condition, "entrant": entrant, **found}
            yield {**row, **dict.fromkeys(_MEASURES), "verdict": "not flown"}


def check_columns() -> list[Column]:
    """Columns of a check."""
    pairs = [(COLUMNS["success_rate"], "success_rate"), (COLUMNS["violating_episodes"], "violating_episodes")]
    pairs.append((COLUMNS["median_cost_gap"], "interquartile_mean_cost_gap"))
    columns = [Column("task"), Column("condition"), _ENTRANT]
    for column, key in pairs:
        columns.append(replace(column, key=f"their_{key}", heading=f"{column.title}, theirs"))
        columns.append(replace(column, key=key, heading=f"{column.title}, here"))
    return [*columns, Column("verdict", "")]


def _verdict(mine: Sequence[float | None] | None, theirs: Sequence[float | None] | None) -> str:
    if mine is None or theirs is None:
        return "equal" if mine is theirs else "differs"
    here, there = (np.array(each, dtype=np.float64) for each in (mine, theirs))  # NaN for unknown bounds
    if np.allclose(here, there, rtol=_EQUAL, atol=_EQUAL, equal_nan=True):
        return "equal"
    return "agrees" if here[1] <= there[2] and there[1] <= here[2] else "differs"


def _together(run: SuiteRun, picture: bool) -> Section:
    section = Section(
        "together",
        "All tasks together",
        f"{run.suite.description} {len(run.descriptions)} of them are here. Each entrant flies from the "
        f"first {run.suite.starts} evaluation starts of "
        f"each task; the receding-horizon expert, which takes a second a flight, from "
        f"{run.suite.receding_starts}. Rates are means over tasks; brackets are 95 % intervals.",
        shortcomings=list(run.notes),
    )
    columns = [_ENTRANT, Column("tasks"), Column("solved"), COLUMNS["success_rate"]]
    columns += [Column(f"within_{gap:g}", f"within\n{100 * gap:g} %", percent) for gap in WITHIN]
    for condition in run.suite.conditions:
        section.add_rows(
            condition, overall_rows(run, condition), [*columns, *_TIMES], f"All tasks, condition {condition}"
        )
    section.notes.append(
        "Flights within a cost gap reach the target, violate nothing, and cost at most so much more than the "
        "expert's optimum from the same start. Times are medians over tasks, of training their mean."
    )
    if picture and run.scores:
        section.add_figure("profiles", "Performance profiles: means over tasks", lambda: _draw_profiles(run))
        caption = "Cost gap over the time of an action; a marker for each task"
        section.add_figure("times", caption, lambda: _draw_times(run))
    return section


def _tasks(run: SuiteRun) -> Section:
    section = Section(
        "tasks",
        "Each task",
        "Cost gap: J / J_expert - 1, interquartile mean over trainings and starts, and 95th percentile.",
    )
    records = [score.record(run.suite.limits) for score in run.scores]
    for task, description in run.descriptions.items():
        own = [record for record in records if record["task"] == task]
        if own:
            section.tables.append(tabulate(f"{task}\n{description}", own, _SCORES))
        lacking = (
            f"{task}, {each['condition']}: {each['unknown_optima']} of {each['episodes']} starts have no "
            "cost gap and count in no profile, because the expert found no optimum there."
            for each in own
            if each["unknown_optima"]
        )
        section.notes += dict.fromkeys(lacking)  # the same for all who fly from the same starts
    section.record |= {"suite": run.suite.model_dump(mode="json"), "scores": json_value(records)}
    return section


def _draw_profiles(run: SuiteRun) -> bytes:
    from experts.figures.plots import Plot

    rows = [
        {"condition": condition, "entrant": entrant, "gap": 100.0 * gap, "share": 100.0 * share[0]}
        for condition in run.suite.conditions
        for entrant in run.entrants
        for gap, share in zip(_PROFILE, _profile(run.of(entrant, condition), _PROFILE), strict=False)
    ]
    labels = {"gap": "cost gap [%]", "share": "flights within it [%]"}
    return Plot("gap", "share", color="entrant", facet="condition", log="x", labels=labels).png(rows)


def _draw_times(run: SuiteRun) -> bytes:
    from experts.figures.plots import Plot

    rows = []
    for score in run.scores:
        record = score.record(run.suite.limits)
        shown = {"time": 1e6 * record["action_seconds"], "gap": 100.0 * score.cost_gap.value}
        rows.append({"condition": score.condition, "entrant": score.entrant, **shown})
    labels = {"time": "time per action [µs]", "gap": "cost gap [%]; below 0.01 at 0.01"}
    plot = Plot(
        "time", "gap", color="entrant", facet="condition", log="xy", join=False, floor=0.01, labels=labels
    )
    return plot.png(rows)


def _profile(scores: Sequence[Score], gaps: Sequence[float]) -> list[list[float]]:
    """Means over tasks of the shares of flights within cost gaps."""
    found = [score.within(gaps) for score in scores]
    known = [shares for shares in found if shares]
    return [_mean(list(each)) for each in zip(*known, strict=True)] if known else []


def _mean(rates: Sequence[Sequence[float]]) -> list[float]:
    """Mean of independent rates; the widths of their intervals add as independent errors do."""
    value, low, high = np.transpose(rates)
    below, above = (math.sqrt(float(np.sum(part**2))) / len(value) for part in (value - low, high - value))
    mean = float(np.mean(value))
    return [mean, max(mean - below, 0.0), min(mean + above, 1.0)]
