"""Box-DDP: optimal control of a shooting problem with bounds on the controls.

Control-limited differential dynamic programming of Tassa, Mansard & Todorov (ICRA 2014), with Gauss-Newton's
model of the dynamics (iLQR), exact second derivatives (Newton's method), or a hybrid of the two
(`second_order`). An iteration differentiates along the trajectory, runs a backward pass for a control update
and its gains, and a forward pass that searches along the update for a step that reduces the cost as
predicted. Given a guess of the states, a solve begins by multiple shooting (`multiple_shooting`). Constraints
become penalties, whose multipliers follow the steps (`multiplier_method`).

**Convergence** is measured by the reduction of the cost that the model predicts for a full, unregularized
step, relative to the cost. It does not depend on the units of states, controls or cost, it accounts for the
bounds, and it vanishes exactly where the first-order conditions hold. A predicted reduction below the value
of a rounding of the states counts as zero: at the target, cost and gradient are nothing but rounding errors.
A small achieved reduction is no evidence of convergence: regularization, or a plateau of a curved problem,
makes steps small far from any minimum. Where there are exact second derivatives the step is Newton's, which
exists only if they are positive definite: neither a saddle nor a valley whose curvature Gauss-Newton
overestimates counts as converged.
"""

from dataclasses import replace
from time import perf_counter
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.common.real_arrays import real_array
from experts.ddp.backward_pass import PASS_NOT_FINITE, PassResult
from experts.ddp.directions import Directions
from experts.ddp.multiple_shooting import MultipleShooting
from experts.ddp.multiplier_method import MultiplierMethod
from experts.ddp.rollout import FINISHED
from experts.ddp.second_order import Regularization, SecondOrder, SolverState
from experts.ddp.shooting import ShootingWorkspace, WorkTime, line_search
from experts.ddp.solution import HISTORY_DTYPE, Callback, IterationRecord, Solution, Stop, StopReason
from experts.problems.arm_problem import as_problem
from experts.problems.shooting_problem import (
    FloatArray,
    ShootingProblem,
    check_array,
    check_at_least,
    check_control_weights,
    check_state,
    check_whole,
    rate_limits,
    stage_bounds,
)
from experts.problems.stage_constraints import StageConstraints

CONVERGED = "no step is predicted to reduce the cost"


