"""A problem of one's own in CasADi's symbols: exact derivatives, machine code."""

from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.compiler.graph import unknown_operation
from experts.problems.euclidean_problem import EuclideanProblem, Function, Matrix, compiled
from experts.problems.shooting_problem import Kernel


class CasadiProblem(EuclideanProblem):
    """A `ShootingProblem` of expressions: minimize sum_k stage_cost(x_k, u_k) + terminal_cost(x_N).

    CasADi differentiates, exactly and twice, and the compiler of the scenes turns every expression into
    machine code, kept on disk. Gauss-Newton's model takes the exact Hessian of the cost, mixed derivatives
    included; it leaves out the curvature of the dynamics.
    """

    has_second_order = True

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
    ) -> None:
        """Trace the functions.

        Each is a `casadi.Function`, or a Python function that takes columns of `casadi.SX` and returns one,
        or a list of scalars. With parameters, each takes them as its last argument p.

        Args:
            step: Function (x, u) that returns the next state; `runge_kutta` makes one of a rate.
            stage_cost: Function (x, u) that returns a scalar, with a positive second derivative by each
                control; it is not multiplied by the time step.
            terminal_cost: Function (x) that returns a scalar.
            initial_state: State at stage 0 unless `solve` is given another, shape (n_x,).
            n_controls: Number n_u of controls.
            horizon: Number N of stages.
            time_step: Duration of a stage, s; it enters no equation.
            control_lower: Lower bounds, shape (n_u,), (N, n_u) or (); None for none.
            control_upper: Upper bounds, shape (n_u,), (N, n_u) or (); None for none.
            parameters: Nominal values of what varies between solves or stages, shape (n_p,).

        Raises:
            TypeError: If a function returns something other than CasADi's expressions or numbers.
            ValueError: If sizes, bounds or numbers contradict each other, a function returns another size, or
                an expression holds symbols that are not among its arguments.
            NotImplementedError: If an expression holds an operation that does not compile, such as `erf`.
        """
        bounds = control_lower, control_upper
        super().__init__(initial_state, n_controls, horizon, time_step, bounds, parameters)
        sizes = {"x": self.n_states, "u": n_controls, "p": self.parameters.nominal.size}
        self._x, self._u, p = (casadi.SX.sym(name, size) for name, size in sizes.items())
        self._parameters = {"p": p} if sizes["p"] else {}
        point, end = (self._x, self._u, *self._parameters.values()), (self._x, *self._parameters.values())
        self._step = _expression("step", step, point, self.n_states)
        self._cost = _expression("stage_cost", stage_cost, point, 1)
        self._terminal_cost = _expression("terminal_cost", terminal_cost, end, 1)
        self._mixed = casadi.sparsify(casadi.jacobian(casadi.gradient(self._cost, self._u), self._x))

    @property
    def has_mixed_cost(self) -> bool:
        """Whether the stage cost has a second derivative by state and control."""
        return bool(self._mixed.nnz() > 0)

    def _make(self, name: str, batched: bool) -> Kernel | None:
        state = {"x": self._x, **self._parameters}
        point = {**state, "u": self._u}
        if name in ("step_with_cost", "linearize"):
            inputs = {**point, "h": casadi.SX.sym("h")}
            return compiled(name, inputs, getattr(self, f"_{name}")(), batched)
        if name == "lagrangian_hessian":
            multiplier = casadi.SX.sym("multiplier", self.n_states)
            lagrangian = self._cost + casadi.dot(multiplier, self._step)
            inputs = {**point, "multiplier": multiplier, "h": casadi.SX.sym("h")}
            return compiled(name, inputs, self._second_derivatives(lagrangian), batched)
        if name == "cost_derivatives":
            return compiled(name, point, self._cost_derivatives(), batched)
        if name == "terminal_cost":
            return compiled(name, state, {"cost": casadi.densify(self._terminal_cost)}, batched)
        hessian, gradient = casadi.hessian(self._terminal_cost, self._x)
        if name == "terminal_cost_derivatives":
            return compiled(name, state, {"lx": gradient, "lxx": casadi.sparsify(hessian)}, batched)
        if name == "terminal_cost_hessian":
            return compiled(name, state, {"Lxx": casadi.sparsify(hessian)}, batched)
        return None

    def _step_with_cost(self) -> dict[str, Matrix]:
        return {"x_next": casadi.densify(self._step), "cost": casadi.densify(self._cost)}

    def _linearize(self) -> dict[str, Matrix]:
        return {
            "A": casadi.sparsify(casadi.jacobian(self._step, self._x)),
            "B": casadi.sparsify(casadi.jacobian(self._step, self._u)),
        }

    def _cost_derivatives(self) -> dict[str, Matrix]:
        hessian = self._second_derivatives(self._cost)
        derivatives = {
            "lx": casadi.gradient(self._cost, self._x),
            "lu": casadi.gradient(self._cost, self._u),
            "lxx": hessian["Lxx"],
            "luu": hessian["Luu"],
        }
        return {**derivatives, "lux": hessian["Lux"]} if self.has_mixed_cost else derivatives

    def _second_derivatives(self, scalar: Matrix) -> dict[str, Matrix]:
        """Hessian of a scalar by state and control, in blocks."""
        hessian, _ = casadi.hessian(scalar, casadi.vertcat(self._x, self._u))
        hessian, n = casadi.sparsify(hessian), self.n_states
        return {"Lxx": hessian[:n, :n], "Lux": hessian[n:, :n], "Luu": hessian[n:, n:]}


def _expression(name: str, function: Function, arguments: tuple[Matrix, ...], size: int) -> Matrix:
    """The column of a function's results, checked."""
    try:
        value: Any = function(*arguments)
    except RuntimeError as error:
        if "truth value" not in str(error):
            raise
        raise TypeError(
            f"{name} branches on a symbol, as in `if x[0] > 0`: use "
            "casadi.if_else(condition, if_true, if_false), or PythonProblem"
        ) from error
    try:
        if isinstance(value, list | tuple | np.ndarray):
            value = casadi.vertcat(*value)
        column = casadi.SX(value)
    except (NotImplementedError, TypeError) as error:
        raise TypeError(
            f"{name} returns {type(value).__name__}; expected CasADi's SX, or a list of scalars, of its "
            "arguments"
        ) from error
    if column.shape == (1, size):
        column = column.T
    if column.shape != (size, 1):
        wanted = (
            "a scalar" if size == 1 and name != "step" else f"{size} numbers, one for each of initial_state"
        )
        raise ValueError(f"{name} returns an expression of shape {column.shape}; expected {wanted}")
    traced = casadi.Function(name, list(arguments), [column], {"allow_free": True})
    if free := traced.free_sx():
        raise ValueError(
            f"{name} holds the symbols {', '.join(map(str, free))}, which are not among its "
            "arguments; give numbers, or `parameters`"
        )
    if (operation := unknown_operation(traced)) is not None:
        raise NotImplementedError(
            f"{name} holds CasADi's {operation}, which does not compile: write it by other functions, or use "
            "PythonProblem"
        )
    return column
