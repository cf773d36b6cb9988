"""Some stages of a maneuver as a problem: what a receding horizon and plans in mid-flight solve."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from experts.problems.arm_problem import ArmProblem, carried_along
from experts.problems.shooting_problem import FloatArray, Kernel, StageParameters

_QUADRATIC = {"terminal_cost": "quadratic_cost", "terminal_cost_derivatives": "quadratic_cost_derivatives"}


class WindowProblem:
    """Some stages of a maneuver; implements `ShootingProblem`.

    The terminal cost of a window that ends before the maneuver is a quadratic model of the remaining cost.

    Attributes:
        ends_early: Whether the maneuver continues after the last stage.
        constraints: Those of the maneuver; None if it does: its multipliers are given then.
        terminal_inputs: If it does, the quadratic model: its reference state, shape (1, n_x), gradient (1,
            n_t) and symmetric Hessian (1, n_t, n_t).
    """

    has_retraction = True

    def __init__(self, maneuver: ArmProblem, horizon: int, model: tuple[FloatArray, ...] = ()) -> None:
        self.maneuver, self.horizon, self.ends_early = maneuver, horizon, bool(model)
        self._first = 0
        n_more = maneuver.parameters.more.shape[1]
        self.parameters = StageParameters(horizon, maneuver.parameters.nominal, n_more=n_more)
        self.constraints = None if self.ends_early else maneuver.constraints_of(self.parameters)
        last = (rows[-1:] for rows in self.parameters.inputs)
        self.terminal_inputs = model or (*last, *maneuver.terminal_inputs[-1:])
        self.has_second_order = maneuver.has_second_order and not self.ends_early
        self.n_states, self.n_tangent = maneuver.n_states, maneuver.n_tangent
        self.n_controls, self.has_mixed_cost = maneuver.n_controls, maneuver.has_mixed_cost
        self.time_step, self.rate_limits = maneuver.time_step, maneuver.rate_limits
        self.initial_state: FloatArray = maneuver.initial_state

    @property
    def control_upper(self) -> FloatArray:
        """See `ArmProblem.control_upper`; they come down in time for what follows the window, too."""
        if not self.rate_limits.controls.size:
            return self.maneuver.limits(self.parameters.rows)
        following = self.maneuver.parameters.rows[self._first + self.horizon :]
        limits = self.maneuver.limits(np.vstack([self.parameters.rows[:-1], following]))
        return limits if limits.ndim == 1 else limits[: self.horizon]

    @property
    def control_lower(self) -> FloatArray:
        """See `ArmProblem.control_lower`."""
        return self.maneuver.kernels.layout.lower_limits(self.control_upper)

    def constrained(self, reserve: float = 0.0) -> "WindowProblem":
        """See `ArmProblem.constrained`; for the last stages of a maneuver."""
        maneuver = self.maneuver.constrained(reserve)
        maneuver.parameters.rows[:] = self.maneuver.parameters.rows
        found = WindowProblem(maneuver, self.horizon)
        found.begin_at(self._first)
        return found

    def begin_at(self, stage: int) -> None:
        """Take the parameters of the maneuver's stages from a stage on."""
        self._first = stage
        self.parameters.rows[:] = self.maneuver.parameters.rows[stage : stage + self.horizon + 1]

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`."""
        return self.maneuver.kernel(self._own(name), batched=batched)

    def compiling_aside(
        self, wanted: Sequence[tuple[str, bool]], before: Callable[[], None] | None
    ) -> AbstractContextManager[None]:
        """See `ArmProblem.compiling_aside`."""
        return self.maneuver.compiling_aside([(self._own(name), batched) for name, batched in wanted], before)

    def _own(self, name: str) -> str:
        """Name of a kernel in the maneuver."""
        return _QUADRATIC.get(name, name) if self.ends_early else name

    def carried(self, states: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """See `carried_along`, with the present parameters."""
        return carried_along(self.maneuver.kernels.layout, states, parameters, self.parameters.rows)

    def is_success(self, states: FloatArray, controls: FloatArray) -> bool:
        """See `ArmProblem.is_success`; True for a window after which the maneuver continues."""
        return self.ends_early or self.maneuver.is_success(states, controls)
