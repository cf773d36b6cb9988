"""The method of multipliers around box-DDP: constraints become penalties, which multipliers make exact.

The solver minimizes an augmented Lagrangian (`dq_space_arm_env.task.augmented_lagrangian`) with multipliers l
and penalties r that are those of the present iteration. After a step that goes well and promises little more,
the multipliers follow, l <- l f'(r c) for rows c <= 0 and l <- l + r c for rows c = 0, and the penalties
grow. The stiffness of a row is l r: where a joint meets its limit the multiplier is an impulse, and the row
becomes stiff there only. It grows slowly: a leap would narrow the valley faster than steps can follow. The
inputs' bounds stay with the box QP. A solve ends where an unregularized step is predicted not to reduce the
Lagrangian, no row is violated, and the sum of |l c|, by which the cost may exceed that of the optimum, is
small.

The first steps, far from a minimum, leave the rows out.

Where all rows are at the end, they are few, and Newton's method finds their multipliers: the Lagrangian is
minimized with hardly any penalty of rows c <= 0, and the response of the final state (`end_response`) tells
which multipliers meet the rows. Rows of success are squares of errors, which
fall ever more slowly as their multipliers grow: steps from small multipliers are therefore not too long.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.scene.constraint_rows import Row
from experts.ddp.end_response import EndResponse
from experts.problems.shooting_problem import FloatArray
from experts.problems.stage_constraints import StageConstraints

FEASIBILITY = 1e-6
"""Largest violation of a feasible trajectory, in the units of the rows."""
SERIOUS = 1e-3
"""Violation with which a problem counts as infeasible where no step is left."""
COMPLEMENTARITY = 1e-7
"""Largest sum of |l c| at the end of a solve, relative to the cost, or to 1 if that is larger."""
STATIONARITY = 1e-12
"""Predicted reduction, relative to the cost, below which multipliers are slopes of the penalties."""
FIRST_MULTIPLIER = 1.0
"""First multiplier of a row c <= 0."""
LEAST_MULTIPLIER = 1e-9
"""Least multiplier of such a row: zero would stay zero. Where a solve is judged it counts as zero."""
LEAST_WARM_MULTIPLIER = 1e-2
"""The same where the multipliers of a similar maneuver are the first."""
CHANGE = (1e-3, 1e2)
"""Least and greatest factor of such a multiplier in an update."""
FIRST_PENALTY, FIRST_EQUALITY_PENALTY = 1e2, 1e4
"""First penalties of rows c <= 0 and c = 0."""
WEAK_PENALTY = 1e-3
"""Penalty of rows c <= 0 where all are at the end: next to none."""
GROWTH = 2.0
"""Factor of the penalties in an update, and most of a row's stiffness."""
LARGEST_PENALTY = 3e6
"""Beyond it rounding hides what a step gains."""
FIRST_STIFFNESS = 1e3
"""Least stiffness of a row to grow to in an update."""
GAIN_STIFFNESS = 1e3
"""Largest stiffness of a row in feedback gains: with more they would follow noise."""
BEGIN = 1e-2
"""Predicted reduction, relative to the cost, at which the rows begin to count."""
NEAR = 1e-3
"""Predicted reduction, relative to the cost, of a step after which the multipliers follow."""
NEAR_AT_END = 3e-3
"""The same where all rows are at the end."""
NEARER, NEAREST = 0.5, 1e-5
"""Factor of that from one update to the next, and its least value."""
LONG_ENOUGH = 0.5
"""Length of such a step."""
PATIENCE = 8
"""Updates without progress at the largest penalty after which a problem counts as infeasible."""
PROGRESS = 0.9
"""Largest share of the smallest violation so far that counts as progress."""
SUCCESS = "success: "
"""How names of rows begin that hold a final error."""
NOTABLE = 0.1
"""Violation, relative to the tolerance, that messages name besides the worst."""
MOST_NAMED = 4
"""Rows that they name."""


class ConstraintReport(NamedTuple):
    """How a trajectory keeps to its constraints.

    Attributes:
        violation: Largest residual of a row with its margin, in the row's unit; negative where all are met.
            Of success it is (e^2 - tolerance^2) / (2 tolerance), of an error e.
        worst_row: Name of the row that has it.
        worst_time: Time at which it has it, s.
        complementarity: Sum of |l c| over all rows, relative to the cost.
        active_share: Share of the rows c <= 0, over all stages, that are active: l > -c.
    """

    violation: float
    worst_row: str
    worst_time: float
    complementarity: float
    active_share: float


def _final_error(row: Row, residual: float) -> float:
    """The error e of a row of success, from its residual (e^2 - t^2) / (2 t); of angles e is 2 sin(a / 2)."""
    turns = row.unit == "rad"
    bound = 2.0 * math.sin(0.5 * min(row.tolerance, math.pi)) if turns else row.tolerance
    error = math.sqrt(max(bound**2 + 2.0 * bound * residual, 0.0))
    return 2.0 * math.asin(min(0.5 * error, 1.0)) if turns else error


