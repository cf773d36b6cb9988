"""Box-DDP: optimal control of a shooting problem with bounds on the controls.

Control-limited differential dynamic programming of Tassa, Mansard & Todorov (ICRA 2014), with the
Gauss-Newton model of the dynamics (iLQR), exact second derivatives (Newton's method), or a hybrid of the two
(`models`). An iteration differentiates along the trajectory, sweeps backward for a control update and its
gains, and rolls the update out with shorter and shorter steps until one lowers the cost as promised. Given a
guess of the states, a solve begins by multiple shooting (`multiple_shooting`).

**When it has converged.** The measure is the decrease of the cost that a full, undamped step promises,
relative to the cost. It does not change with the units of states, controls or cost, it accounts for the
bounds, and it is zero exactly at a point that satisfies the first-order conditions. A promise below what a
rounding of the states is worth counts as zero: at the target, cost and gradient are nothing but rounding
errors. A small decrease of the cost is no such sign: damping or a plateau of a curved problem make steps
small far from any minimum. Where there are exact second derivatives the step is Newton's, which exists only
if they are positive definite: a saddle does not pass, nor does a valley whose floor Gauss-Newton takes for
steeper than it is.
"""

from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from experts.backward_sweep import (
    SWEEP_DONE,
    SWEEP_NOT_FINITE,
    SWEEP_NOT_POSITIVE_DEFINITE,
    SweepOutcome,
)
from experts.checks import check_array, check_at_least, check_control_weights
from experts.line_search import line_search
from experts.models import EXACT_DAMPING, ModelSchedule, SecondOrder
from experts.multiple_shooting import MultipleShooting
from experts.problem import FloatArray, ShootingProblem, as_problem
from experts.progress import Callback, Progress, Stop
from experts.regularization import Regularization
from experts.rollout import FINISHED
from experts.shooting import ShootingWorkspace, WorkTime
from experts.solution import HISTORY_DTYPE, IterationRecord, Solution, StopReason


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
        self._shooting: MultipleShooting | None = None

    def solve(
        self,
        x0: FloatArray | None = None,
        u_init: FloatArray | None = None,
        callback: Callback | None = None,
        *,
        x_init: FloatArray | None = None,
    ) -> Solution:
        """Minimize the cost, starting from a guess of the controls, or of controls and states.

        Args:
            x0: State at stage 0, shape (n_x,); the problem's initial state if None.
            u_init: First guess of the controls, within the bounds, shape (N, n_u); if None zeros, or the
                bound next to zero where zero is not allowed.
            callback: Called with the record of every iteration; it may raise KeyboardInterrupt to end the
                solve.
            x_init: First guess of the states, shape (N + 1, n_x); the dynamics need not lead from one to the
                next, nor need it begin at x0. The solve then begins by multiple shooting, see
                `multiple_shooting`. None takes the rollout of the controls.

        Returns:
            The best trajectory found, whatever the reason to stop; always a rollout of its controls from x0.

        Raises:
            ValueError: If x0, u_init or x_init have the wrong shape, are not finite or out of bounds, an
                input has no cost of its own, or states are given and the problem has no retraction.
        """
        initial_state, controls = self._check_start(x0, u_init)
        work, stop = self._work, None
        schedule = ModelSchedule(self.second_order, Regularization(self.initial_regularization))
        progress = Progress(schedule)
        if x_init is None:
            work.start(initial_state, controls)
        else:
            shooting = self._multiple_shooting()
            start = initial_state, shooting.check(x_init), controls
            stop = shooting.close_gaps(start, progress, self.max_iterations, callback)
        progress.first_cost = work.current.cost
        if work.current.failing_stage != FINISHED:
            message = f"the first rollout is not finite from stage {work.current.failing_stage} on"
            return self._collect(progress, StopReason.DIVERGED, message, np.zeros_like(work.update.gains))
        try:
            stop = stop or self._iterate(progress, callback)
        except KeyboardInterrupt:
            stop = Stop(StopReason.INTERRUPTED, "interrupted by the user")
        return self._finish(progress, stop)

    def _multiple_shooting(self) -> MultipleShooting:
        """What closes gaps, made when it is first needed."""
        if not self.problem.has_retraction:
            raise ValueError(
                "x_init is given, but the problem has no retraction to move states with; leave x_init out"
            )
        if self._shooting is None:
            self._shooting = MultipleShooting(self._work)
        return self._shooting

    def _iterate(self, progress: Progress, callback: Callback | None) -> Stop:
        """Iterate until there is a reason to stop."""
        work = self._work
        moved = True
        while True:
            started = perf_counter()
            work.time = WorkTime()
            if moved:
                work.differentiate()
            if not progress.records:
                check_control_weights(work.derivatives.luu)
            result = self._take_step(progress, started)
            if isinstance(result, Stop):
                return result
            if callback is not None:
                callback(result)
            moved = result.alpha > 0.0
            stop = self._stop_after_step(progress)
            if stop is not None:
                return stop

    def _take_step(self, progress: Progress, started: float) -> IterationRecord | Stop:
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

    def _stop_before_step(self, progress: Progress, proposal: _Proposal) -> Stop | None:
        """Judge a sweep: has it failed, is the trajectory optimal, may another iteration begin?"""
        outcome = proposal.outcome
        if outcome.status == SWEEP_NOT_FINITE:
            return Stop(StopReason.DIVERGED, f"the derivatives are not finite at stage {outcome.stage}")
        if outcome.status != SWEEP_DONE:
            return Stop(
                StopReason.REGULARIZATION_LIMIT,
                f"the model of the cost at stage {outcome.stage} is not convex, however strong the damping",
            )
        if self._promise(progress, outcome) <= self.tolerance and self._is_optimal(progress, proposal):
            return Stop(StopReason.CONVERGED, "no step promises to lower the cost")
        return progress.iteration_limit(self.max_iterations)

    def _is_optimal(self, progress: Progress, proposal: _Proposal) -> bool:
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

    def _promise(self, progress: Progress, outcome: SweepOutcome) -> float:
        """Relate the decrease that the full step promises to the cost; one that rounding hides is none."""
        promised = outcome.promise(1.0)
        if promised <= self._work.cost_rounding():
            return 0.0
        return promised / progress.scale(self._work.current.cost)

    def _record(
        self, progress: Progress, proposal: _Proposal, cost: float, alpha: float, started: float
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
            optimality=promised / progress.scale(cost),
            clamped_share=outcome.clamped / work.current.controls.size,
            seconds=perf_counter() - started,
            derivative_seconds=work.time.derivatives,
            sweep_seconds=work.time.sweep,
            rollout_seconds=work.time.rollout,
            gap=0.0,
        )
        progress.records.append(record)
        progress.schedule.observe(record, cost)
        idle = cost - record.cost < self.plateau_decrease * abs(record.cost)
        progress.idle_iterations = progress.idle_iterations + 1 if idle else 0
        return record

    def _stop_after_step(self, progress: Progress) -> Stop | None:
        """Judge the progress: is there a step left to try, has the cost stayed where it is?"""
        if progress.schedule.regularization.exhausted and progress.records[-1].alpha == 0.0:
            return Stop(
                StopReason.REGULARIZATION_LIMIT, "no step lowers the cost, however strong the damping"
            )
        if progress.idle_iterations >= self.plateau_iterations:
            return Stop(
                StopReason.PLATEAU,
                f"{self.plateau_iterations} iterations in a row lowered the cost by less than "
                f"{self.plateau_decrease:.0e} of its value",
            )
        return None

    def _finish(self, progress: Progress, stop: Stop) -> Solution:
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
        if np.isfinite(progress.optimality):
            message += f"; an undamped step promises a relative decrease of {progress.optimality:.1e}"
        return self._collect(progress, reason, message, work.update.gains.copy())

    def _final_update(self, progress: Progress) -> _Proposal:
        """Sweep without damping, with exact second derivatives if that succeeds."""
        if progress.schedule.has_exact:
            self._work.differentiate_twice()
            outcome = self._work.sweep(0.0, exact=True)
            if outcome.status == SWEEP_DONE:
                return _Proposal(True, 0.0, outcome)
        return self._find_update(Regularization(0.0), exact=False)

    def _collect(self, progress: Progress, reason: StopReason, message: str, gains: FloatArray) -> Solution:
        """Copy the current trajectory into a solution."""
        current = self._work.current
        return Solution(
            states=current.states.copy(),
            controls=current.controls.copy(),
            feedback_gains=gains,
            cost=current.cost,
            stop_reason=reason,
            message=message + progress.note,
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
