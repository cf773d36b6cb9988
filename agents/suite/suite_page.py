"""The page of a suite: all tasks together, each task, and the same as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from agents.evaluation.comparison_tables import COLUMNS, percent
from agents.suite.scores import Score, SuiteRun
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.report_page import Page, Section
from dq_space_arm_env.common.tables import Column, Row, tabulate

WITHIN = (0.001, 0.01, 0.1)
"""Cost gaps of the profile in the table."""
_PROFILE = tuple(np.geomspace(1e-4, 1.0, 25).tolist())
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
    Column("tail", "95th perc.\n%", lambda gap: percent((gap,))),
    *(COLUMNS["violating_episodes"], *_TIMES),
    Column("training_commits", "trained\nat", lambda hashes: ", ".join(each[:7] for each in hashes)),
)


def suite_page(run: SuiteRun, *, picture: bool = True) -> Page:
    """The page of a suite's scores, with or without pictures; its record holds them as rows."""
    limits, sections = run.suite.limits, [_together(run, picture), _tasks(run)]
    claim = (
        f"A task is solved where at least {100 * limits.success:g} % of the flights reach the target, at "
        f"most {100 * limits.violating:g} % violate a constraint, the cost gap is at most "
        f"{100 * limits.cost_gap:g} %, and no training failed."
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
