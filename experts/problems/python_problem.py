"""A problem of one's own in NumPy: derivatives given, or by differences."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.common.real_arrays import real_array
from experts.native.python_kernels import PythonKernels, Shape, read_only
from experts.problems.differences import hessian, jacobian
from experts.problems.euclidean_problem import EuclideanProblem, Function
from experts.problems.shooting_problem import FloatArray, Kernel

_GIVEN = {
    "step_with_cost: x_next": "step",
    "step_with_cost: cost": "stage_cost",
    "terminal_cost: cost": "terminal_cost",
    "cost_derivatives": "stage_cost_derivatives",
    "terminal_cost_hessian": "terminal_cost_derivatives",
}
"""Functions of the user behind kernels and their results, where they have other names."""


class PythonProblem(EuclideanProblem):
    """A `ShootingProblem` of functions: minimize sum_k stage_cost(x_k, u_k) + terminal_cost(x_N).

    The solver calls the functions stage by stage, at the speed of Python; an exception in one of them, or a
    result of another shape, ends the solve. What is not given is computed by central differences, also beyond
    the bounds: first derivatives with steps of 6e-6, relative to entries above 1, and errors of some 1e-10 of
    the function's size, Hessians of the costs with steps of 1e-4 and errors of some 1e-7 of the cost. Second
    derivatives of the step are never computed so: without `lagrangian_hessian` the solver uses Gauss-Newton's
    model.
    """

    has_mixed_cost = True

    def __init__(
        self,
        step: Function,
        stage_cost: Function,
        terminal_cost: Function,
        *,
        initial_state: ArrayLike,
        n_controls: int,
        horizon: int,
        time_step: float = 1.0,
        control_lower: ArrayLike | None = None,
        control_upper: ArrayLike | None = None,
        parameters: ArrayLike = (),
        linearize: Function | None = None,
        stage_cost_derivatives: Function | None = None,
        terminal_cost_derivatives: Function | None = None,
        lagrangian_hessian: Function | None = None,
    ) -> None:
        """Try every function once, at the initial state.

        The functions take arrays of shape (n_x,) and (n_u,), which they may not change; with parameters, p of
        shape (n_p,) as last argument.

        Args:
            step: Function (x, u) that returns the next state; `runge_kutta` makes one of a rate.
            stage_cost: Function (x, u) that returns a number, with a positive second derivative by each
                control; it is not multiplied by the time step.
            terminal_cost: Function (x) that returns a number.
            initial_state: State at stage 0 unless `solve` is given another, shape (n_x,).
            n_controls: Number n_u of controls.
            horizon: Number N of stages.
            time_step: Duration of a stage, s; it enters no equation.
            control_lower: Lower bounds, shape (n_u,), (N, n_u) or (); None for none.
            control_upper: Upper bounds, shape (n_u,), (N, n_u) or (); None for none.
            parameters: Nominal values of what varies between solves or stages, shape (n_p,).
            linearize: Function (x, u) that returns A, shape (n_x, n_x), and B, shape (n_x, n_u).
            stage_cost_derivatives: Function (x, u) that returns lx, lu, lxx, lux, luu, shapes (n_x,), (n_u,),
                (n_x, n_x), (n_u, n_x), (n_u, n_u).
            terminal_cost_derivatives: Function (x) that returns lx, lxx; exact if `lagrangian_hessian` is.
            lagrangian_hessian: Function (x, u, multiplier) that returns the second derivatives Lxx, Lux, Luu
                of stage_cost(x, u) + multiplier . step(x, u), shapes as of lxx, lux, luu.

        Raises:
            TypeError: If a function returns something other than real numbers.
            ValueError: If sizes, bounds or numbers contradict each other, or a function returns other shapes.
        """
        bounds = control_lower, control_upper
        super().__init__(initial_state, n_controls, horizon, time_step, bounds, parameters)
        self._step, self._stage_cost, self._terminal_cost = step, stage_cost, terminal_cost
        self._lagrangian_hessian = lagrangian_hessian
        self._linearize = linearize or self._difference_step
        self._stage_derivatives = stage_cost_derivatives or self._difference_stage_cost
        self._terminal_derivatives = terminal_cost_derivatives or self._difference_terminal_cost
        self._kernels_in_python = PythonKernels()
        self._try()

    @property
    def has_second_order(self) -> bool:
        """Whether `lagrangian_hessian` is given."""
        return self._lagrangian_hessian is not None

    def native_calls(self) -> AbstractContextManager[None]:
        """Surround native code that calls the functions.

        Returns:
            A context manager that raises at its end what one of them raised.
        """
        return self._kernels_in_python.native_calls()

    def _difference_step(self, x: FloatArray, u: FloatArray, *p: FloatArray) -> tuple[FloatArray, ...]:
        by_state = jacobian(lambda moved: self._step(moved, u, *p), x)
        return by_state, jacobian(lambda moved: self._step(x, moved, *p), u)

    def _difference_stage_cost(self, x: FloatArray, u: FloatArray, *p: FloatArray) -> tuple[FloatArray, ...]:
        def cost(z: FloatArray) -> Any:
            return self._stage_cost(z[:n], z[n:], *p)

        n, z = self.n_states, np.concatenate([x, u])
        slope, bend = jacobian(cost, z), hessian(cost, z)
        return slope[:n], slope[n:], bend[:n, :n], bend[n:, :n], bend[n:, n:]

    def _difference_terminal_cost(self, x: FloatArray, *p: FloatArray) -> tuple[FloatArray, ...]:
        def cost(moved: FloatArray) -> Any:
            return self._terminal_cost(moved, *p)

        return jacobian(cost, x), hessian(cost, x)

    def _make(self, name: str, batched: bool) -> Kernel | None:
        table = self._table()
        if name not in table:
            return None
        function, inputs, outputs = table[name]
        # `h` is not handed on.
        skipped = int(name in ("step_with_cost", "linearize", "lagrangian_hessian"))
        return self._kernels_in_python.make(function, inputs, list(outputs.values()), skipped)

    def _table(self) -> dict[str, tuple[Function, Sequence[Shape], dict[str, Shape]]]:
        """Kernels: function of a row, shapes of its inputs, names and shapes of its results."""
        n, m = self.n_states, self.n_controls
        parameters = [(self.parameters.nominal.size,)] if self.parameters.inputs else []
        end: list[Shape] = [(n,), *parameters]
        point: list[Shape] = [*end, (m,)]
        step, cost = self._step, self._stage_cost
        first = {"lx": (n,), "lu": (m,), "lxx": (n, n), "luu": (m, m), "lux": (m, n)}
        second: dict[str, Shape] = {"Lxx": (n, n), "Lux": (m, n), "Luu": (m, m)}

        def stage_derivatives(x: FloatArray, u: FloatArray, *p: FloatArray) -> Sequence[Any]:
            lx, lu, lxx, lux, luu = self._stage_derivatives(x, u, *p)
            return lx, lu, lxx, luu, lux

        # Kernels take the parameters after the state, the functions take them last.
        def last(function: Function) -> Function:
            return lambda x, *rest: function(x, *rest[len(parameters) :], *rest[: len(parameters)])

        table: dict[str, tuple[Function, Sequence[Shape], dict[str, Shape]]] = {
            "step_with_cost": (
                last(lambda *given: (step(*given), cost(*given))),
                point,
                {"x_next": (n,), "cost": ()},
            ),
            "terminal_cost": (lambda *given: (self._terminal_cost(*given),), end, {"cost": ()}),
            "linearize": (last(self._linearize), point, {"A": (n, n), "B": (n, m)}),
            "cost_derivatives": (last(stage_derivatives), point, first),
            "terminal_cost_derivatives": (self._terminal_derivatives, end, {"lx": (n,), "lxx": (n, n)}),
            "terminal_cost_hessian": (
                lambda *given: self._terminal_derivatives(*given)[1:],
                end,
                {"Lxx": (n, n)},
            ),
        }
        if self._lagrangian_hessian is not None:
            table["lagrangian_hessian"] = last(self._lagrangian_hessian), [*point, (n,)], second
        return table

    def _try(self) -> None:
        """Call every function once, and check the shapes of its results."""
        lower, upper = (np.atleast_2d(bound)[0] for bound in (self.control_lower, self.control_upper))
        p = [self.parameters.nominal] if self.parameters.inputs else []
        given = [self.initial_state, *p, np.clip(np.zeros(self.n_controls), lower, upper), self.initial_state]
        for kernel, (function, inputs, outputs) in self._table().items():
            results = function(*(read_only(value) for value in given[: len(inputs)]))
            if len(results) != len(outputs):
                raise ValueError(
                    f"{_GIVEN.get(kernel, kernel)} has {len(results)} results; expected {', '.join(outputs)}"
                )
            for (result, shape), value in zip(outputs.items(), results, strict=True):
                name = _GIVEN.get(f"{kernel}: {result}") or f"{_GIVEN.get(kernel, kernel)}: {result}"
                found = real_array(name, value, np.float64).shape
                if found != shape:
                    wanted = f"{shape}" if shape else "(), a single number, such as u[0] ** 2"
                    raise ValueError(f"{name} has shape {found}; expected {wanted}")
