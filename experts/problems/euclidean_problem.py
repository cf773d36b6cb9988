"""Problems of one's own share this: states of plain numbers, bounds, parameters, and a Runge-Kutta step."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.common.host_machine import host_machine
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.compiler.graph import graph_of
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.kernels.bound import BoundKernel
from dq_space_arm_env.kernels.library import compile_program
from dq_space_arm_env.kernels.programs.derivative_programs import sparse_buffer
from experts.problems.shooting_problem import (
    FloatArray,
    Kernel,
    StageParameters,
    check_array,
    check_duration,
    check_problem,
    check_whole,
)

Matrix = Any
Function = Callable[..., Any]


def runge_kutta(dynamics: Function, time_step: float) -> Function:
    """Make a step of continuous dynamics: the classical Runge-Kutta method, with u constant during the step.

    Args:
        dynamics: Function (x, u), or (x, u, p), that returns dx/dt: arrays of NumPy, or CasADi's SX.
        time_step: Duration h of the step, s.

    Returns:
        Function of the same arguments that returns the state after the step.

    Raises:
        ValueError: If the duration is no positive, finite number; the step, if the dynamics return another
            number of rates than of states.
    """
    check_duration("time_step", time_step)
    h = float(time_step)

    def step(x: Any, u: Any, *p: Any) -> Any:
        def rate(state: Any) -> Any:
            value = dynamics(state, u, *p)
            if isinstance(value, list | tuple):
                value = casadi.vertcat(*value) if isinstance(x, casadi.SX) else np.array(value)
            found, expected = _count(value), _count(x)
            if found != expected:  # one would be the rate of all
                raise ValueError(
                    f"dynamics returns {found} numbers; expected {expected}, one for each state: change it "
                    "or initial_state"
                )
            return value

        k1 = rate(x)
        k2 = rate(x + 0.5 * h * k1)
        k3 = rate(x + 0.5 * h * k2)
        k4 = rate(x + h * k3)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return step


def _count(value: Any) -> int:
    """How many numbers an array or a CasADi expression holds."""
    return int(value.numel() if hasattr(value, "numel") else np.size(value))


class EuclideanProblem(ABC):
    """Sizes, bounds and parameters of a `ShootingProblem` whose states are plain numbers."""

    has_retraction = True

    def __init__(
        self,
        initial_state: ArrayLike,
        n_controls: int,
        horizon: int,
        time_step: float,
        bounds: tuple[ArrayLike | None, ArrayLike | None],
        parameters: ArrayLike,
    ) -> None:
        for name, size in (("n_controls", n_controls), ("horizon", horizon)):
            check_whole(name, size, 1)
        self.initial_state: FloatArray = np.array(real_array("initial_state", initial_state, np.float64))
        if self.initial_state.ndim != 1:
            raise ValueError(f"initial_state has shape {self.initial_state.shape}; expected (n_x,)")
        check_array("initial_state", self.initial_state, self.initial_state.shape)
        self.n_states = self.n_tangent = len(self.initial_state)
        self.n_controls, self.horizon, self.time_step = n_controls, horizon, time_step
        nominal = np.array(real_array("parameters", parameters, np.float64))
        check_array("parameters", nominal, (nominal.size,))
        self.parameters = StageParameters(horizon, nominal)
        self.terminal_inputs: tuple[FloatArray, ...] = tuple(rows[-1:] for rows in self.parameters.inputs)
        lower, upper = (
            np.full(n_controls, default) if bound is None else np.array(real_array(name, bound, np.float64))
            for name, bound, default in zip(
                ("control_lower", "control_upper"), bounds, (-np.inf, np.inf), strict=True
            )
        )
        # One number bounds every input.
        self.control_lower: FloatArray = np.full(n_controls, lower) if lower.ndim == 0 else lower
        self.control_upper: FloatArray = np.full(n_controls, upper) if upper.ndim == 0 else upper
        check_problem(self)
        self._kernels: dict[tuple[str, bool], Kernel] = {}

    @property
    @abstractmethod
    def has_second_order(self) -> bool:
        """Whether there are exact second derivatives of the dynamics."""

    @property
    @abstractmethod
    def has_mixed_cost(self) -> bool:
        """Whether the stage cost has a second derivative by state and control."""

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`; compiled on first use, or loaded from the cache."""
        key = name, batched
        if key not in self._kernels:
            made = self._make(name, batched)
            self._kernels[key] = self._geometry(name, batched) if made is None else made
        return self._kernels[key]

    @abstractmethod
    def _make(self, name: str, batched: bool) -> Kernel | None:
        """Make a kernel; None for those of the states' geometry."""

    def _geometry(self, name: str, batched: bool) -> Kernel:
        """Make `difference` or `retract`."""
        first, second = (casadi.SX.sym(key, self.n_states) for key in ("a", "b"))
        if name == "difference":
            return compiled(name, {"x_reference": first, "x": second}, {"dx": second - first}, batched)
        if name == "retract":
            return compiled(name, {"x": first, "dx": second}, {"x_next": first + second}, batched)
        raise ValueError(f"there is no kernel {name!r}")


def compiled(name: str, inputs: dict[str, Matrix], outputs: dict[str, Matrix], batched: bool) -> BoundKernel:
    """Compile expressions of CasADi; `h`, the last input, has a single row, and zeros are not written."""
    symbols = {key: value.nonzeros() for key, value in inputs.items()}
    results = {key: value.nonzeros() for key, value in outputs.items()}
    program = Program(
        name,
        [Buffer(key, len(values), shared=key == "h") for key, values in symbols.items()],
        [sparse_buffer(key, value.sparsity()) for key, value in outputs.items()],
    )
    program.call(graph_of(f"{name}_graph", symbols, results))
    return compile_program(program, host_machine().lanes if batched else 1)
