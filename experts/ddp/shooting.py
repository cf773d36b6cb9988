"""Work arrays of a solve and the native operations on them: rollouts, derivatives, backward pass."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from time import perf_counter
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.worker_process import is_worker
from dq_space_arm_env.kernels.bound import buffer_table, run_kernel
from dq_space_arm_env.kernels.threads import share_rows
from experts.ddp.backward_pass import (
    PASS_NOT_FINITE,
    PassResult,
    Update,
    allocate_update,
    backward_pass,
    pass_workspace,
)
from experts.ddp.derivatives import (
    Hessians,
    allocate_derivatives,
    allocate_hessians,
    change_by_rounding,
    find_costates,
    gauss_newton_hessians,
    mirrored,
)
from experts.ddp.parallel_rollouts import LANE_KERNELS, LANES, ParallelRollouts
from experts.ddp.rollout import FINISHED, Trajectory
from experts.native.compilation import BufferTable, has_code, is_prepared, prepare
from experts.problems.python_problem import PythonProblem
from experts.problems.shooting_problem import (
    KERNEL_NAMES,
    SECOND_ORDER_KERNEL_NAMES,
    FloatArray,
    Kernel,
    ShootingProblem,
    compiling_aside,
    native_calls,
    rate_limits,
    stage_bounds,
    within_rates,
)

BATCHED_KERNELS = ("linearize", "cost_derivatives", "lagrangian_hessian")
"""Kernels that work on all stages at once; rollouts proceed stage by stage."""

LONGEST_KERNELS = ("lagrangian_hessian", "linearize")
"""Kernels that take longest to compile."""

_STAGES_PER_BLOCK = 32
"""Stages that a thread differentiates at a time: enough to outweigh its overhead."""

_UNWRITTEN = 1.2345e-300
"""A number that no kernel computes."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class WorkTime:
    """Wall-clock time spent on each kind of work, s."""

    derivatives: float = 0.0
    backward_pass: float = 0.0
    rollout: float = 0.0