def _unit(row: Row) -> str:
    return "" if row.unit == "1" else f" {row.unit}"


class AugmentedLagrangian:
    """Multipliers and penalties of a solve; they are zero outside of one.

    Attributes:
        counts: Whether the rows count.
        near: Predicted reduction, relative to the cost, of a step after which an update follows.
        is_at_end: Whether there are rows at the end only, see `update_by_response`.
    """

    def __init__(self, constraints: StageConstraints) -> None:
        self.constraints = constraints
        self._holds, self._equalities = constraints.holds, constraints.equalities
        self._inequalities = self._holds & ~self._equalities
        self.is_at_end = not constraints.path
        self.counts, self.near = False, BEGIN
        self._least_violation, self._idle_updates = np.inf, 0

    def leave_out(self) -> None:
        """Let the rows not count."""
        self.constraints.multipliers[:], self.constraints.penalties[:] = 0.0, 0.0
        self.counts, self.near = False, BEGIN

    def begin(self) -> None:
        """Let the rows count."""
        self.begin_with(np.zeros_like(self.constraints.multipliers), least=FIRST_MULTIPLIER)

    def begin_with(self, multipliers: FloatArray, least: float = LEAST_WARM_MULTIPLIER) -> None:
        """Let the rows count, with the multipliers of a similar maneuver, shape (N + 1, m)."""
        present, penalties = self.constraints.multipliers, self.constraints.penalties
        least, penalty = (LEAST_MULTIPLIER, WEAK_PENALTY) if self.is_at_end else (least, FIRST_PENALTY)
        present[:] = np.where(self._inequalities, np.maximum(multipliers, least), multipliers * self._holds)
        penalties[:] = np.where(self._equalities, FIRST_EQUALITY_PENALTY, penalty)
        penalties[~self._holds] = 0.0
        self.counts, self.near = True, NEAR_AT_END if self.is_at_end else NEAR
        self._least_violation, self._idle_updates = np.inf, 0

    def hold(self, multipliers: FloatArray) -> None:
        """Let the rows count with a solution's multipliers, shape (N + 1, m), as stiff as in its gains."""
        self.begin_with(multipliers)
        self.constraints.penalties[:] = np.where(self._holds, LARGEST_PENALTY, 0.0)
        self.soften()
        # Where a reserve is left, c = -reserve, the slopes l f'(r c) of the penalties are these multipliers.
        reserve = self.constraints.reserve
        end = (-1, slice(len(reserve)))
        softer = np.minimum(self.constraints.penalties[end], 0.5 / np.maximum(reserve, 1e-300))
        self.constraints.penalties[end] = softer
        self.constraints.multipliers[end] /= 1.0 - softer * reserve

    def update(self, states: FloatArray, controls: FloatArray) -> None:
        """Let the multipliers follow a trajectory, states (N + 1, n_x) and controls (N, n_u)."""
        penalties, residuals = self.constraints.penalties, self.constraints.find(states, controls)
        stiffness = np.maximum(GROWTH * self.constraints.multipliers * penalties, FIRST_STIFFNESS)
        self._move(residuals, CHANGE)
        self.near = max(NEARER * self.near, NEAREST)
        exhausted = penalties.max(initial=0.0) >= LARGEST_PENALTY
        np.minimum(GROWTH * penalties, LARGEST_PENALTY, out=penalties)
        softer = stiffness / np.maximum(self.constraints.multipliers, LEAST_MULTIPLIER)
        np.minimum(penalties, softer, out=penalties, where=self._inequalities)
        self._note_progress(residuals, exhausted)

    def update_by_response(self, states: FloatArray, controls: FloatArray, response: EndResponse) -> None:
        """Take a Newton step towards the multipliers with which a trajectory's end meets its rows.

        Multipliers of rows that are met without them are dropped.
        """
        count = len(response.residuals)
        present, equalities = self.constraints.multipliers[-1, :count], self._equalities[-1, :count]
        active = equalities | (present > LEAST_MULTIPLIER) | (response.residuals > 0.0)
        wanted = response.slopes @ present - response.residuals  # slopes l = wanted where rows are met
        for _ in range(count):
            found = np.zeros(count)
            found[active] = np.linalg.lstsq(response.slopes[np.ix_(active, active)], wanted[active])[0]
            active &= equalities | (found >= 0.0)
        present[:] = np.where(equalities, found, np.maximum(found, LEAST_MULTIPLIER))
        self._note_progress(self.constraints.find(states, controls), True)

    def _note_progress(self, residuals: FloatArray, counts: bool) -> None:
        """Compare the violation with those before, where a lack of progress counts."""
        violation = float(self._violations(residuals).max(initial=0.0))
        stands = counts and violation > max(PROGRESS * self._least_violation, FEASIBILITY)
        self._idle_updates = self._idle_updates + 1 if stands else 0
        self._least_violation = min(self._least_violation, violation)

    def settle(self, states: FloatArray, controls: FloatArray) -> None:
        """Take the slopes of the penalties along the last trajectory as multipliers: the best estimate."""
        self._move(self.constraints.find(states, controls), (0.0, np.inf))

    def _move(self, residuals: FloatArray, change: tuple[float, float]) -> None:
        """Let the multipliers follow, those of rows c <= 0 by factors within limits."""
        multipliers, t = self.constraints.multipliers, self.constraints.penalties * residuals
        slopes = np.where(t < -0.5, -0.25 / np.minimum(t, -0.5), 1.0 + t)  # f'
        grown = np.maximum(multipliers * np.clip(slopes, *change), LEAST_MULTIPLIER)
        multipliers[:] = np.where(self._inequalities, grown, multipliers + t)

    @property
    def is_stiff(self) -> bool:
        """Whether rows of stages count."""
        return self.counts and not self.is_at_end

    @property
    def is_infeasible(self) -> bool:
        """Whether large penalties have not reduced a violation for long."""
        return self._idle_updates >= PATIENCE

    def is_met(self, states: FloatArray, controls: FloatArray, cost: float) -> bool:
        """Whether a trajectory keeps to all rows, with multipliers only where it must."""
        residuals = self.constraints.find(states, controls)
        gap = self._complementarity(residuals)
        feasible = self._violations(residuals).max(initial=0.0) <= FEASIBILITY
        return bool(feasible and gap <= COMPLEMENTARITY * max(abs(cost), 1.0))

    def soften(self) -> None:
        """Limit the stiffness of rows to what feedback gains may have."""
        multipliers, penalties = self.constraints.multipliers, self.constraints.penalties
        most = GAIN_STIFFNESS / np.where(self._inequalities, np.maximum(multipliers, LEAST_MULTIPLIER), 1.0)
        np.minimum(penalties, most, out=penalties)

    def _complementarity(self, residuals: FloatArray) -> float:
        """Sum of |l c|; wide limits of many stages would add up to much with the least multipliers."""
        multipliers = self.constraints.multipliers
        return float(
            np.abs(np.where(np.abs(multipliers) > LEAST_MULTIPLIER, multipliers * residuals, 0.0)).sum()
        )

    def _violations(self, residuals: FloatArray) -> FloatArray:
        """Violations of the rows, negative where they are met, shape (N + 1, m); -inf where there is none."""
        return np.where(self._equalities, np.abs(residuals), np.where(self._inequalities, residuals, -np.inf))

    def violated(self, states: FloatArray, controls: FloatArray, time_step: float) -> str:
        """The rows that a trajectory violates most, relative to their tolerances, worst first, in words."""
        constraints, found = self.constraints, dict[str, tuple[float, str]]()
        violations = self._violations(constraints.find(states, controls))
        for rows, block, first in (
            (constraints.path, violations[:-1], 0),
            (constraints.terminal, violations[-1:], len(violations) - 1),
        ):
            for column, row in enumerate(rows):
                stage = int(block[:, column].argmax())
                most, unit = float(block[stage, column]), _unit(row)
                share = most / row.tolerance
                text = f"{row.name} by {most:.2g}{unit} at {(first + stage) * time_step:.3g} s"
                if row.name.startswith(SUCCESS):
                    error = _final_error(row, most)
                    text = f"{row.name} is {error:.3g}{unit}, {row.tolerance:.3g} at most"
                if share > found.get(row.name, (0.0, ""))[0]:
                    found[row.name] = share, text
        worst, *others = sorted(found.values(), reverse=True)[:MOST_NAMED] or [(0.0, "none")]
        return "; ".join([worst[1], *(text for share, text in others if share >= NOTABLE)])

    def worst(self, report: ConstraintReport) -> str:
        """The largest violation in words, of success the error beyond its tolerance."""
        constraints = self.constraints
        rows = (*constraints.path, *constraints.terminal)
        row = next(each for each in rows if each.name == report.worst_row)
        excess = report.violation
        if row.name.startswith(SUCCESS):
            excess = _final_error(row, excess) - row.tolerance
        return f"the largest violation is {excess:.1e}{_unit(row)}, of {row.name}"

    def report(
        self, states: FloatArray, controls: FloatArray, cost: float, time_step: float
    ) -> ConstraintReport:
        """Judge a trajectory by the present multipliers."""
        constraints = self.constraints
        residuals = constraints.find(states, controls)
        violations = self._violations(residuals)
        stage, column = np.unravel_index(violations.argmax(), violations.shape)
        gap = self._complementarity(residuals)
        active: NDArray[np.bool_] = (constraints.multipliers > -residuals)[self._inequalities]
        return ConstraintReport(
            violation=float(violations[stage, column]),
            worst_row=constraints.name(int(stage), int(column)),
            worst_time=float(stage * time_step),
            complementarity=gap / max(abs(cost), float(np.finfo(np.float64).tiny)),
            active_share=float(active.mean()) if active.size else 0.0,
        )
