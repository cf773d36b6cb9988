"""Evaluations and comparisons as tables, remarks, Markdown and JSON values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.comparing import Comparison
from agents.evaluation.comparing import Row as ComparedRow
from agents.evaluation.evaluating import Evaluation, known_interval
from agents.evaluation.statistics import performance_profile, probability_of_improvement
from agents.evaluation.training_runs import Group
from dq_space_arm_env.common.tables import Column, Row, TextTable, one_line, tabulate


def percent(interval: Sequence[float | None]) -> str:
    """An interval of a share, in per cent on two lines; the share alone where its bounds are unknown."""
    value, *bounds = (_digits(100.0 * bound) for bound in interval if bound is not None)
    return f"{value}\n[{', '.join(bounds)}]" if bounds else value


def _digits(value: float) -> str:
    """A percentage with its significant digits."""
    size = abs(value)
    if size < 0.005:
        return "0.0"
    if size >= 1000.0:
        return f"{value:,.0f}"
    return f"{value:.2f}" if size < 1.0 else f"{value:.1f}"


def _microseconds(seconds: float) -> str:
    value = 1e6 * seconds
    return f"{value:.1f}" if value < 99.95 else f"{value:,.0f}"


def _duration(seconds: float) -> str:
    """A time such as "45 s", "12 min" or "3.4 h"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"


COLUMNS = {
    column.key: column
    for column in (
        Column("condition"),
        Column("policy", ""),
        Column("episodes", "starts"),
        Column("success_rate", "success\n%", percent),
        Column("median_cost_gap", "cost gap\n%", percent),
        Column("median_cost", "median\ncost J", ".4g"),
        Column("tail_cost_gap", "95th perc.\n%", percent),
        Column("saving", "saves\n%", percent, missing=""),
        Column("attitude_error", "angle\ndeg", ".2f"),
        Column("position_error", "distance\nm", ".3f"),
        Column("effort", "effort", ".3g"),
        Column("base_turn", "base turn\ndeg", ".1f"),
        Column("violating_episodes", "violating\nflights %", percent),
        Column("constraint_violations", "violations\n% of steps", percent),
        Column("action_seconds", "action\nus", _microseconds),
        Column("planning_seconds", "plan\ns", lambda seconds: f"{seconds:.2f}" if seconds else "-"),
        Column("training_steps", "training\nsteps", lambda steps: f"{steps:,.0f}"),
        Column("training_seconds", "training\ntime", _duration),
        Column("expert_solves", "expert\nsolves", lambda solves: f"{solves:,.0f}"),
        Column("solves", "expert\nsolves"),
    )
}
"""Columns of all tables, by the keys of the rows."""
PROFILE = (0.001, 0.01, 0.1, 1.0)
"""Cost gaps of the performance profiles in tables."""
_GAP, _COST = "median_cost_gap", "median_cost"
_VIOLATIONS = ("violating_episodes", "constraint_violations")
_FLIGHTS = (
    *("attitude_error", "position_error", "effort", "base_turn"),
    *_VIOLATIONS,
    "action_seconds",
)
_TRAINING = ("training_steps", "training_seconds")
_COMPARED = ("policy", "episodes", "success_rate", _GAP, _COST, "tail_cost_gap", *_FLIGHTS)
_MISMATCH = (
    *("condition", "policy", "episodes", "success_rate", "median_cost_gap", "saving"),
    *("attitude_error", "position_error", *_VIOLATIONS, "action_seconds"),
)


def evaluation_table(evaluations: Sequence[Evaluation]) -> TextTable:
    """The table of evaluations in one scene."""
    title = f"Scene {evaluations[0].scene}, {len(evaluations[0].seeds)} episodes; brackets: 95 % intervals"
    keys = ("policy", *_COMPARED[2:], *_TRAINING, "expert_solves")
    return _table(title, (each.summary() for each in evaluations), keys)


def comparison_tables(comparison: Comparison) -> list[TextTable]:
    """Tables of a comparison, one for each condition."""
    keys = (*_COMPARED, "planning_seconds", *_TRAINING, "solves")
    made = []
    for condition in comparison.conditions:
        title = f"Scene {comparison.scene}, condition {condition}; brackets: 95 % intervals"
        made.append(_table(title, (row.record() for row in comparison.under(condition)), keys))
        of_condition = [group for group in comparison.groups if group.condition == condition]
        if of_condition:
            made.append(groups_table(of_condition))
        if profiles := profile_rows(comparison, condition):
            made.append(_profiles_table(profiles))
        if improvements := improvement_rows(comparison, condition):
            made.append(_improvements_table(improvements))
    return made


def profile_rows(comparison: Comparison, condition: str) -> list[Row]:
    """Shares of valid flights within cost gaps, with their intervals, of all that have known gaps."""
    rows: list[Row] = []
    for name, members in comparison.entrants(condition):
        shares = performance_profile([row.evaluation.valid_cost_gaps for row in members], PROFILE)
        if shares:
            found = [list(share) for share in shares]
            rows.append({"condition": condition, "policy": name, "cost_gaps": list(PROFILE), "shares": found})
    return rows


def improvement_rows(comparison: Comparison, condition: str) -> list[Row]:
    """Probability of improvement of each agent over each other row, from the starts that both have flown."""
    rows: list[Row] = []
    # Agents come first; two controllers are not compared.
    entrants = sorted(comparison.entrants(condition), key=lambda each: not _is_agent(each[1]))
    for (name, members), (other, others) in combinations(entrants, 2):
        if _is_agent(members):
            starts = min(len(row.evaluation.seeds) for row in (*members, *others))
            costs, costs_of_other = (
                np.array([_costs(row.evaluation)[:starts] for row in each]) for each in (members, others)
            )
            found = list(probability_of_improvement(costs, costs_of_other))
            row = {"condition": condition, "policy": name, "over": other}
            rows.append({**row, "episodes": starts, "probability": found})
    return rows