def timed(work: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a method add its duration to a field of its object's `WorkTime`, the attribute `time`."""

    def decorate(method: Callable[P, R]) -> Callable[P, R]:
        @wraps(method)
        def measured(*args: P.args, **kwargs: P.kwargs) -> R:
            started = perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                time = args[0].time  # type: ignore[attr-defined]  # args[0] is the object
                setattr(time, work, getattr(time, work) + perf_counter() - started)

        return measured

    return decorate


class ShootingWorkspace:
    """A current trajectory with its derivatives and control update, and a trial trajectory.

    Attributes:
        current: The best trajectory so far.
        trial: The trajectory of the last step tried.
        update: Control update of the last backward pass.
        derivatives: Derivatives along the current trajectory, valid after `differentiate`.
        bounds: Lower and upper bounds of the controls at every stage when the solve began.
        time: Durations since a new `WorkTime` was last assigned.
    """

    def __init__(
        self, problem: ShootingProblem, second_order: bool, *, keep_values: bool = False, threads: int = 1
    ) -> None:
        sizes = problem.horizon, problem.n_tangent, problem.n_controls
        self.problem = problem
        self.time = WorkTime()
        self._threads = threads
        self.derivatives = allocate_derivatives(*sizes, mixed=problem.has_mixed_cost)
        self.update: Update = allocate_update(*sizes, keep_values=keep_values)
        self._spare_update: Update = allocate_update(*sizes, keep_values=keep_values)
        self._time_step = np.array([problem.time_step])
        self._no_gaps = np.zeros((0, problem.n_tangent))
        self._patterns: tuple[NDArray[np.bool_], ...] | None = None  # of A and B; unknown
        self._pass_work = pass_workspace(problem.n_tangent, problem.n_controls)
        self._gauss_newton = gauss_newton_hessians(self.derivatives)
        stages = problem.horizon if second_order else 0
        self._exact = allocate_hessians(stages, problem.n_tangent, problem.n_controls)
        self._costates = np.zeros((stages, problem.n_tangent))
        self._mirrored: Hessians | None = None
        self._exact_is_current = False
        self.current = Trajectory(problem)
        self.trial = Trajectory(problem)
        self.bounds = stage_bounds(problem)
        self._kernels = self._compile(second_order)
        self._parallel = ParallelRollouts(problem, self._time_step)

    def _compile(self, second_order: bool) -> dict[str, Kernel]:
        """Return the kernels that a solve uses, by name.

        Where another process compiles what is missing of them, and the other loops, this one compiles the
        longest loop.
        """
        names = (*SECOND_ORDER_KERNEL_NAMES, *KERNEL_NAMES) if second_order else KERNEL_NAMES
        wanted = [(name, name in BATCHED_KERNELS) for name in names]
        in_lanes = [(name, True) for name in LANE_KERNELS]
        longest_first = sorted([*wanted, *in_lanes], key=lambda each: each[0] not in LONGEST_KERNELS)
        # The types of its arguments, which take numba as long as the rest of this, are those of all problems.
        is_new = not has_code(backward_pass)
        longest_loop = (backward_pass, *self._pass_arguments(0.0, self._gauss_newton, self._no_gaps))
        is_missing = is_new and not is_prepared(*longest_loop)
        with compiling_aside(self.problem, longest_first, compile_other_loops if is_missing else None):
            if is_new and not (is_missing and is_worker()):  # whose parent may be at it
                prepare(*longest_loop)
        return {name: self.problem.kernel(name, batched=batched) for name, batched in wanted}

    @timed("rollout")
    def start(self, initial_state: FloatArray, controls: FloatArray) -> None:
        """Roll out given controls, as far as rates let them be, and make that the current trajectory."""
        self.bounds, trajectory = stage_bounds(self.problem), self.current
        trajectory.states[0] = self.trial.states[0] = initial_state
        trajectory.controls[:] = controls
        limits = rate_limits(self.problem)
        previous = initial_state[limits.states]
        for control in trajectory.controls if previous.size else ():
            previous = within_rates(control, previous, limits)
        trajectory.roll_out(self._kernels)

    @timed("rollout")
    def evaluate_anew(self) -> None:
        """Compute the cost of the current trajectory with what the problem has changed."""
        self.current.roll_out(self._kernels)

    @timed("derivatives")
    def differentiate(self) -> None:
        """Compute the derivatives along the current trajectory that Gauss-Newton needs."""
        states, d, horizon = self.current.states, self.derivatives, self.problem.horizon
        given = (states, *self.problem.parameters.inputs, self.current.controls)
        if self._patterns is None:
            d.A[0], d.B[0] = _UNWRITTEN, _UNWRITTEN
        self._run("linearize", horizon, buffer_table(*given, self._time_step, d.A, d.B))
        if self._patterns is None:
            self._find_patterns()
        mixed = (d.lux,) if self.problem.has_mixed_cost else ()
        self._run("cost_derivatives", horizon, buffer_table(*given, d.lx, d.lu, d.lxx, d.luu, *mixed))
        end = states[-1:], *self.problem.terminal_inputs
        self._run("terminal_cost_derivatives", 1, buffer_table(*end, d.terminal_lx, d.terminal_lxx))
        self._exact_is_current, self._mirrored = False, None

    def _find_patterns(self) -> None:
        """Learn which entries of A and B the kernel writes; the others are always zero."""
        blocks = self.derivatives.A[0], self.derivatives.B[0]
        self._patterns = tuple(block != _UNWRITTEN for block in blocks)
        for block, written in zip(blocks, self._patterns, strict=True):
            block[~written] = 0.0
        self._pass_work = pass_workspace(self.problem.n_tangent, self.problem.n_controls, self._patterns)

    @timed("derivatives")
    def differentiate_twice(self) -> None:
        """Compute exact second derivatives along the current trajectory, unless they are current."""
        if self._exact_is_current:
            return
        find_costates(self.derivatives, self._costates)
        self._find_hessians(self._exact)
        self._exact_is_current = True

    @timed("derivatives")
    def mirror(self) -> None:
        """Make the cost's exact second derivatives convex, unless that was done for this trajectory."""
        if self._mirrored is not None:
            return
        n_tangent, exact = self.problem.n_tangent, self._exact
        self._costates[:] = 0.0  # without them the Lagrangian is the cost
        self._find_hessians(exact)
        self._exact_is_current = False
        upper = np.concatenate([exact.xx, exact.ux.transpose(0, 2, 1)], axis=2)
        whole = mirrored(np.concatenate([upper, np.concatenate([exact.ux, exact.uu], axis=2)], axis=1))
        xx, ux = whole[:, :n_tangent, :n_tangent], whole[:, n_tangent:, :n_tangent]
        blocks = (xx, ux, whole[:, n_tangent:, n_tangent:], mirrored(exact.terminal_xx))
        self._mirrored = Hessians(*map(np.ascontiguousarray, blocks))

    def _find_hessians(self, found: Hessians) -> None:
        """Run the kernels of second derivatives with the present costates."""
        states = self.current.states
        given = (states, *self.problem.parameters.inputs, self.current.controls, self._costates)
        buffers = buffer_table(*given, self._time_step, found.xx, found.ux, found.uu)
        self._run("lagrangian_hessian", self.problem.horizon, buffers)
        end = states[-1:], *self.problem.terminal_inputs
        self._run("terminal_cost_hessian", 1, buffer_table(*end, found.terminal_xx))

    @timed("backward_pass")
    def backward_pass(self, mu: float, *, exact: bool = False, gaps: FloatArray | None = None) -> PassResult:
        """Compute a control update; a pass that fails leaves the last update as it is.

        Exact second derivatives need `differentiate_twice`; otherwise those of `mirror` are used if it was
        called, or else Gauss-Newton's. Gaps of the current trajectory, shape (N, n_t), are closed by the
        update.
        """
        hessians = self._exact if exact else self._mirrored or self._gauss_newton
        gaps = self._no_gaps if gaps is None else gaps
        outcome = backward_pass(*self._pass_arguments(mu, hessians, gaps))
        result = PassResult(*outcome, float(mu), exact)
        if result.status == PASS_NOT_FINITE:
            # Its padding may hold NaN, which would spoil all later passes.
            self._pass_work = pass_workspace(self.problem.n_tangent, self.problem.n_controls, self._patterns)
        if result.completed:
            self.update, self._spare_update = self._spare_update, self.update
        return result

    def _pass_arguments(self, mu: float, hessians: Hessians, gaps: FloatArray) -> tuple[Any, ...]:
        """Arguments of `backward_pass`."""
        bounds, follows = self._present_bounds()
        work, controls = self._pass_work._replace(follows=follows), self.current.controls
        return (self.derivatives, hessians, gaps, controls, *bounds, float(mu), self._spare_update, work)

    def _present_bounds(self) -> tuple[tuple[FloatArray, FloatArray], NDArray[np.int64]]:
        """Bounds of the controls around the current trajectory, and what they follow, see `PassWorkspace`."""
        limits = rate_limits(self.problem)
        if not limits.change.size:
            return self.bounds, self._pass_work.follows
        previous, which = self.current.states[:-1, limits.states], limits.controls
        follows = np.full((self.problem.horizon, 2, self.problem.n_controls), -1)
        bounds = self.bounds[0].copy(), self.bounds[1].copy()
        for side, bound in enumerate(bounds):
            fixed = bound[:, which]
            bound[:, which] = np.clip(fixed, previous - limits.change, previous + limits.change)
            follows[:, side, which] = np.where(bound[:, which] != fixed, limits.tangents, -1)
        return bounds, follows

    def cost_rounding(self) -> float:
        """Estimate how much rounding of the states changes the cost; smaller changes mean nothing.

        Plain numbers are off by a rounding of their own. Directions of a pose mix its entries, so that all of
        them are taken to be off by one of the state's largest.
        """
        sizes, n_tangent = np.abs(self.current.states), self.problem.n_tangent
        if n_tangent != self.problem.n_states:
            sizes = np.repeat(sizes.max(axis=1, keepdims=True), n_tangent, axis=1)
        return change_by_rounding(self.derivatives, sizes)

    def restore_update(self) -> None:
        """Go back to the update before the last completed backward pass."""
        self.update, self._spare_update = self._spare_update, self.update

    @timed("rollout")
    def try_step(self, alpha: float) -> float:
        """Roll out the control update into the trial trajectory; return its cost, inf if it is not finite."""
        reference, policy = (self.current.states, self.current.controls), (self.update.k, self.update.K)
        return self.trial.follow(self._kernels, reference, policy, alpha, self.bounds)

    @timed("rollout")
    def try_steps(self, step_lengths: FloatArray) -> FloatArray:
        """Roll out up to `LANES` step lengths at once; return their costs, inf where not finite."""
        reference = self.current.states, self.current.controls
        return self._parallel.run(step_lengths, reference, self.update, *self.bounds)

    @timed("rollout")
    def choose(self, lane: int, cost: float) -> None:
        """Make one of the last `try_steps` the trial trajectory."""
        self.trial.states[:], self.trial.controls[:] = self._parallel.trajectory(lane)
        self.trial.cost, self.trial.failing_stage = cost, FINISHED

    def accept(self) -> None:
        """Make the trial the current trajectory, which is yet to be differentiated."""
        self.current, self.trial = self.trial, self.current

    def _run(self, name: str, rows: int, buffers: BufferTable) -> None:
        """Run a kernel over the first rows of its buffers."""
        address = self._kernels[name].address

        def work_on(begin: int, end: int) -> None:
            run_kernel(address, begin, end, buffers)

        with native_calls(self.problem):
            share_rows(work_on, rows, self._threads, _STAGES_PER_BLOCK)


def compile_other_loops() -> None:
    """Compile the loops but `backward_pass`, the same for all problems, by calling them for a tiny one."""
    problem = PythonProblem(
        lambda x, u: x + u,
        lambda x, u: u @ u,
        lambda x: x @ x,
        initial_state=[1.0],
        n_controls=1,
        horizon=1,
        lagrangian_hessian=lambda x, u, multiplier: (np.zeros((1, 1)), np.zeros((1, 1)), np.eye(1)),
    )
    work = ShootingWorkspace(problem, second_order=True)
    work.start(problem.initial_state, np.zeros((1, 1)))
    work.differentiate()
    work.differentiate_twice()
    work.cost_rounding()
    work.try_step(1.0)
    work.try_steps(SHORTER_STEPS)


SHORTER_STEPS: FloatArray = np.float64(0.5) ** np.arange(1, LANES + 1)
"""Step lengths after the full one, as many as are rolled out at once."""
STEP_LENGTHS: FloatArray = np.concatenate([[1.0], SHORTER_STEPS])
ACCEPTANCE = 1e-4
"""Share of the predicted reduction that a step must achieve (Armijo's rule)."""


def line_search(work: ShootingWorkspace, direction: PassResult) -> float:
    """Run the forward pass: take the full step, else the shorter one of lowest cost.

    Returns the length of the accepted step; 0 if no step reduces the cost as predicted, and the trajectory
    stays as it is.
    """
    cost = work.current.cost
    if cost - work.try_step(1.0) > ACCEPTANCE * direction.predicted_reduction(1.0):
        work.accept()
        return 1.0
    costs = work.try_steps(SHORTER_STEPS)
    predicted = np.array([direction.predicted_reduction(alpha) for alpha in SHORTER_STEPS])
    best = int(np.argmin(np.where(cost - costs > ACCEPTANCE * predicted, costs, np.inf)))
    if not cost - costs[best] > ACCEPTANCE * predicted[best]:
        return 0.0
    work.choose(best, float(costs[best]))
    work.accept()
    return float(SHORTER_STEPS[best])
