"""Scores of a suite: an entrant's flights in a task, and all of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.evaluation.comparing import Row
from agents.evaluation.evaluating import TAIL, known_interval
from agents.evaluation.statistics import (
    Interval,
    gap_over_runs,
    percentiles,
    performance_profile,
    rate_over_runs,
)
from agents.suite.tasks import Limits, Suite


@dataclass(frozen=True, eq=False)
class Score:
    """An entrant in a task under a condition."""

    task: str
    condition: str
    entrant: str
    rows: tuple[Row, ...]  # one for each training, from the same starts
    failed: int = 0  # trainings that gave no policy

    @cached_property
    def success_rate(self) -> Interval:
        """Share of the flights that reach the target."""
        return rate_over_runs([row.evaluation.flights.is_success for row in self.rows])

    @cached_property
    def violating(self) -> Interval | None:
        """Share of the flights that violate a constraint at some step; None in a scene without."""
        return rate_over_runs(self._violates) if np.isfinite(self._shares).all() else None

    @cached_property
    def cost_gap(self) -> Interval:
        """Interquartile mean of J / J_expert - 1 over trainings and starts; NaN if it is not known."""
        return gap_over_runs([row.evaluation.cost_gaps for row in self.rows])

    def within(self, gaps: ArrayLike) -> list[Interval]:
        """Shares of the flights that reach the target within cost gaps and violate nothing."""
        return performance_profile([row.evaluation.valid_cost_gaps for row in self.rows], gaps)

    def solves(self, limits: Limits) -> bool:
        """Whether the entrant keeps to the limits of the suite; estimates count, not their intervals.

        None of its trainings may have failed: the others alone would tell of the lucky ones.
        """
        violating = None if self.violating is None else self.violating.value
        return not self.failed and limits.are_kept(self.success_rate.value, violating, self.cost_gap.value)

    def record(self, limits: Limits) -> dict[str, Any]:
        """The score as a row of JSON values."""
        summaries = [row.evaluation.summary() for row in self.rows]

        def mean(name: str) -> float | None:
            known = [each[name] for each in summaries if each[name] is not None]
            return float(np.mean(known)) if known else None

        gaps = np.concatenate([row.evaluation.cost_gaps for row in self.rows])
        known = gaps[~np.isnan(gaps)]
        return {
            "task": self.task,
            "condition": self.condition,
            "entrant": self.entrant,
            "runs": len(self.rows),
            "failed_trainings": self.failed,
            "episodes": summaries[0]["episodes"],
            "solved": self.solves(limits),
            "success_rate": list(self.success_rate),
            "interquartile_mean_cost_gap": known_interval(self.cost_gap),
            "tail": float(percentiles(known, TAIL)) if known.size else None,
            "unknown_optima": summaries[0]["unknown_optima"],  # starts that gaps and profiles leave out
            "violating_episodes": None if self.violating is None else list(self.violating),
            "action_seconds": float(np.median([each["action_seconds"] for each in summaries])),
            "planning_seconds": self.rows[0].facts["planning_seconds"],
            "training_seconds": mean("training_seconds"),
            "training_commits": self._commits or None,  # a folder may hold trainings of an earlier one
            "commands": [row.facts["evaluation_command"] for row in self.rows],
        }

    @property
    def _commits(self) -> list[str]:
        """Hashes of the commits that the policies were trained at, as far as they tell, sorted."""
        found: list[Any] = [row.evaluation.metadata for row in self.rows]
        for key in ("provenance", "commit", "hash"):  # of policies of others it may be anything
            found = [each.get(key) for each in found if isinstance(each, Mapping)]
        return sorted({each for each in found if isinstance(each, str)})

    @property
    def _shares(self) -> NDArray[np.float64]:
        return np.array([row.evaluation.flights.constraint_violations for row in self.rows])

    @property
    def _violates(self) -> NDArray[np.bool_]:
        return np.nan_to_num(self._shares) > 0.0


@dataclass(frozen=True, eq=False)
class SuiteRun:
    """Entrants in the tasks of a suite."""

    suite: Suite
    scores: tuple[Score, ...]  # task by task
    descriptions: Mapping[str, str]  # of the tasks
    notes: tuple[str, ...]  # what is missing, and why

    @property
    def entrants(self) -> tuple[str, ...]:
        """Names of the entrants."""
        return tuple(dict.fromkeys(score.entrant for score in self.scores))

    def of(self, entrant: str, condition: str) -> tuple[Score, ...]:
        """Scores of an entrant under a condition, task by task."""
        return tuple(each for each in self.scores if (each.entrant, each.condition) == (entrant, condition))