def _costs(evaluation: Evaluation) -> NDArray[np.float64]:
    """Costs of flights, infinite where the policy gave NaN: drifting may cost less than flying."""
    return np.where(evaluation.flights.policy_failed, np.inf, evaluation.flights.cost)


def _is_agent(members: Sequence[ComparedRow]) -> bool:
    return bool(members[0].facts.get("is_agent"))


def _profiles_table(rows: Sequence[Row]) -> TextTable:
    title = "Performance profile: flights within a cost gap, %"
    keys = [f"{100.0 * gap:g} %" for gap in PROFILE]
    spread = ({"policy": row["policy"], **dict(zip(keys, row["shares"], strict=True))} for row in rows)
    columns = [Column("policy", ""), *(Column(key, f"within\n{key}", percent) for key in keys)]
    return replace(tabulate(title, spread, columns), right=1)


def _improvements_table(rows: Sequence[Row]) -> TextTable:
    title = "Probability of improvement: a flight costs less than one of the other from the same start, %"
    columns = (
        *(Column("policy", ""), Column("over"), COLUMNS["episodes"]),
        Column("probability", "costs less\n%", percent),
    )
    return replace(tabulate(title, rows, columns), right=2)


def mismatch_table(comparison: Comparison) -> TextTable:
    """The table of a comparison under model mismatch, all conditions in one."""
    title = f"Scene {comparison.scene}, controllers under model mismatch; brackets: 95 % intervals"
    rows = (row.evaluation.summary() | {"saving": row.facts["saving"]} for row in comparison.rows)
    return _table(title, rows, _MISMATCH, right=2)


def groups_table(groups: Sequence[Group]) -> TextTable:
    """A table of agents with several training runs."""
    title = "All training runs of an agent; cost gap: interquartile mean over runs and starts"
    rows = [group_record(group) | {"runs": ", ".join(map(str, group.seeds))} for group in groups]
    columns = [Column("agent", ""), Column("runs", "seeds"), COLUMNS["success_rate"]]
    if any(row["interquartile_mean_cost_gap"] is not None for row in rows):
        columns.append(Column("interquartile_mean_cost_gap", "cost gap\n%", percent))
    return replace(tabulate(title, rows, columns), right=2)


def _table(title: str, rows: Iterable[Row], keys: Iterable[str], right: int = 1) -> TextTable:
    """Tabulate rows; columns are left out that are empty in all of them, and costs where gaps are known."""
    found = list(rows)
    known = {key for row in found for key, value in row.items() if value is not None}
    shown = (COLUMNS[key] for key in keys if key in known and not (key == _COST and _GAP in known))
    return replace(tabulate(title, found, shown), right=right)


def remarks(evaluations: Iterable[Evaluation]) -> Iterator[str]:
    """Sentences on what a table does not show and its reader should know."""
    foreign: set[str] = set()
    for evaluation in evaluations:
        summary = evaluation.summary()
        where = f"{summary['policy']}, {summary['condition']}"
        if evaluation.same_scene is False and evaluation.policy not in foreign:
            foreign.add(evaluation.policy)
            yield (
                f"{evaluation.policy} was trained in another scene ({summary['trained_in']}), or in another "
                "version of this one."
            )
        if summary["policy_failed"]:
            yield (
                f"{where}: in {summary['policy_failed']} flights the policy gave NaN; they continued with "
                "zero inputs, and count as failures."
            )
        if evaluation.optimal is not None and summary["unknown_optima"]:
            yield (
                f"{where}: {summary['unknown_optima']} of {summary['episodes']} starts have no cost gap, "
                "because the expert found no optimum there."
            )
        if summary["cheaper_than_expert"]:
            yield (
                f"{where}: {summary['cheaper_than_expert']} flights reached the target for less than the "
                "expert, whose optima are local."
            )


def notes(comparison: Comparison) -> list[str]:
    """Sentences that explain the tables of a comparison."""
    entrants = [members for each in comparison.conditions for _, members in comparison.entrants(each)]
    found = [*comparison.notes, *remarks(row.evaluation for row in comparison.rows)]
    if any(len(members) == 1 and _is_agent(members) for members in entrants):
        found.append(
            "Intervals of an agent with one training run tell of other starts, not of other trainings."
        )
    return found


def markdown(title: str, tables: Sequence[TextTable], comparison: Comparison) -> str:
    """A comparison as Markdown: tables, notes and commands."""
    blocks = [f"# {title}, scene {one_line(comparison.scene)}"]
    for table in tables:
        blocks += table.markdown()
    commands = "\n".join(["```bash", *comparison.commands, "```"])
    blocks += map(one_line, notes(comparison))
    return "\n\n".join([*blocks, "Commands that reproduce the rows:", commands]) + "\n"


def record(comparison: Comparison) -> dict[str, Any]:
    """A comparison as JSON values."""
    return {
        "scene": comparison.scene,
        "rows": [row.record() for row in comparison.rows],
        "groups": [group_record(group) for group in comparison.groups],
        "profiles": [row for each in comparison.conditions for row in profile_rows(comparison, each)],
        "improvements": [row for each in comparison.conditions for row in improvement_rows(comparison, each)],
        "notes": notes(comparison),
        "commands": list(comparison.commands),
    }


def group_record(group: Group) -> dict[str, Any]:
    """A row of JSON values for an agent with several training runs."""
    return {
        "agent": group.name,
        "condition": group.condition,
        "seeds": list(group.seeds),
        "success_rate": list(group.runs.success_rate),
        "interquartile_mean_cost_gap": known_interval(group.runs.cost_gap),
    }