class BoxDDP:
    """Box-DDP for one problem. It works in arrays of its own and of the problem: give each thread both."""

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
            scene_or_problem: A scene, a `CasadiProblem` or `PythonProblem` of your own, or another
                `ShootingProblem`.
            max_iterations: Most iterations of a solve.
            tolerance: Predicted reduction of an unregularized step, relative to the cost, below which the
                solve has converged.
            plateau_decrease: Reduction of the cost, relative to it, below which an iteration is idle.
            plateau_iterations: Consecutive idle iterations that end the solve.
            initial_regularization: First mu, in multiples of the control weights. Small values let the first
                steps go so far that the solve may end in a poor minimum.
            second_order: Second derivatives to use: "gauss_newton", "exact", "hybrid" or "mirrored". None
                takes the hybrid if the problem has exact ones, else Gauss-Newton's.
            threads: Most threads that compute derivatives. More than one pays only where a core is idle.

        Raises:
            TypeError: If scene_or_problem is neither a scene nor a problem.
            ValueError: If a setting is out of range or no whole number, second_order is unknown or asks for
                derivatives that the problem does not have, or the problem contradicts itself.
        """
        check_whole("max_iterations", max_iterations, 0)
        check_at_least("tolerance", tolerance, 0.0)
        check_at_least("plateau_decrease", plateau_decrease, 0.0)
        check_whole("plateau_iterations", plateau_iterations, 1)
        check_at_least("initial_regularization", initial_regularization, 0.0)
        check_whole("threads", threads, 1)
        self.problem: ShootingProblem = as_problem(scene_or_problem)
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.plateau_decrease = plateau_decrease
        self.plateau_iterations = plateau_iterations
        self.initial_regularization = initial_regularization
        self.second_order = SecondOrder.of(second_order, self.problem.has_second_order)
        has_exact = self.second_order is not SecondOrder.GAUSS_NEWTON
        self._work = ShootingWorkspace(self.problem, has_exact, threads=threads)
        self._directions = Directions(self._work, self.second_order)
        constraints: StageConstraints | None = getattr(self.problem, "constraints", None)
        self._constrained: MultiplierMethod | None = None
        if constraints is not None:
            self._constrained = MultiplierMethod(self._work, constraints, self._directions)
        self._shooting: MultipleShooting | None = None

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a BoxDDP cannot be copied or pickled, its machine code and work arrays are its own: make "
            "another one of the same scene or problem"
        )

    def solve(
        self,
        x0: FloatArray | None = None,
        u_init: FloatArray | None = None,
        callback: Callback | None = None,
        *,
        x_init: FloatArray | None = None,
        parameters: ArrayLike | None = None,
        multipliers: FloatArray | None = None,
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
            parameters: What varies in the problem, the same for all stages, shape (n_p,), or a row for each
                stage and the end, (N + 1, n_p), entries as in `kernels.parameters`; None for nominal ones.
                Nothing is compiled when they change.
            multipliers: Those of a similar maneuver with the same constraints, shape (N + 1, m), as in
                `Solution.multipliers`; the constraints then count from the first step on, also with zeros.
                None begins without them.

        Returns:
            The best trajectory found, whatever the reason to stop; always a rollout of its controls from x0.
            Under constraints the last one: costs and violations of others do not compare.
            Its cost is without penalties.

        Raises:
            TypeError: If one of these arrays is masked or not of real numbers.
            ValueError: If x0, u_init, x_init, parameters or multipliers have the wrong shape, are not finite
                or out of bounds, an input has no cost of its own, or states are given and the problem has no
                retraction.
        """
        self.problem.parameters.set(parameters)
        initial_state, controls = self._check_start(x0, u_init)
        self._begin_multipliers(multipliers)
        state = SolverState(Regularization(self.initial_regularization))
        if multipliers is not None:
            state.switch.request_exact()
        try:
            return self._solve_from(state, initial_state, controls, x_init, callback)
        finally:  # other solvers of the problem, and rollouts, would count what an error left behind
            self._begin_multipliers(None)

    def _solve_from(
        self,
        state: SolverState,
        initial_state: FloatArray,
        controls: FloatArray,
        x_init: FloatArray | None,
        callback: Callback | None,
    ) -> Solution:
        """Iterate from a checked guess."""
        work, stop = self._work, None
        if x_init is None:
            work.start(initial_state, controls)
        else:
            shooting = self._multiple_shooting()
            guess = initial_state, shooting.check(x_init), controls
            stop = shooting.close_gaps(guess, state, self.max_iterations, callback)
        if work.current.failing_stage != FINISHED:
            failing, reached = work.current.failing_stage, work.current.states
            culprit = "the terminal cost"
            if failing < len(reached) - 1:
                culprit = "the stage cost" if np.isfinite(reached[failing + 1]).all() else "the step"
            message = f"the first rollout is not finite from stage {failing} on: {culprit} is not"
            reached[failing + 1 :] = np.nan  # or an earlier solve's
            return self._solution(state, Stop(StopReason.DIVERGED, message), np.zeros_like(work.update.K))
        state.moved = True
        try:
            while stop is None:
                stop = self._iterate(state, callback)
        except KeyboardInterrupt:
            stop = Stop(StopReason.INTERRUPTED, "interrupted by the user")
        return self._finish(state, stop)

    def _begin_multipliers(self, multipliers: FloatArray | None) -> None:
        """Begin with the multipliers of a similar maneuver, or without the constraints."""
        if self._constrained is not None:
            self._constrained.lagrangian.leave_out()
        if multipliers is None:
            return
        if self._constrained is None:
            raise ValueError("multipliers are given, but the problem has no constraints; leave them out")
        lagrangian = self._constrained.lagrangian
        given = real_array("multipliers", multipliers, np.float64)
        check_array("multipliers", given, lagrangian.constraints.multipliers.shape)
        if given.any():
            lagrangian.begin_with(given)
        else:
            lagrangian.begin()

    def _iterate(self, state: SolverState, callback: Callback | None) -> Stop | None:
        """Run one iteration; return why the solve ends, or None to continue."""
        work, started = self._work, perf_counter()
        work.time = WorkTime()
        if state.moved:
            work.differentiate()
        if not state.records:
            check_control_weights(work.derivatives.luu)
        cost, alpha = work.current.cost, 0.0
        constrained = self._constrained
        is_stiff = constrained is not None and constrained.lagrangian.is_stiff
        for direction in self._directions.tried(state, is_stiff=is_stiff):
            stop = self._stopping_criteria(state, direction)
            if stop is not None:
                if constrained is None or not constrained.is_unfinished(state, stop):
                    return stop
                if limit := state.iteration_limit(self.max_iterations):
                    return limit
            alpha = line_search(work, direction)
            if alpha > 0.0 or stop is not None:
                break
        self._directions.adapt(state, direction, alpha)
        state.moved = alpha > 0.0
        record = self._record(state, direction, cost, alpha, started)
        if callback is not None:
            callback(record)
        if constrained is not None:
            if stop is not None and constrained.is_met:
                return None if state.moved else stop
            if stop is not None or constrained.is_near(record):
                return constrained.follow(state)
        return self._no_progress(state, record)

    def _stopping_criteria(self, state: SolverState, direction: PassResult) -> Stop | None:
        """Judge a backward pass: has it failed, is the trajectory optimal, may a step follow?"""
        if direction.status == PASS_NOT_FINITE:
            return Stop(StopReason.DIVERGED, f"the derivatives are not finite at stage {direction.stage}")
        if not direction.completed:
            return Stop(
                StopReason.REGULARIZATION_LIMIT,
                f"the model at stage {direction.stage} is not convex at the largest regularization",
            )
        if self._relative_reduction(direction) <= self.tolerance and self._is_optimal(state, direction):
            return Stop(StopReason.CONVERGED, CONVERGED)
        return state.iteration_limit(self.max_iterations)

    def _is_optimal(self, state: SolverState, direction: PassResult) -> bool:
        """Judge by an unregularized step, with exact second derivatives if there are any.

        Its update is kept if the trajectory is optimal.
        """
        if self._directions.has_exact:
            state.switch.request_exact()
            self._work.differentiate_twice()
        if direction.mu > 0.0 or direction.exact != self._directions.has_exact:
            direction = self._work.backward_pass(0.0, exact=self._directions.has_exact)
            if not direction.completed:
                return False
        state.optimality = self._relative_reduction(direction)
        if state.optimality <= self.tolerance:
            return True
        self._work.restore_update()
        return False

    def _relative_reduction(self, direction: PassResult) -> float:
        """Relate the predicted reduction of the full step to the cost; zero if rounding hides it."""
        reduction = direction.predicted_reduction(1.0)
        if reduction <= self._work.cost_rounding():
            return 0.0
        return _relative(reduction, self._work.current.cost)

    def _record(
        self, state: SolverState, direction: PassResult, cost: float, alpha: float, started: float
    ) -> IterationRecord:
        """Record an iteration that began at a cost."""
        work, reduction = self._work, direction.predicted_reduction(1.0)
        record = IterationRecord(
            iteration=len(state.records) + 1,
            cost=work.current.cost,
            alpha=alpha,
            exact=direction.exact,
            regularization=direction.mu,
            expected_decrease=reduction,
            optimality=_relative(reduction, cost),
            clamped_share=direction.clamped / work.current.controls.size,
            seconds=perf_counter() - started,
            derivative_seconds=work.time.derivatives,
            sweep_seconds=work.time.backward_pass,
            rollout_seconds=work.time.rollout,
            gap=0.0,
        )
        state.records.append(record)
        state.switch.observe(record, cost)
        idle = cost - record.cost < self.plateau_decrease * abs(record.cost)
        state.idle_iterations = state.idle_iterations + 1 if idle else 0
        return record

    def _no_progress(self, state: SolverState, record: IterationRecord) -> Stop | None:
        """Stop where no step is left to try, or where the cost no longer falls."""
        if state.regularization.exhausted and record.alpha == 0.0:
            return Stop(
                StopReason.REGULARIZATION_LIMIT, "no step reduces the cost at the largest regularization"
            )
        if state.idle_iterations >= self.plateau_iterations:
            return Stop(
                StopReason.PLATEAU,
                f"{self.plateau_iterations} consecutive iterations reduced the cost by less than "
                f"{self.plateau_decrease:.0e} of its value",
            )
        return None

    def _finish(self, state: SolverState, stop: Stop) -> Solution:
        """Compute the gains around the final trajectory, and judge it without regularization."""
        work, (reason, message) = self._work, stop
        if self._constrained is not None:
            if reason is not StopReason.CONVERGED:
                state.optimality = np.inf  # it may be that of an earlier trajectory
            found = self._constrained.finish(stop)
            solution = self._solution(state, found.stop, found.gains)
            return replace(solution, multipliers=found.multipliers, constraints=found.report)
        if reason is not StopReason.CONVERGED:
            state.optimality = np.inf
            work.differentiate()
            direction = self._directions.final()
            if not direction.completed:
                message += "; there are no feedback gains, they are zero"
                return self._solution(state, Stop(reason, message), np.zeros_like(work.update.K))
            if direction.mu == 0.0 and direction.exact == self._directions.has_exact:
                state.optimality = self._relative_reduction(direction)
            if state.optimality <= self.tolerance and reason is not StopReason.INTERRUPTED:
                reason, message = StopReason.CONVERGED, CONVERGED
        if np.isfinite(state.optimality):
            message += f"; an unregularized step predicts a relative reduction of {state.optimality:.1e}"
        return self._solution(state, Stop(reason, message), work.update.K.copy())

    def _solution(self, state: SolverState, stop: Stop, gains: FloatArray) -> Solution:
        """Copy the current trajectory into a solution."""
        current = self._work.current
        return Solution(
            states=current.states.copy(),
            controls=current.controls.copy(),
            feedback_gains=gains,
            cost=current.cost,
            stop_reason=stop.reason,
            message=stop.message + state.note,
            optimality=state.optimality,
            iterations=len(state.records),
            history=np.array(state.records, dtype=HISTORY_DTYPE),
            parameters=self.problem.parameters.rows.copy(),
            problem=self.problem,
        )

    def _multiple_shooting(self) -> MultipleShooting:
        if not self.problem.has_retraction:
            raise ValueError(
                "x_init is given, but the problem has no retraction to move states with; leave x_init out"
            )
        if self._shooting is None:
            self._shooting = MultipleShooting(self._work)
        return self._shooting

    def _check_start(self, x0: FloatArray | None, u_init: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return the initial state and the first controls, or say what is wrong with them."""
        problem = self.problem
        lower, upper = stage_bounds(problem)
        state = real_array("x0", problem.initial_state if x0 is None else x0, np.float64)
        check_array("x0", state, (problem.n_states,))
        if x0 is not None:
            check_state(problem, "x0", state)
        shape = (problem.horizon, problem.n_controls)
        if u_init is None:
            return state, np.clip(0.0, lower, upper)
        controls = real_array("u_init", u_init, np.float64)
        check_array("u_init", controls, shape)
        outside = (controls < lower) | (controls > upper)
        limits = rate_limits(problem)
        which, before = limits.controls, np.vstack([state[limits.states], controls[:-1, limits.controls]])
        nearest = np.clip(controls[:, which], lower[:, which], upper[:, which])
        nearest = np.clip(nearest, before - limits.change, before + limits.change)
        outside[:, which] &= controls[:, which] != nearest  # a rate may keep it from bounds that come closer
        if np.any(outside):
            k, i = (int(index[0]) for index in np.nonzero(outside))
            raise ValueError(
                f"u_init[{k}, {i}] is {controls[k, i]}, outside [{lower[k, i]}, {upper[k, i]}], the bounds "
                f"of input {i}; clip the guess to the bounds first"
            )
        return state, controls


def _relative(reduction: float, cost: float) -> float:
    """Relate a reduction to a cost, however small."""
    return reduction / max(abs(cost), float(np.finfo(np.float64).tiny))
