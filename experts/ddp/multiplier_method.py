"""The method of multipliers around box-DDP: when multipliers follow the steps, and what the result is.

After a step that goes well and promises little more the multipliers follow (`augmented_lagrangian`), by a
Newton step where all rows are at the end (`end_response`). A solve ends where an unregularized step is
predicted not to reduce the Lagrangian, and the rows are met.
"""

from typing import NamedTuple

import numpy as np

from experts.ddp.augmented_lagrangian import (
    LONG_ENOUGH,
    SERIOUS,
    STATIONARITY,
    AugmentedLagrangian,
    ConstraintReport,
)
from experts.ddp.directions import Directions
from experts.ddp.end_response import end_response
from experts.ddp.second_order import SolverState
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import IterationRecord, Stop, StopReason
from experts.problems.shooting_problem import FloatArray
from experts.problems.stage_constraints import StageConstraints


class Finish(NamedTuple):
    """The end of a solve."""

    stop: Stop
    gains: FloatArray  # shape (N, n_u, n_t)
    multipliers: FloatArray  # shape (N + 1, m)
    report: ConstraintReport


class MultiplierMethod:
    """Constraints of a workspace's problem, whose multipliers follow the current trajectory.

    Attributes:
        lagrangian: Multipliers and penalties.
    """

    def __init__(
        self, work: ShootingWorkspace, constraints: StageConstraints, directions: Directions
    ) -> None:
        self.lagrangian = AugmentedLagrangian(constraints)
        self._work, self._directions = work, directions

    @property
    def is_met(self) -> bool:
        """Whether the current trajectory keeps to all rows."""
        current = self._work.current
        return self.lagrangian.is_met(current.states, current.controls, current.cost)

    def is_unfinished(self, state: SolverState, stop: Stop) -> bool:
        """Whether only the constraints ask for more: a step too small to count still serves their rows.

        An unconstrained minimum that keeps to them is theirs.
        """
        if stop.reason is not StopReason.CONVERGED:
            return False
        is_rough = self.lagrangian.counts and state.optimality > STATIONARITY
        return is_rough or not self.is_met

    def is_near(self, record: IterationRecord) -> bool:
        """Whether a step went well and promised so little that the multipliers follow."""
        is_near = record.alpha >= LONG_ENOUGH and record.optimality <= self.lagrangian.near
        return is_near and (self.lagrangian.counts or not self.is_met)

    def follow(self, state: SolverState) -> Stop | None:
        """Let constraints begin to count, or multipliers follow the trajectory."""
        work, lagrangian = self._work, self.lagrangian
        begins = not lagrangian.counts
        if begins:
            lagrangian.begin()
            state.switch.request_exact()
        if lagrangian.is_at_end:
            response = end_response(work, lagrangian.constraints, exact=self._directions.has_exact)
            if response is not None:  # else the model has no minimum yet
                lagrangian.update_by_response(work.current.states, work.current.controls, response)
        elif not begins:
            lagrangian.update(work.current.states, work.current.controls)
        work.evaluate_anew()
        state.moved, state.idle_iterations, state.optimality = True, 0, np.inf
        if not lagrangian.is_infeasible:
            return None
        current, time_step = work.current, work.problem.time_step
        violated = lagrangian.violated(current.states, current.controls, time_step)
        return Stop(StopReason.INFEASIBLE, f"violated are {violated}; larger penalties do not help")

    def finish(self, stop: Stop) -> Finish:
        """Compute the gains with moderate penalties, and the cost without any."""
        work, lagrangian = self._work, self.lagrangian
        if lagrangian.counts:
            lagrangian.settle(work.current.states, work.current.controls)
            lagrangian.soften()
        work.differentiate()
        gains, message = np.zeros_like(work.update.K), stop.message
        if self._directions.final().completed:
            gains = work.update.K.copy()
        else:
            message += "; there are no feedback gains, they are zero"
        multipliers, report = lagrangian.constraints.multipliers.copy(), self._report()
        lagrangian.leave_out()
        work.evaluate_anew()
        if report.violation > 0.0:
            message += f"; {lagrangian.worst(report)}"
        reason = stop.reason
        if reason is StopReason.REGULARIZATION_LIMIT and report.violation > SERIOUS:
            reason = StopReason.INFEASIBLE
        return Finish(Stop(reason, message), gains, multipliers, report)

    def _report(self) -> ConstraintReport:
        """Judge the current trajectory by its constraints."""
        current = self._work.current
        time_step = self._work.problem.time_step
        return self.lagrangian.report(current.states, current.controls, current.cost, time_step)
