"""Multiple shooting: a solve that begins with a guess of the states, which the dynamics need not follow.

**Gaps.** Such a trajectory has gaps: f = x0 (-) x_0 before the first stage, and after stage k
f_k = step(x_k, u_k) (-) x_k+1. As in feasibility-driven DDP (Mastalli et al., ICRA 2020; with bounds:
Mastalli et al., Autonomous Robots 2022) the sweep plans to close them, from derivatives along the guess, and
a step of length alpha leaves the share 1 - alpha of every gap: x_k+1 = step(x_k, u_k) (+) -(1 - alpha) f_k.
A full step is thus a rollout, with feedback that keeps to the guess and all controls inside their bounds;
single shooting goes on from there.

**Which tangent space.** f_k belongs to x_k+1, and is applied to the state where the step of the trial lands,
in its own body axes. On poses nothing is lost by that: moving along one twist is a one-parameter group, so
the new gap is (1 - alpha) f_k to the last digit. The model, though, is of first order in the gaps: strictly,
A and B give increments where the step lands, and a gap with the rotation r turns these by about r / 2 on
the way to x_k+1. This is left out, as elsewhere: it makes the direction a little worse while gaps
between stages are large, never the result. The gap before the first stage is exempt, for no derivative
passes it; so a trajectory solved for another start, however far, is best given as it is.

**Acceptance.** The cost of a trajectory with gaps may be lower than any true one, so steps must be allowed to
raise it. As all gaps shrink alike, one number measures them, the share s that is left of the first ones, and
the merit is cost + weight * s. A step of length alpha promises to lower it by
alpha (weight s - L - alpha Q), where L + Q is the change that the quadratic model of the cost predicts for
the full step; L is its exact derivative. The weight never falls and is raised to 2 (L + max(Q, 0)) / s where
it is below, so that the promise is positive: a rise of the cost by up to twice the predicted one is accepted,
as in Mastalli's rule. Every accepted step lowers s for good: the gaps cannot open again, and what closing
them may cost is granted once.

**If they cannot be closed** in `MOST_ITERATIONS`, or no step is accepted under the strongest damping, or a
sweep fails, or the solve ends before, then the trajectory is replaced with a rollout: the cheapest of the
controls alone and of the feedback that keeps to the guess, with and without the update's corrections. A guess
at which the dynamics are not finite is replaced with the rollout of its controls. The message says so.
"""

from time import perf_counter

import numpy as np

from experts.backward_sweep import SWEEP_DONE
from experts.checks import check_array, check_control_weights
from experts.gaps import change_of_cost
from experts.line_search import ACCEPTANCE, STEP_LENGTHS
from experts.native_call import buffer_table, run_kernel
from experts.problem import KERNEL_NAMES, RETRACTION_KERNEL_NAME, FloatArray
from experts.progress import Callback, Progress, Stop
from experts.regularization import SHORT_STEP
from experts.rollout import FINISHED
from experts.shooting import ShootingWorkspace, WorkTime, timed
from experts.solution import IterationRecord, StopReason

MOST_ITERATIONS = 50
"""After as many iterations gaps that are still open are closed by a rollout."""
DAMPING = (0.0, 1e0, 1e2, 1e4, 1e6)
"""Weights of the damping while gaps are open, in multiples of the control weights: the next one after a short
step or none, the one before after a long step."""
LONG_STEP = 0.5
"""Accepted step length from which on a step is long; a short one is shorter than `SHORT_STEP`."""
NEGLIGIBLE_GAP = 1e-10
"""A guess with smaller gaps is one without."""
MODEL_SHARE = 0.5
"""Share of the weight that is more than the predicted change of the cost asks for."""
LARGEST_PROJECTION = 1e-3
"""How far entries of a guessed state may be off the manifold of states, such as the unit quaternions."""


