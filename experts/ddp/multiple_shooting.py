"""Multiple shooting: a solve that begins with a guess of the states, which need not obey the dynamics.

**Gaps.** Such a trajectory has gaps: f = x0 (-) x_0 before the first stage, and f_k = step(x_k, u_k) (-)
x_k+1 after stage k. As in feasibility-driven DDP (Mastalli et al., ICRA 2020; with bounds: Mastalli et al.,
Autonomous Robots 2022) the backward pass, with derivatives along the guess, plans to close them, and a step
of length alpha leaves the share 1 - alpha of every gap: x_k+1 = step(x_k, u_k) (+) -(1 - alpha) f_k. A full
step is thus a rollout, with feedback around the guess and all controls within their bounds; single shooting
continues from there.

**Tangent space.** f_k belongs to x_k+1 but is applied to the state where the trial's step lands, in that
state's body axes. On poses this loses nothing: motion along one twist is a one-parameter group, so the new
gap is exactly (1 - alpha) f_k. The model, however, is of first order in the gaps: strictly, A and B give
increments where the step lands, and a gap with rotation r turns these by about r / 2 on the way to x_k+1. We
neglect this, as others do: it degrades the direction a little while gaps between stages are large, never the
result. The gap before the first stage is exempt, since no derivative passes it; a trajectory solved for
another start, however far, is therefore best given as it is.

**Acceptance.** A trajectory with gaps may cost less than any feasible one, so steps must be allowed to raise
the cost. As all gaps shrink alike, one number measures them, the remaining share s, and the merit function is
cost + weight * s. A step of length alpha is predicted to reduce it by alpha (weight s - L - alpha Q), where
L + Q is the change of the quadratic model of the cost under the full step; L is its exact derivative. The
weight never falls, and is raised to 2 (L + max(Q, 0)) / s where it is below, so that the predicted reduction
is positive: as in Mastalli's rule, the cost may rise by up to twice the predicted change. Every accepted step
reduces s for good: gaps cannot open again, and the cost of closing them is granted only once.

**Failure.** If `MOST_ITERATIONS` do not suffice, no step is accepted at the largest regularization, a
backward pass fails, or the solve ends earlier, a rollout replaces the trajectory: the cheapest of the
controls alone and of the feedback around the guess, with and without the feedforward k. A guess at which the
dynamics are not finite is replaced by the rollout of its controls. The message says so.
"""

from time import perf_counter

import numpy as np

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.kernels.bound import buffer_table, run_kernel
from experts.ddp.backward_pass import Update
from experts.ddp.derivatives import Derivatives
from experts.ddp.rollout import FINISHED
from experts.ddp.second_order import SHORT_STEP, SolverState
from experts.ddp.shooting import ACCEPTANCE, STEP_LENGTHS, ShootingWorkspace, WorkTime, timed
from experts.ddp.solution import Callback, IterationRecord, Stop, StopReason
from experts.native.compilation import compiled
from experts.problems.shooting_problem import (
    KERNEL_NAMES,
    RETRACTION_KERNEL_NAME,
    FloatArray,
    check_array,
    check_control_weights,
    check_state,
    native_calls,
    stage_bounds,
)

MOST_ITERATIONS = 50
"""Iterations after which a rollout closes the remaining gaps."""
MU_LEVELS = (0.0, 1e0, 1e2, 1e4, 1e6)
"""Regularizations while gaps are open, in multiples of the control weights: the next one after a short step
or none, the previous one after a long step."""
LONG_STEP = 0.5
"""Shortest long step; a short one is shorter than `SHORT_STEP`."""
NEGLIGIBLE_GAP = 1e-10
"""A guess with smaller gaps counts as feasible."""
MODEL_SHARE = 0.5
"""Share of the weight in excess of what the predicted change of the cost requires."""
LARGEST_PROJECTION = 1e-3
"""How far entries of a guessed state may be off the manifold of states, such as the unit quaternions."""


