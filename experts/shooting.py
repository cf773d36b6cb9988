"""The work arrays of one solve and the native operations on them: roll out, differentiate, sweep, try a step.

Everything here is done for all stages by compiled code; nothing is decided here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from time import perf_counter
from typing import ParamSpec, TypeVar

import numpy as np

from dq_space_arm_env.kernels.threads import share_rows
from experts.backward_sweep import (
    SWEEP_DONE,
    SWEEP_NOT_FINITE,
    SweepOutcome,
    Update,
    allocate_update,
    backward_sweep,
    sweep_workspace,
)
from experts.derivatives import (
    allocate_derivatives,
    allocate_hessians,
    find_costates,
    gauss_newton_hessians,
)
from experts.native_call import BufferTable, buffer_table, run_kernel
from experts.parallel_rollouts import ParallelRollouts
from experts.problem import KERNEL_NAMES, SECOND_ORDER_KERNEL_NAMES, FloatArray, ShootingProblem
from experts.rollout import FINISHED
from experts.trajectory import Trajectory

BATCHED_KERNELS = ("linearize", "cost_derivatives", "lagrangian_hessian")
"""Kernels that work on all stages at once; rollouts go from stage to stage."""

_STAGES_PER_BLOCK = 32
"""Stages that a thread differentiates at a time: enough work to be worth its while."""

P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class WorkTime:
    """Wall-clock time that went into each kind of work, s.

    Attributes:
        derivatives: First and second derivatives along trajectories.
        sweep: Backward sweeps.
        rollout: Rollouts.
    """

    derivatives: float = 0.0
    sweep: float = 0.0
    rollout: float = 0.0


def timed(work: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a method add its time to an attribute of `WorkTime`, of which its object has one named `time`.

    Args:
        work: The attribute.

    Returns:
        The decorator.
    """

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
        problem: The problem.
        current: The best trajectory so far.
        trial: The trajectory of the last step that was tried.
        update: Control update of the last sweep.
        derivatives: Derivatives along the current trajectory, valid after `differentiate`.
        time: Where the time has gone since somebody last put a new `WorkTime` in its place.
    """

    def __init__(
        self,
        problem: ShootingProblem,
        second_order: bool,
        *,
        keep_values: bool = False,
        threads: int = 1,
    ) -> None:
        """Allocate all arrays of a solve.

        Args:
            problem: The problem.
            second_order: Whether exact second derivatives will be asked for.
            keep_values: Whether sweeps keep the value function's derivatives at every stage.
            threads: Most threads that differentiate; sweeps and rollouts go stage by stage.
        """
        sizes = problem.horizon, problem.n_tangent, problem.n_controls
        self.problem = problem
        self.time = WorkTime()
        self._threads = threads
        self.derivatives = allocate_derivatives(*sizes)
        self.update: Update = allocate_update(*sizes, keep_values=keep_values)
        self._spare_update: Update = allocate_update(*sizes, keep_values=keep_values)
        self._time_step = np.array([problem.time_step])
        self._no_gaps = np.zeros((0, problem.n_tangent))
        self._sweep_work = sweep_workspace(problem.n_tangent, problem.n_controls)
        self._lower = np.array(problem.control_lower, dtype=np.float64)
        self._upper = np.array(problem.control_upper, dtype=np.float64)
        names = (*KERNEL_NAMES, *SECOND_ORDER_KERNEL_NAMES) if second_order else KERNEL_NAMES
        self._kernels = {name: problem.kernel(name, batched=name in BATCHED_KERNELS) for name in names}
        self._gauss_newton = gauss_newton_hessians(self.derivatives)
        # Without second order there is no stage to store them for.
        stages = problem.horizon if second_order else 0
        self._exact = allocate_hessians(stages, problem.n_tangent, problem.n_controls)
        self._costates = np.zeros((stages, problem.n_tangent))
        self._exact_is_current = False
        self._parallel = ParallelRollouts(problem, self._time_step)
        self.current = Trajectory(problem)
        self.trial = Trajectory(problem)

    @timed("rollout")
    def start(self, initial_state: FloatArray, controls: FloatArray) -> None:
        """Roll out given controls and make the result the current trajectory.

        Args:
            initial_state: Shape (n_x,).
            controls: Inside the bounds, shape (N, n_u).
        """
        trajectory = self.current
        trajectory.states[0] = self.trial.states[0] = initial_state
        trajectory.controls[:] = controls
        trajectory.roll_out(self._kernels)

    @timed("derivatives")
    def differentiate(self) -> None:
        """Compute all derivatives along the current trajectory that Gauss-Newton needs."""
        states, controls, d = self.current.states, self.current.controls, self.derivatives
        horizon = self.problem.horizon
        self._run("linearize", horizon, buffer_table(states, controls, self._time_step, d.A, d.B))
        self._run("cost_derivatives", horizon, buffer_table(states, controls, d.lx, d.lu, d.lxx, d.luu))
        end = states[-1:], *self.problem.terminal_inputs
        self._run("terminal_cost_derivatives", 1, buffer_table(*end, d.terminal_lx, d.terminal_lxx))
        self._exact_is_current = False

    @timed("derivatives")
    def differentiate_twice(self) -> None:
        """Compute exact second derivatives along the current trajectory, unless they are there already."""
        if self._exact_is_current:
            return
        states, controls, exact = self.current.states, self.current.controls, self._exact
        find_costates(self.derivatives, self._costates)
        buffers = (states, controls, self._costates, self._time_step, exact.xx, exact.ux, exact.uu)
        self._run("lagrangian_hessian", self.problem.horizon, buffer_table(*buffers))
        end = states[-1:], *self.problem.terminal_inputs
        self._run("terminal_cost_hessian", 1, buffer_table(*end, exact.terminal_xx))
        self._exact_is_current = True

    @timed("sweep")
    def sweep(
        self, regularization: float, *, exact: bool = False, gaps: FloatArray | None = None
    ) -> SweepOutcome:
        """Compute a control update; one that fails leaves the last update as it is.

        Args:
            regularization: lambda >= 0, in multiples of the control weights.
            exact: Whether to take exact second derivatives; `differentiate_twice` must have been called.
            gaps: Gaps of the current trajectory for the update to close, shape (N, n_t); None if there are
                none.

        Returns:
            How the sweep ended.
        """
        outcome = SweepOutcome(
            *backward_sweep(
                self.derivatives,
                self._exact if exact else self._gauss_newton,
                self._no_gaps if gaps is None else gaps,
                self.current.controls,
                self._lower,
                self._upper,
                float(regularization),
                self._spare_update,
                self._sweep_work,
            )
        )
        if outcome.status == SWEEP_NOT_FINITE:
            # Its padding may hold what is not a number, and would spoil all later sweeps.
            self._sweep_work = sweep_workspace(self.problem.n_tangent, self.problem.n_controls)
        if outcome.status == SWEEP_DONE:
            self.update, self._spare_update = self._spare_update, self.update
        return outcome

    def cost_rounding(self) -> float:
        """What the last digit of the states is worth: changes of the cost below it cannot be told from none.

        The largest entry of a state stands for all, and half the trace of lxx for what random errors cost.

        Returns:
            Change of the cost if every tangent coordinate is off by a rounding, to second order, unit of the
            cost; of the current trajectory, whose derivatives must be there.
        """
        d, states = self.derivatives, self.current.states
        digits = np.finfo(np.float64).eps * np.abs(states).max(axis=1)
        slopes = np.append(np.abs(d.lx).sum(axis=1), np.abs(d.terminal_lx).sum())
        bends = np.append(np.einsum("kii->k", d.lxx), np.trace(d.terminal_lxx[0]))
        return float(digits @ slopes + 0.5 * (digits * digits) @ bends)

    def restore_update(self) -> None:
        """Go back to the update before the last successful sweep."""
        self.update, self._spare_update = self._spare_update, self.update

    @timed("rollout")
    def try_step(self, alpha: float) -> float:
        """Roll out the control update into the trial trajectory.

        Args:
            alpha: Step length, in [0, 1]; at 0 the feedback acts alone.

        Returns:
            Cost of the trial, inf if it is not finite.
        """
        reference = self.current.states, self.current.controls
        policy = self.update.feedforward, self.update.gains
        return self.trial.follow(self._kernels, reference, policy, alpha)

    @timed("rollout")
    def try_steps(self, step_lengths: FloatArray) -> FloatArray:
        """Roll out the control update with several step lengths at once.

        Args:
            step_lengths: In [0, 1], at most `LANES` of them.

        Returns:
            Costs of the trials, inf if not finite; `choose` makes one of them the trial trajectory.
        """
        reference = self.current.states, self.current.controls
        return self._parallel.run(step_lengths, reference, self.update, self._lower, self._upper)

    @timed("rollout")
    def choose(self, lane: int, cost: float) -> None:
        """Take one of the last `try_steps` as the trial trajectory.

        Args:
            lane: Position of its step length.
            cost: Its cost.
        """
        self.trial.states[:], self.trial.controls[:] = self._parallel.trajectory(lane)
        self.trial.cost, self.trial.failing_stage = cost, FINISHED

    def accept(self) -> None:
        """Make the trial the current trajectory; its derivatives and update are then to be computed."""
        self.current, self.trial = self.trial, self.current

    def _run(self, name: str, rows: int, buffers: BufferTable) -> None:
        """Run a kernel over the first rows of its buffers."""
        address = self._kernels[name].address

        def work_on(begin: int, end: int) -> None:
            run_kernel(address, begin, end, buffers)

        share_rows(work_on, rows, self._threads, _STAGES_PER_BLOCK)