class MultipleShooting:
    """Closes the gaps of a guess, in the workspace of a solver.

    Attributes:
        work: The workspace; its current trajectory is the one with gaps.
        gaps: f_k, shape (N, n_t).
        initial_gap: x0 (-) x_0, shape (1, n_t).
        share: Share of the first gaps that is left, in [0, 1].
        weight: Weight of the share in the merit, in the unit of the cost.
        largest: Largest norm of the first gaps.
    """

    def __init__(self, work: ShootingWorkspace) -> None:
        """Allocate arrays, and get the retraction.

        Args:
            work: Workspace of a problem that has a retraction.
        """
        problem = work.problem
        horizon, n_tangent = problem.horizon, problem.n_tangent
        self.work = work
        self.share, self.weight, self.largest = 0.0, 0.0, 0.0
        self.gaps = np.zeros((horizon, n_tangent))
        self.initial_gap = np.zeros((1, n_tangent))
        self._kernels = {name: problem.kernel(name) for name in (*KERNEL_NAMES, RETRACTION_KERNEL_NAME)}
        self._time_step = np.array([problem.time_step])
        self._initial_state = np.zeros((1, problem.n_states))
        self._landings = np.zeros((horizon, problem.n_states))
        self._rows = np.zeros(n_tangent), np.zeros(n_tangent), np.zeros(problem.n_controls)

    @property
    def time(self) -> WorkTime:
        """Where the time of the workspace goes."""
        return self.work.time

    @property
    def is_open(self) -> bool:
        """Whether the current trajectory has gaps."""
        return self.share > 0.0

    @property
    def is_finite(self) -> bool:
        """Whether cost and gaps of the current trajectory are finite."""
        return bool(np.isfinite(self.work.current.cost + self.largest_gap))

    @property
    def largest_gap(self) -> float:
        """Largest norm of a gap of the current trajectory, in tangent coordinates."""
        return self.share * self.largest

    def check(self, x_init: FloatArray) -> FloatArray:
        """Put a guess of the states exactly on the manifold of states.

        Args:
            x_init: Shape (N + 1, n_x).

        Returns:
            The guess without rounding errors.

        Raises:
            ValueError: If it has another shape, is not finite or is far from the manifold.
        """
        problem = self.work.problem
        given = np.ascontiguousarray(x_init, dtype=np.float64)
        check_array("x_init", given, (problem.horizon + 1, problem.n_states))
        states, still = given, np.zeros((len(given), problem.n_tangent))
        for _ in range(3):  # each time the error is squared
            result = np.zeros_like(states)
            self._run(RETRACTION_KERNEL_NAME, len(states), states, still, result)
            states = result
        # Not <=: a state that cannot be moved onto the manifold is not a number.
        off = ~(np.abs(states - given) <= LARGEST_PROJECTION)
        if off.any():
            k, i = (int(index[0]) for index in np.nonzero(off))
            raise ValueError(
                f"x_init[{k}] is no state: its entry {i}, {given[k, i]}, is off the valid ones by more than "
                f"{LARGEST_PROJECTION}; a pose must be a unit dual quaternion"
            )
        return states

    def close_gaps(
        self,
        start: tuple[FloatArray, FloatArray, FloatArray],
        progress: Progress,
        max_iterations: int,
        callback: Callback | None,
    ) -> Stop | None:
        """Make the current trajectory of the workspace one without gaps that a guess leads to.

        Args:
            start: Initial state, shape (n_x,), and guess of states, shape (N + 1, n_x), and controls within
                the bounds, shape (N, n_u).
            progress: Receives the records, and a note if it took a rollout to close the gaps.
            max_iterations: Largest number of iterations.
            callback: Called with the record of every iteration.

        Returns:
            Why the solve ends already, None if it goes on. Either way the trajectory has no gaps; its
            `failing_stage` tells whether it is finite.
        """
        self.begin(*start)
        try:
            stop = self._iterate(progress, max_iterations, callback)
        except KeyboardInterrupt:
            stop = Stop(StopReason.INTERRUPTED, "interrupted by the user")
        if not self.is_finite:
            progress.note = "; the dynamics are not finite at the guessed states: only controls were used"
            self._roll_out([])
        elif self.largest_gap > NEGLIGIBLE_GAP:
            progress.note = f"; no step closed the last gaps, of up to {self.largest_gap:.1e}: a rollout did"
            self._roll_out(self._feedback_rollouts())
        elif self.is_open:
            self._roll_out([])
        return stop

    def begin(self, initial_state: FloatArray, states: FloatArray, controls: FloatArray) -> None:
        """Take a guess for the current trajectory, and find its gaps and cost.

        Args:
            initial_state: State at stage 0, shape (n_x,).
            states: Shape (N + 1, n_x).
            controls: Within the bounds, shape (N, n_u).
        """
        current = self.work.current
        horizon = len(self.gaps)
        self._initial_state[0], current.states[:], current.controls[:] = initial_state, states, controls
        self._run("difference", 1, current.states, self._initial_state, self.initial_gap)
        steps = current.states, current.controls, self._time_step, self._landings, current.stage_costs
        self._run("step_with_cost", horizon, *steps)
        self._run("difference", horizon, current.states[1:], self._landings, self.gaps)
        end = current.states[-1:], *self.work.problem.terminal_inputs
        self._run("terminal_cost", 1, *end, current.terminal_cost)
        current.cost = float(current.stage_costs.sum() + current.terminal_cost[0])
        current.failing_stage = FINISHED
        norms = np.linalg.norm(np.vstack([self.initial_gap, self.gaps]), axis=1)
        self.share, self.weight, self.largest = 1.0, 0.0, float(norms.max())

    def _iterate(self, progress: Progress, max_iterations: int, callback: Callback | None) -> Stop | None:
        """Take steps until the gaps are closed or there is no hope of that."""
        work = self.work
        level, moved = 0, True
        while self.is_finite and self.largest_gap > NEGLIGIBLE_GAP:
            stop = progress.iteration_limit(max_iterations)
            if stop is not None:
                return stop
            started = perf_counter()
            work.time = WorkTime()
            if moved:
                work.differentiate()
            if not progress.records:
                check_control_weights(work.derivatives.luu)
            outcome = work.sweep(DAMPING[level], gaps=self.gaps)
            if outcome.status != SWEEP_DONE:
                break
            linear, quadratic = self.change_of_cost()
            alpha = self.line_search(linear, quadratic)
            record = IterationRecord(
                iteration=len(progress.records) + 1,
                cost=work.current.cost,
                alpha=alpha,
                exact=False,
                regularization=DAMPING[level],
                expected_decrease=-(linear + quadratic),
                optimality=np.inf,
                clamped_share=outcome.clamped / work.current.controls.size,
                seconds=perf_counter() - started,
                derivative_seconds=work.time.derivatives,
                sweep_seconds=work.time.sweep,
                rollout_seconds=work.time.rollout,
                gap=self.largest_gap,
            )
            progress.records.append(record)
            if callback is not None:
                callback(record)
            moved = alpha > 0.0
            if record.iteration == MOST_ITERATIONS or (not moved and level == len(DAMPING) - 1):
                break
            level = _next_level(level, alpha)
        return None

    @timed("rollout")
    def change_of_cost(self) -> tuple[float, float]:
        """Predict how the last update changes the cost of the current trajectory.

        Returns:
            L, per step length, and Q, per squared step length, in the unit of the cost.
        """
        linear, quadratic = change_of_cost(
            self.work.derivatives, self.work.update, self.initial_gap[0], self.gaps, *self._rows
        )
        return float(linear), float(quadratic)

    def line_search(self, linear: float, quadratic: float) -> float:
        """Move to the first trial that achieves enough of its promise.

        Args:
            linear: L of `change_of_cost`.
            quadratic: Q of `change_of_cost`.

        Returns:
            Length of the accepted step, in (0, 1]; 0 if there was none, and the trajectory stays as it is.
        """
        enough = (linear + max(quadratic, 0.0)) / ((1.0 - MODEL_SHARE) * self.share)
        self.weight = max(self.weight, enough)
        cost = self.work.current.cost
        for alpha in STEP_LENGTHS:
            promised = alpha * (self.weight * self.share - linear - alpha * quadratic)
            achieved = cost - self.try_step(alpha) + self.weight * alpha * self.share
            if achieved >= ACCEPTANCE * promised:
                self.accept(float(alpha))
                return float(alpha)
        return 0.0

    def try_step(self, alpha: float) -> float:
        """Roll out the update into the trial trajectory, with the share 1 - alpha of the gaps.

        Args:
            alpha: Step length, in [0, 1].

        Returns:
            Cost of the trial, inf if it is not finite.
        """
        work = self.work
        if alpha == 1.0:
            work.trial.states[0] = self._initial_state[0]
            return work.try_step(1.0)
        return self._roll_out_with_gaps(alpha)

    @timed("rollout")
    def _roll_out_with_gaps(self, alpha: float) -> float:
        """Roll out the update into a trial trajectory with gaps."""
        trial, current, update = self.work.trial, self.work.current, self.work.update
        first_offset = (alpha - 1.0) * self.initial_gap
        self._run(RETRACTION_KERNEL_NAME, 1, self._initial_state, first_offset, trial.states)
        reference, policy = (current.states, current.controls), (update.feedforward, update.gains)
        return trial.follow(self._kernels, reference, policy, alpha, offsets=(alpha - 1.0) * self.gaps)

    def accept(self, alpha: float) -> None:
        """Make the trial the current trajectory.

        Args:
            alpha: Its step length.
        """
        self.work.accept()
        self.work.trial.states[0] = self._initial_state[0]
        self.gaps *= 1.0 - alpha
        self.initial_gap *= 1.0 - alpha
        self.share *= 1.0 - alpha

    def _feedback_rollouts(self) -> list[tuple[float, FloatArray]]:
        """Costs and controls of rollouts with feedback that keeps to the trajectory with gaps."""
        work, found = self.work, []
        work.differentiate()
        if work.sweep(0.0, gaps=self.gaps).status == SWEEP_DONE:
            for alpha in (1.0, 0.0):
                work.trial.states[0] = self._initial_state[0]
                found.append((work.try_step(alpha), work.trial.controls.copy()))
        return found

    def _roll_out(self, others: list[tuple[float, FloatArray]]) -> None:
        """Replace the current trajectory with a rollout of its controls, or of cheaper other ones."""
        work = self.work
        work.start(self._initial_state[0], work.current.controls.copy())
        for cost, controls in others:
            if cost < work.current.cost:
                work.start(self._initial_state[0], controls)
        self.share = 0.0

    def _run(self, name: str, rows: int, *arrays: FloatArray) -> None:
        """Run a kernel over the first rows of arrays."""
        run_kernel(self._kernels[name].address, 0, rows, buffer_table(*arrays))


def _next_level(level: int, alpha: float) -> int:
    """Index into `DAMPING` after a step of length alpha, 0 if none was accepted."""
    if alpha >= LONG_STEP:
        return max(level - 1, 0)
    return min(level + 1, len(DAMPING) - 1) if alpha < SHORT_STEP else level