class MultipleShooting:
    """Closes the gaps of a guess, in the workspace of a solver.

    Attributes:
        gaps: f_k, shape (N, n_t).
        initial_gap: x0 (-) x_0, shape (1, n_t).
        share: Remaining share of the first gaps, in [0, 1].
        weight: Weight of the share in the merit function, in the unit of the cost.
        largest: Largest norm of the first gaps.
    """

    def __init__(self, work: ShootingWorkspace) -> None:
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
        """Durations of the workspace."""
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
        """Return a guess of the states, shape (N + 1, n_x), projected onto the manifold of states."""
        problem = self.work.problem
        given = np.ascontiguousarray(real_array("x_init", x_init, np.float64))
        check_array("x_init", given, (problem.horizon + 1, problem.n_states))
        states, still = given, np.zeros((len(given), problem.n_tangent))
        for _ in range(3):  # each one squares the error
            result = np.zeros_like(states)
            self._run(RETRACTION_KERNEL_NAME, len(states), states, still, result)
            states = result
        # True for NaN as well: a state that cannot be projected.
        off = ~(np.abs(states - given) <= LARGEST_PROJECTION)
        if off.any():
            k, i = (int(index[0]) for index in np.nonzero(off))
            raise ValueError(
                f"x_init[{k}] is no state: its entry {i}, {given[k, i]}, is more than {LARGEST_PROJECTION} "
                "off the valid ones; a pose must be a unit dual quaternion"
            )
        check_state(problem, "x_init", states)  # zeros stay zeros
        return states

    def close_gaps(
        self,
        guess: tuple[FloatArray, FloatArray, FloatArray],
        state: SolverState,
        max_iterations: int,
        callback: Callback | None,
    ) -> Stop | None:
        """Make the current trajectory of the workspace a rollout, starting from a guess.

        The guess is an initial state, shape (n_x,), states, shape (N + 1, n_x), and controls within the
        bounds, shape (N, n_u). Returns why the solve ends already, or None to continue; the trajectory's
        `failing_stage` tells whether it is finite.
        """
        self.begin(*guess)
        try:
            stop = self._iterate(state, max_iterations, callback)
        except KeyboardInterrupt:
            stop = Stop(StopReason.INTERRUPTED, "interrupted by the user")
        if not self.is_finite:
            state.note = "; the dynamics are not finite at the guessed states: only controls were used"
            self._roll_out([])
        elif self.largest_gap > NEGLIGIBLE_GAP:
            state.note = f"; no step closed the last gaps, of up to {self.largest_gap:.1e}: a rollout did"
            self._roll_out(self._feedback_rollouts())
        elif self.is_open:
            self._roll_out([])
        return stop

    def begin(self, initial_state: FloatArray, states: FloatArray, controls: FloatArray) -> None:
        """Make a guess the current trajectory; compute its gaps and cost."""
        current, horizon = self.work.current, len(self.gaps)
        self.work.bounds = stage_bounds(self.work.problem)
        self._initial_state[0], current.states[:], current.controls[:] = initial_state, states, controls
        self._run("difference", 1, current.states, self._initial_state, self.initial_gap)
        given = (current.states, *self.work.problem.parameters.inputs, current.controls, self._time_step)
        self._run("step_with_cost", horizon, *given, self._landings, current.stage_costs)
        self._run("difference", horizon, current.states[1:], self._landings, self.gaps)
        end = current.states[-1:], *self.work.problem.terminal_inputs
        self._run("terminal_cost", 1, *end, current.terminal_cost)
        current.cost = float(current.stage_costs.sum() + current.terminal_cost[0])
        current.failing_stage = FINISHED
        norms = np.linalg.norm(np.vstack([self.initial_gap, self.gaps]), axis=1)
        self.share, self.weight, self.largest = 1.0, 0.0, float(norms.max())

    def _iterate(self, state: SolverState, max_iterations: int, callback: Callback | None) -> Stop | None:
        """Step until the gaps are closed, or cannot be."""
        work = self.work
        level, moved = 0, True
        while self.is_finite and self.largest_gap > NEGLIGIBLE_GAP:
            stop = state.iteration_limit(max_iterations)
            if stop is not None:
                return stop
            started, work.time = perf_counter(), WorkTime()
            if moved:
                work.differentiate()
            if not state.records:
                check_control_weights(work.derivatives.luu)
            direction = work.backward_pass(MU_LEVELS[level], gaps=self.gaps)
            if not direction.completed:
                break
            linear, quadratic = self.change_of_cost()
            alpha = self.line_search(linear, quadratic)
            record = IterationRecord(
                iteration=len(state.records) + 1,
                cost=work.current.cost,
                alpha=alpha,
                exact=False,
                regularization=direction.mu,
                expected_decrease=-(linear + quadratic),
                optimality=np.inf,
                clamped_share=direction.clamped / work.current.controls.size,
                seconds=perf_counter() - started,
                derivative_seconds=work.time.derivatives,
                sweep_seconds=work.time.backward_pass,
                rollout_seconds=work.time.rollout,
                gap=self.largest_gap,
            )
            state.records.append(record)
            if callback is not None:
                callback(record)
            moved = alpha > 0.0
            if record.iteration == MOST_ITERATIONS or (not moved and level == len(MU_LEVELS) - 1):
                break
            level = _next_level(level, alpha)
        return None

    @timed("rollout")
    def change_of_cost(self) -> tuple[float, float]:
        """Predict the change of the cost by the last update: L per step length, Q per squared step length."""
        linear, quadratic = change_of_cost(
            self.work.derivatives, self.work.update, self.initial_gap[0], self.gaps, *self._rows
        )
        return float(linear), float(quadratic)

    def line_search(self, linear: float, quadratic: float) -> float:
        """Accept the longest step that reduces the merit function as predicted; return its length, or 0."""
        enough = (linear + max(quadratic, 0.0)) / ((1.0 - MODEL_SHARE) * self.share)
        self.weight = max(self.weight, enough)
        cost = self.work.current.cost
        for alpha in STEP_LENGTHS:
            predicted = alpha * (self.weight * self.share - linear - alpha * quadratic)
            achieved = cost - self.try_step(alpha) + self.weight * alpha * self.share
            if achieved >= ACCEPTANCE * predicted:
                self.accept(float(alpha))
                return float(alpha)
        return 0.0

    def try_step(self, alpha: float) -> float:
        """Roll out the update, leaving the share 1 - alpha of the gaps; return the trial's cost."""
        work = self.work
        if alpha == 1.0:
            work.trial.states[0] = self._initial_state[0]
            return work.try_step(1.0)
        return self._roll_out_with_gaps(alpha)

    @timed("rollout")
    def _roll_out_with_gaps(self, alpha: float) -> float:
        trial, current, update = self.work.trial, self.work.current, self.work.update
        first_offset = (alpha - 1.0) * self.initial_gap
        self._run(RETRACTION_KERNEL_NAME, 1, self._initial_state, first_offset, trial.states)
        reference, policy = (current.states, current.controls), (update.k, update.K)
        offsets = (alpha - 1.0) * self.gaps
        return trial.follow(self._kernels, reference, policy, alpha, self.work.bounds, offsets)

    def accept(self, alpha: float) -> None:
        """Make the trial of a step length the current trajectory."""
        self.work.accept()
        self.work.trial.states[0] = self._initial_state[0]
        self.gaps *= 1.0 - alpha
        self.initial_gap *= 1.0 - alpha
        self.share *= 1.0 - alpha

    def _feedback_rollouts(self) -> list[tuple[float, FloatArray]]:
        """Return costs and controls of rollouts with feedback around the trajectory with gaps."""
        work, found = self.work, []
        work.differentiate()
        if work.backward_pass(0.0, gaps=self.gaps).completed:
            for alpha in (1.0, 0.0):
                work.trial.states[0] = self._initial_state[0]
                found.append((work.try_step(alpha), work.trial.controls.copy()))
        return found

    def _roll_out(self, others: list[tuple[float, FloatArray]]) -> None:
        """Replace the current trajectory by a rollout of its controls, or of cheaper other ones."""
        work = self.work
        work.start(self._initial_state[0], work.current.controls.copy())
        for cost, controls in others:
            if cost < work.current.cost:
                work.start(self._initial_state[0], controls)
        self.share = 0.0

    def _run(self, name: str, rows: int, *arrays: FloatArray) -> None:
        """Run a kernel over the first rows of arrays."""
        with native_calls(self.work.problem):
            run_kernel(self._kernels[name].address, 0, rows, buffer_table(*arrays))


