"""Box-DDP: optimal control of a shooting problem with bounds on the controls.

Control-limited differential dynamic programming of Tassa, Mansard & Todorov (ICRA 2014), with the
Gauss-Newton model of the dynamics (iLQR), exact second derivatives (Newton's method), or a hybrid of the two
(`models`). An iteration differentiates along the trajectory, sweeps backward for a control update and its
gains, and rolls the update out with shorter and shorter steps until one lowers the cost as promised.

**When it has converged.** The measure is the decrease of the cost that a full, undamped step promises,
relative to the cost. It does not change with the units of states, controls or cost, it accounts for the
bounds, and it is zero exactly at a point that satisfies the first-order conditions. A small decrease of the
cost is no such sign: damping or a plateau of a curved problem make steps small far from any minimum. Where
there are exact second derivatives the step is Newton's, which exists only if they are positive definite: a
saddle does not pass, nor does a valley whose floor Gauss-Newton takes for steeper than it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from experts.backward_sweep import (
    SWEEP_DONE,
    SWEEP_NOT_FINITE,
    SWEEP_NOT_POSITIVE_DEFINITE,
    SweepOutcome,
)
from experts.checks import check_array, check_at_least
from experts.line_search import line_search
from experts.models import EXACT_DAMPING, ModelSchedule, SecondOrder
from experts.problem import FloatArray, ShootingProblem, as_problem
from experts.regularization import Regularization
from experts.rollout import FINISHED
from experts.shooting import ShootingWorkspace, WorkTime
from experts.solution import HISTORY_DTYPE, IterationRecord, Solution, StopReason

COST_FLOOR = 1e-9
"""Costs below this share of the first one count as zero: relative measures are taken to it."""

Callback = Callable[[IterationRecord], None]


class _Proposal(NamedTuple):
    """A control update that a sweep has found, or how it failed.

    Attributes:
        exact: Whether it comes from exact second derivatives.
        damping: Weight lambda of the damping.
        outcome: How the sweep ended.
    """

    exact: bool
    damping: float
    outcome: SweepOutcome


class _Stop(NamedTuple):
    """Why a solve ends, and the same in words."""

    reason: StopReason
    message: str


@dataclass
class _Progress:
    """What a solve carries from iteration to iteration.

    Attributes:
        schedule: Which model to take, and its damping.
        cost_floor: Costs below it count as zero, in the unit of the cost.
        optimality: Relative decrease that an undamped step promises, inf where unknown.
        idle_iterations: Iterations in a row that hardly lowered the cost.
        records: One per iteration.
    """

    schedule: ModelSchedule
    cost_floor: float
    optimality: float = np.inf
    idle_iterations: int = 0
    records: list[IterationRecord] = field(default_factory=list)


class BoxDDP:
    """Solver for one problem; it keeps its work arrays between solves, so give each thread its own."""

    def __init__(
        self,
        scene_or_problem: Any,
        *,
        max_iterations: int = 200,
        tolerance: float = 1e-7,
        plateau_decrease: float = 1e-8,
        plateau_iterations: int = 50,
        initial_regularization: float = 1000.0,
        second_order: str | None = None,
        threads: int = 1,
    ) -> None:
        """Prepare the solver.

        Args:
            scene_or_problem: A scene, or a `ShootingProblem`.
            max_iterations: Largest number of iterations.
            tolerance: Converged when an undamped step promises less than this decrease, relative to the cost.
            plateau_decrease: An iteration is idle when it lowers the cost by less than this, relative to
                the cost.
            plateau_iterations: Number of idle iterations in a row that end the solve.
            initial_regularization: First weight of the damping, in multiples of the control weights. Small
                ones let the first steps go so far that the solve may end in a poor minimum.
            second_order: Second derivatives to take: "gauss_newton", "exact" or "hybrid", see
                `models.SecondOrder`. None takes the hybrid if the problem has exact ones, else Gauss-Newton.
            threads: Most threads that work on derivatives. More than one pays only where a core is idle.

        Raises:
            ValueError: If a setting is out of range, second_order is unknown or asks for derivatives that the
                problem does not have, or the problem contradicts itself.
        """
        check_at_least("max_iterations", max_iterations, 0)
        check_at_least("tolerance", tolerance, 0.0)
        check_at_least("plateau_decrease", plateau_decrease, 0.0)
        check_at_least("plateau_iterations", plateau_iterations, 1)
        check_at_least("initial_regularization", initial_regularization, 0.0)
        check_at_least("threads", threads, 1)
        self.problem: ShootingProblem = as_problem(scene_or_problem)
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.plateau_decrease = plateau_decrease
        self.plateau_iterations = plateau_iterations
        self.initial_regularization = initial_regularization
        self.second_order = SecondOrder.of(second_order, self.problem.has_second_order)
        exact = self.second_order is not SecondOrder.GAUSS_NEWTON
        self._work = ShootingWorkspace(self.problem, exact, threads=threads)

    def solve(
        self,
        x0: FloatArray | None = None,
        u_init: FloatArray | None = None,
        callback: Callback | None = None,
    ) -> Solution:
        """Minimize the cost, starting from a guess of the controls.

        Args:
            x0: State at stage 0, shape (n_x,); the problem's initial state if None.
            u_init: First guess of the controls, within the bounds, shape (N, n_u); if None zeros, or the
                bound next to zero where zero is not allowed.
            callback: Called with the record of every iteration; it may raise KeyboardInterrupt to end the
                solve.

        Returns:
            The best trajectory found, whatever the reason to stop.

        Raises:
            ValueError: If x0 or u_init have the wrong shape, are not finite or out of bounds, or an input
                has no cost of its own.
        """
        initial_state, controls = self._check_start(x0, u_init)
        work = self._work
        work.start(initial_state, controls)
        schedule = ModelSchedule(self.second_order, Regularization(self.initial_regularization))
        progress = _Progress(schedule, COST_FLOOR * abs(work.current.cost))
        if work.current.failing_stage != FINISHED:
            message = f"the first rollout is not finite from stage {work.current.failing_stage} on"
            return self._collect(progress, StopReason.DIVERGED, message, np.zeros_like(work.update.gains))
        try:
            stop = self._iterate(progress, callback)
        except KeyboardInterrupt:
            stop = _Stop(StopReason.INTERRUPTED, "interrupted by the user")
        return self._finish(progress, stop)

    def _iterate(self, progress: _Progress, callback: Callback | None) -> _Stop:
        """Iterate until there is a reason to stop."""
        work = self._work
        moved = True
        while True:
            started = perf_counter()
            work.time = WorkTime()
            if moved:
                work.differentiate()
            if not progress.records:
                self._check_control_weights()
            result = self._take_step(progress, started)
            if isinstance(result, _Stop):
                return result
            if callback is not None:
                callback(result)
            moved = result.alpha > 0.0
            stop = self._stop_after_step(progress)
            if stop is not None:
                return stop

    def _take_step(self, progress: _Progress, started: float) -> IterationRecord | _Stop:
        """Search along an update, adapt the damping, and take the record; or say why there is no step."""
        schedule, cost = progress.schedule, self._work.current.cost
        if schedule.tries_exact_first:
            proposal = self._try_exact()
            if proposal.outcome.status != SWEEP_NOT_POSITIVE_DEFINITE:
                stop = self._stop_before_step(progress, proposal)
                if stop is not None:
                    return stop
                alpha = line_search(self._work, proposal.outcome)
                if alpha > 0.0:
                    return self._record(progress, proposal, cost, alpha, started)
            schedule.postpone_exact()
        proposal = self._find_update(
            schedule.regularization, exact=schedule.second_order is SecondOrder.EXACT
        )
        stop = self._stop_before_step(progress, proposal)
        if stop is not None:
            return stop
        alpha = line_search(self._work, proposal.outcome)
        if alpha > 0.0:
            schedule.regularization.follow(alpha)
        else:
            schedule.regularization.increase()
        return self._record(progress, proposal, cost, alpha, started)

    def _try_exact(self) -> _Proposal:
        """Sweep with exact second derivatives under weak damping only; it may fail."""
        self._work.differentiate_twice()
        for damping in EXACT_DAMPING:
            outcome = self._work.sweep(damping, exact=True)
            if outcome.status != SWEEP_NOT_POSITIVE_DEFINITE:
                break
        return _Proposal(True, damping, outcome)

    def _find_update(self, regularization: Regularization, *, exact: bool) -> _Proposal:
        """Sweep with as much damping as it takes to succeed; give up beyond the largest one."""
        if exact:
            self._work.differentiate_twice()
        outcome = self._work.sweep(regularization.value, exact=exact)
        while outcome.status == SWEEP_NOT_POSITIVE_DEFINITE and not regularization.exhausted:
            regularization.increase()
            outcome = self._work.sweep(regularization.value, exact=exact)
        return _Proposal(exact, regularization.value, outcome)

    def _stop_before_step(self, progress: _Progress, proposal: _Proposal) -> _Stop | None:
        """Judge a sweep: has it failed, is the trajectory optimal, may another iteration begin?"""
        outcome = proposal.outcome
        if outcome.status == SWEEP_NOT_FINITE:
            return _Stop(StopReason.DIVERGED, f"the derivatives are not finite at stage {outcome.stage}")
        if outcome.status != SWEEP_DONE:
            return _Stop(
                StopReason.REGULARIZATION_LIMIT,
                f"the model of the cost at stage {outcome.stage} is not convex, however strong the damping",
            )
        if self._promise(progress, outcome) <= self.tolerance and self._is_optimal(progress, proposal):
            return _Stop(StopReason.CONVERGED, "no step promises to lower the cost")
        if len(progress.records) == self.max_iterations:
            return _Stop(
                StopReason.MAX_ITERATIONS, f"the limit of {self.max_iterations} iterations is reached"
            )
        return None

    def _is_optimal(self, progress: _Progress, proposal: _Proposal) -> bool:
        """Say whether an undamped step promises as little as the given one; if so, its update is kept.

        Exact second derivatives have the last word, where there are any.
        """
        outcome, exact = proposal.outcome, progress.schedule.has_exact
        if exact:
            progress.schedule.call_for_exact()
            self._work.differentiate_twice()
        if proposal.damping > 0.0 or proposal.exact != exact:
            outcome = self._work.sweep(0.0, exact=exact)
            if outcome.status != SWEEP_DONE:
                return False
        progress.optimality = self._promise(progress, outcome)
        if progress.optimality <= self.tolerance:
            return True
        self._work.restore_update()
        return False

    def _promise(self, progress: _Progress, outcome: SweepOutcome) -> float:
        """Relate the decrease that the full step promises to the cost."""
        return outcome.promise(1.0) / _scale(self._work.current.cost, progress)

    def _record(
        self, progress: _Progress, proposal: _Proposal, cost: float, alpha: float, started: float
    ) -> IterationRecord:
        """Take the record of an iteration that began at a cost."""
        work, outcome = self._work, proposal.outcome
        promised = outcome.promise(1.0)
        record = IterationRecord(
            iteration=len(progress.records) + 1,
            cost=work.current.cost,
            alpha=alpha,
            exact=proposal.exact,
            regularization=proposal.damping,
            expected_decrease=promised,
            optimality=promised / _scale(cost, progress),
            clamped_share=outcome.clamped / work.current.controls.size,
            seconds=perf_counter() - started,
            derivative_seconds=work.time.derivatives,
            sweep_seconds=work.time.sweep,
            rollout_seconds=work.time.rollout,
        )
        progress.records.append(record)
        progress.schedule.observe(record, cost)
        idle = cost - record.cost < self.plateau_decrease * abs(record.cost)
        progress.idle_iterations = progress.idle_iterations + 1 if idle else 0
        return record

    def _stop_after_step(self, progress: _Progress) -> _Stop | None:
        """Judge the progress: is there a step left to try, has the cost stayed where it is?"""
        if progress.schedule.regularization.exhausted and progress.records[-1].alpha == 0.0:
            return _Stop(
                StopReason.REGULARIZATION_LIMIT, "no step lowers the cost, however strong the damping"
            )
        if progress.idle_iterations >= self.plateau_iterations:
            return _Stop(
                StopReason.PLATEAU,
                f"{self.plateau_iterations} iterations in a row lowered the cost by less than "
                f"{self.plateau_decrease:.0e} of its value",
            )
        return None

    def _finish(self, progress: _Progress, stop: _Stop) -> Solution:
        """Compute the gains around the final trajectory, judge it without damping, and collect the result."""
        work, (reason, message) = self._work, stop
        if reason is not StopReason.CONVERGED:
            progress.optimality = np.inf
            work.differentiate()
            proposal = self._final_update(progress)
            if proposal.outcome.status != SWEEP_DONE:
                message += "; there are no feedback gains, they are zero"
                return self._collect(progress, reason, message, np.zeros_like(work.update.gains))
            if proposal.damping == 0.0 and proposal.exact == progress.schedule.has_exact:
                progress.optimality = self._promise(progress, proposal.outcome)
            if progress.optimality <= self.tolerance and reason is not StopReason.INTERRUPTED:
                reason, message = StopReason.CONVERGED, "no step promises to lower the cost"
        message += f"; an undamped step promises a relative decrease of {progress.optimality:.1e}"
        return self._collect(progress, reason, message, work.update.gains.copy())

    def _final_update(self, progress: _Progress) -> _Proposal:
        """Sweep without damping, with exact second derivatives if that succeeds."""
        if progress.schedule.has_exact:
            self._work.differentiate_twice()
            outcome = self._work.sweep(0.0, exact=True)
            if outcome.status == SWEEP_DONE:
                return _Proposal(True, 0.0, outcome)
        return self._find_update(Regularization(0.0), exact=False)

    def _collect(self, progress: _Progress, reason: StopReason, message: str, gains: FloatArray) -> Solution:
        """Copy the current trajectory into a solution."""
        current = self._work.current
        return Solution(
            states=current.states.copy(),
            controls=current.controls.copy(),
            feedback_gains=gains,
            cost=current.cost,
            stop_reason=reason,
            message=message,
            optimality=progress.optimality,
            iterations=len(progress.records),
            history=np.array(progress.records, dtype=HISTORY_DTYPE),
            problem=self.problem,
        )

    def _check_start(self, x0: FloatArray | None, u_init: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return the initial state and the first controls, or say what is wrong with them."""
        problem = self.problem
        lower, upper = np.asarray(problem.control_lower), np.asarray(problem.control_upper)
        state = np.asarray(problem.initial_state if x0 is None else x0, dtype=np.float64)
        check_array("x0", state, (problem.n_states,))
        shape = (problem.horizon, problem.n_controls)
        if u_init is None:
            return state, np.broadcast_to(np.clip(0.0, lower, upper), shape)
        controls = np.asarray(u_init, dtype=np.float64)
        check_array("u_init", controls, shape)
        outside = (controls < lower) | (controls > upper)
        if np.any(outside):
            k, i = (int(index[0]) for index in np.nonzero(outside))
            raise ValueError(
                f"u_init[{k}, {i}] is {controls[k, i]}, outside [{lower[i]}, {upper[i]}], the bounds of "
                f"input {i}; clip the guess to the bounds first"
            )
        return state, controls

    def _check_control_weights(self) -> None:
        """Raise ValueError if an input has no cost of its own: the damping is scaled by it."""
        weights = np.diagonal(self._work.derivatives.luu, axis1=1, axis2=2)
        free = weights <= 0.0
        if np.any(free):
            k, i = (int(index[0]) for index in np.nonzero(free))
            raise ValueError(
                f"the cost has the second derivative {weights[k, i]} with respect to input {i} at stage {k}; "
                "every input needs a positive weight"
            )


def _scale(cost: float, progress: _Progress) -> float:
    """A cost to relate changes to: positive however small the cost is."""
    return max(abs(cost), progress.cost_floor, float(np.finfo(np.float64).tiny))
