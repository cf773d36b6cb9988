"""Check the scores of a suite against those in the JSON file of another run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.comparison_tables import COLUMNS
from agents.suite.scores import SuiteRun
from agents.suite.tasks import Suite, SuiteError
from dq_space_arm_env.common.bounded_reading import UnreadableError, read_mapping
from dq_space_arm_env.common.files import differences
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.tables import Column, Row

_EQUAL = 1e-9  # relative difference
_MEASURES = ("success_rate", "violating_episodes", "interquartile_mean_cost_gap")
_COUNTS = ("runs", "failed_trainings")
_SAME = {"name", "starts", "receding_starts", "conditions", "limits", "tasks"}
"""What the suites of two runs share, where their scores compare."""


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
    """Task, condition and entrant of a score; KeyError or TypeError if its measures or counts are none."""
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
    for name in _COUNTS:
        count = row.get(name, 0)  # older files lack failed_trainings
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise TypeError(
                f"{name} of {key[2]} in {key[0]}: {shortened(count)}, should be a whole number, at least 0"
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
        is_kept = success is not None and suite.limits.are_kept(success, *others)
        is_solved = is_kept and not score.get("failed_trainings", 0)
        if score.get("solved") is not is_solved:
            wrong = f"solved is {shortened(score.get('solved'))}, should be {is_solved} by its numbers"
            raise SuiteError(f"{file}: {name} in {task}, {condition}: {wrong}")
    return theirs


def check(run: SuiteRun, file: str | Path) -> list[Row]:
    """Compare scores with those in the JSON file of another run.

    Returns:
        A row for each score that both have: `verdict` is "equal", "agrees" if all 95 % intervals overlap, or
        "differs", as where fewer trainings are left than in the file because some failed. Then a row for each
        score of these tasks and entrants that the file alone has: "not flown".

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
            if record["failed_trainings"] and record["runs"] < other.get("runs", 0):
                worst = "differs"
            found = {f"their_{name}": other.get(name) for name in (*_MEASURES, "runs")}
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
            found = {f"their_{name}": other.get(name) for name in (*_MEASURES, "runs")}
            row = {"task": task, "condition": condition, "entrant": entrant, **found}
            yield {**row, **dict.fromkeys((*_MEASURES, "runs")), "verdict": "not flown"}


def fewer_trainings(rows: Iterable[Row]) -> Iterator[str]:
    """A sentence on each entrant of a check that has fewer trainings than in the file, as by `--seeds 1`."""
    counts = [(row["entrant"], row["runs"], row["their_runs"] or 0) for row in rows if row["runs"]]
    for entrant, here, there in dict.fromkeys(counts):
        if here < there:
            yield f"{entrant}: runs here: {here}, in the file: {there}; intervals of fewer agree with more"


def check_columns() -> list[Column]:
    """Columns of a check."""
    pairs = [(COLUMNS["success_rate"], "success_rate"), (COLUMNS["violating_episodes"], "violating_episodes")]
    pairs.append((COLUMNS["median_cost_gap"], "interquartile_mean_cost_gap"))
    columns = [Column("task"), Column("condition"), Column("entrant", "")]
    columns += [Column("their_runs", "runs,\ntheirs"), Column("runs", "runs,\nhere")]
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