def _next_level(level: int, alpha: float) -> int:
    """Index into `MU_LEVELS` after a step of length alpha, 0 if none was accepted."""
    if alpha >= LONG_STEP:
        return max(level - 1, 0)
    return min(level + 1, len(MU_LEVELS) - 1) if alpha < SHORT_STEP else level


@compiled
def change_of_cost(
    derivatives: Derivatives,
    update: Update,
    initial_gap: FloatArray,
    gaps: FloatArray,
    dx: FloatArray,
    dx_next: FloatArray,
    du: FloatArray,
) -> tuple[float, float]:
    """Compute how a step that closes the gaps changes the quadratic model of the cost.

    The linearized rollout dx_0 = f, du = k + K dx, dx_k+1 = A dx + B du + f_k is followed; a step of length
    alpha moves alpha times as far.
    """
    horizon, n_tangent = gaps.shape
    n_controls = du.shape[0]
    linear, quadratic = 0.0, 0.0
    for i in range(n_tangent):
        dx[i] = initial_gap[i]
    for k in range(horizon):
        for i in range(n_controls):
            du[i] = update.k[k, i]
            for j in range(n_tangent):
                du[i] += update.K[k, i, j] * dx[j]
        for i in range(n_controls):
            curvature = 0.0
            for j in range(n_controls):
                curvature += derivatives.luu[k, i, j] * du[j]
            linear += derivatives.lu[k, i] * du[i]
            quadratic += 0.5 * du[i] * curvature
            if derivatives.lux.shape[0] > 0:
                for j in range(n_tangent):
                    quadratic += du[i] * derivatives.lux[k, i, j] * dx[j]
        for i in range(n_tangent):
            curvature, moved = 0.0, gaps[k, i]
            for j in range(n_tangent):
                curvature += derivatives.lxx[k, i, j] * dx[j]
                moved += derivatives.A[k, i, j] * dx[j]
            for j in range(n_controls):
                moved += derivatives.B[k, i, j] * du[j]
            linear += derivatives.lx[k, i] * dx[i]
            quadratic += 0.5 * dx[i] * curvature
            dx_next[i] = moved
        for i in range(n_tangent):
            dx[i] = dx_next[i]
    for i in range(n_tangent):
        curvature = 0.0
        for j in range(n_tangent):
            curvature += derivatives.terminal_lxx[0, i, j] * dx[j]
        linear += derivatives.terminal_lx[0, i] * dx[i]
        quadratic += 0.5 * dx[i] * curvature
    return linear, quadratic
