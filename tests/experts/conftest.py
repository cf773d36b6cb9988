"""Small problems whose kernels are Python functions behind the native calling convention."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dq_space_arm_env import Scene, load_scene
from experts.problems.shooting_problem import StageParameters

Array = NDArray[np.float64]
NATIVE_SIGNATURE = ctypes.CFUNCTYPE(
    None, ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.POINTER(ctypes.c_double))
)


@pytest.fixture(scope="session")
def varying_scene() -> Scene:
    """A maneuver of 15 s; target, two links, and springs and dampers of the joints are inputs."""
    joints = [f"links.{index}.{part}" for index in range(3) for part in ("stiffness", "damping")]
    loads = [f"links.{index}.{part}" for index in (1, 2) for part in ("mass", "inertia")]
    varying = ["target.pose", *loads, *joints]
    return load_scene("planar").replace(simulation={"dt": 0.1, "steps": 150}, parameters=varying)


class PythonKernel:
    """Calls `function(*rows)` for every row; outputs are arrays to be filled in place."""

    def __init__(
        self, function: Callable[..., None], shapes: list[tuple[int, ...]], shared: int = -1
    ) -> None:
        def run(begin: int, end: int, buffers: Any) -> None:
            assert 0 <= begin <= end
            tables = [np.ctypeslib.as_array(buffers[i], (end, *shape)) for i, shape in enumerate(shapes)]
            for k in range(begin, end):
                function(*(table[0 if i == shared else k] for i, table in enumerate(tables)))

        self._callback = NATIVE_SIGNATURE(run)
        self.address = ctypes.cast(self._callback, ctypes.c_void_p).value


@dataclass
class PythonProblem:
    """A shooting problem from Python functions of one stage."""

    n_states: int
    n_tangent: int
    n_controls: int
    horizon: int
    time_step: float
    control_lower: Array
    control_upper: Array
    initial_state: Array
    difference: Callable[[Array, Array], Array]
    step: Callable[[Array, Array, float], Array]
    cost: Callable[[Array, Array], float]
    terminal_cost: Callable[[Array], float]
    linearize: Callable[[Array, Array, float], tuple[Array, Array]]
    cost_derivatives: Callable[[Array, Array], tuple[Array, Array, Array, Array]]
    terminal_cost_derivatives: Callable[[Array], tuple[Array, Array]]
    terminal_inputs: tuple[Array, ...] = ()
    has_mixed_cost: bool = False
    lagrangian_hessian: Callable[[Array, Array, Array, float], tuple[Array, Array, Array]] | None = None
    terminal_cost_hessian: Callable[[Array], Array] | None = None
    retract: Callable[[Array, Array], Array] | None = None

    @property
    def has_second_order(self) -> bool:
        return self.lagrangian_hessian is not None

    @property
    def has_retraction(self) -> bool:
        return self.retract is not None

    def __post_init__(self) -> None:
        self.parameters = StageParameters(self.horizon)
        x, t, u, one = (self.n_states,), (self.n_tangent,), (self.n_controls,), (1,)
        tt, tu, uu = t + t, t + u, u + u

        def fill(function: Callable[..., Any]) -> Callable[..., None]:
            def run(n_inputs: int, *rows: Array) -> None:
                results = function(*rows[:n_inputs])
                for target, value in zip(rows[n_inputs:], results, strict=True):
                    target[...] = value

            return run

        def kernel(
            function: Callable[..., Any], inputs: list[Any], outputs: list[Any], shared: int = -1
        ) -> Any:
            run = fill(function)
            return PythonKernel(lambda *rows: run(len(inputs), *rows), inputs + outputs, shared)

        self._kernels = {
            "difference": kernel(lambda r, y: (self.difference(r, y),), [x, x], [t]),
            "step_with_cost": kernel(
                lambda y, v, h: (self.step(y, v, h[0]), self.cost(y, v)), [x, u, one], [x, one], shared=2
            ),
            "terminal_cost": kernel(lambda y: (self.terminal_cost(y),), [x], [one]),
            "linearize": kernel(lambda y, v, h: self.linearize(y, v, h[0]), [x, u, one], [tt, tu], shared=2),
            "cost_derivatives": kernel(self.cost_derivatives, [x, u], [t, u, tt, uu]),
            "terminal_cost_derivatives": kernel(self.terminal_cost_derivatives, [x], [t, tt]),
        }
        if self.lagrangian_hessian is not None and self.terminal_cost_hessian is not None:
            exact, terminal = self.lagrangian_hessian, self.terminal_cost_hessian
            self._kernels["lagrangian_hessian"] = kernel(
                lambda y, v, m, h: exact(y, v, m, h[0]), [x, u, t, one], [tt, u + t, uu], shared=3
            )
            self._kernels["terminal_cost_hessian"] = kernel(lambda y: (terminal(y),), [x], [tt])
        if self.retract is not None:
            retract = self.retract
            self._kernels["retract"] = kernel(lambda y, z: (retract(y, z),), [x, t], [x])

    def kernel(self, name: str, *, batched: bool = False) -> PythonKernel:
        return self._kernels[name]


@dataclass
class LinearQuadratic:
    """Matrices of x+ = A x + B u, cost 1/2 (x'Qx + u'Ru) per stage and 1/2 x'Px at the end."""

    A: Array
    B: Array
    Q: Array
    R: Array
    P: Array
    horizon: int
    initial_state: Array

    def problem(self, limit: float = np.inf) -> PythonProblem:
        n, m = self.B.shape
        return PythonProblem(
            n_states=n,
            n_tangent=n,
            n_controls=m,
            horizon=self.horizon,
            time_step=1.0,
            control_lower=np.full(m, -limit),
            control_upper=np.full(m, limit),
            initial_state=self.initial_state,
            difference=lambda reference, x: x - reference,
            step=lambda x, u, h: self.A @ x + self.B @ u,
            cost=lambda x, u: 0.5 * (x @ self.Q @ x + u @ self.R @ u),
            terminal_cost=lambda x: 0.5 * x @ self.P @ x,
            linearize=lambda x, u, h: (self.A, self.B),
            cost_derivatives=lambda x, u: (self.Q @ x, self.R @ u, self.Q, self.R),
            terminal_cost_derivatives=lambda x: (self.P @ x, self.P),
            retract=lambda x, dx: x + dx,
        )

    def condensed(self, initial_state: Array) -> tuple[Array, Array, float]:
        """Eliminate the states: the cost is 1/2 U'HU + g'U + c for the stacked controls U."""
        n, m = self.B.shape
        free = [initial_state]
        response = [np.zeros((n, m * self.horizon))]
        for k in range(self.horizon):
            free.append(self.A @ free[-1])
            response.append(self.A @ response[-1])
            response[-1][:, k * m : (k + 1) * m] = self.B
        weights = [self.Q] * self.horizon + [self.P]
        H = np.kron(np.eye(self.horizon), self.R)
        H = H + sum(G.T @ W @ G for G, W in zip(response, weights, strict=True))
        g = sum(G.T @ W @ x for G, W, x in zip(response, weights, free, strict=True))
        c = 0.5 * sum(x @ W @ x for W, x in zip(weights, free, strict=True))
        return H, g, float(c)


@pytest.fixture
def double_integrator() -> LinearQuadratic:
    h = 0.1
    return LinearQuadratic(
        A=np.array([[1.0, h], [0.0, 1.0]]),
        B=np.array([[0.5 * h * h], [h]]),
        Q=np.diag([1.0, 0.1]) * h,
        R=np.array([[0.05]]) * h,
        P=np.diag([10.0, 1.0]),
        horizon=40,
        initial_state=np.array([1.0, -0.3]),
    )


@pytest.fixture
def coupled_masses() -> LinearQuadratic:
    """Two masses, two springs, three inputs of which two pull the same mass."""
    h = 0.1
    stiffness = np.array([[2.0, -1.0], [-1.0, 1.0]])
    A = np.eye(4) + h * np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, np.zeros((2, 2))]])
    B = h * np.vstack([np.zeros((2, 3)), [[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]]])
    return LinearQuadratic(
        A=A,
        B=B,
        Q=h * np.diag([1.0, 2.0, 0.1, 0.1]),
        R=h * np.diag([0.1, 0.02, 0.3]),
        P=np.diag([20.0, 10.0, 1.0, 1.0]),
        horizon=25,
        initial_state=np.array([1.0, -0.5, 0.2, 0.0]),
    )


@pytest.fixture
def pendulum() -> PythonProblem:
    """Swing-up of a pendulum whose motor is too weak to lift it: state (angle from upright, rate)."""
    gravity, weight = 9.81, np.array([[0.01]])
    terminal = np.diag([50.0, 5.0])

    def step(x: Array, u: Array, h: float) -> Array:
        rate = x[1] + h * (gravity * np.sin(x[0]) + u[0])
        return np.array([x[0] + h * rate, rate])

    def linearize(x: Array, u: Array, h: float) -> tuple[Array, Array]:
        rate = np.array([h * gravity * np.cos(x[0]), 1.0])
        return np.array([np.array([1.0, 0.0]) + h * rate, rate]), np.array([[h * h], [h]])

    def lagrangian_hessian(x: Array, u: Array, m: Array, h: float) -> tuple[Array, Array, Array]:
        curvature = -(h * m[0] + m[1]) * h * gravity * np.sin(x[0])
        return np.diag([curvature, 0.0]), np.zeros((1, 2)), weight

    return PythonProblem(
        n_states=2,
        n_tangent=2,
        n_controls=1,
        horizon=120,
        time_step=0.025,
        control_lower=np.array([-5.0]),
        control_upper=np.array([5.0]),
        initial_state=np.array([np.pi, 0.0]),
        difference=lambda reference, x: x - reference,
        step=step,
        cost=lambda x, u: 0.5 * u @ weight @ u,
        terminal_cost=lambda x: 0.5 * x @ terminal @ x,
        linearize=linearize,
        cost_derivatives=lambda x, u: (np.zeros(2), weight @ u, np.zeros((2, 2)), weight),
        terminal_cost_derivatives=lambda x: (terminal @ x, terminal),
        lagrangian_hessian=lagrangian_hessian,
        terminal_cost_hessian=lambda x: terminal,
        retract=lambda x, dx: x + dx,
    )


@pytest.fixture
def unicycle() -> PythonProblem:
    """Parking of a unicycle: state (cos, sin, x, y), tangent (turn, dx, dy), inputs (speed, turn rate)."""
    weight, running, terminal = np.diag([0.02, 0.01]), 0.01 * np.eye(3), np.diag([20.0, 40.0, 40.0])
    target = np.array([1.0, 0.0, 0.0, 0.0])

    def difference(reference: Array, x: Array) -> Array:
        sine = reference[0] * x[1] - reference[1] * x[0]
        return np.array([np.arctan2(sine, reference[:2] @ x[:2]), *(x[2:] - reference[2:])])

    def retract(x: Array, dx: Array) -> Array:
        c, s = np.array([np.cos(dx[0]), np.sin(dx[0])]) / np.hypot(x[0], x[1])
        return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1], *(x[2:] + dx[1:])])

    def step(x: Array, u: Array, h: float) -> Array:
        c, s = np.cos(h * u[1]), np.sin(h * u[1])
        return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1], *(x[2:] + h * u[0] * x[:2])])

    def linearize(x: Array, u: Array, h: float) -> tuple[Array, Array]:
        A = np.array([[1.0, 0.0, 0.0], [-h * u[0] * x[1], 1.0, 0.0], [h * u[0] * x[0], 0.0, 1.0]])
        return A, np.array([[0.0, h], [h * x[0], 0.0], [h * x[1], 0.0]])

    def cost(x: Array, u: Array) -> float:
        error = difference(target, x)
        return 0.5 * (error @ running @ error + u @ weight @ u)

    return PythonProblem(
        n_states=4,
        n_tangent=3,
        n_controls=2,
        horizon=80,
        time_step=0.05,
        control_lower=np.array([-1.0, -1.5]),
        control_upper=np.array([1.0, 1.5]),
        initial_state=np.array([0.0, 1.0, 0.3, 1.0]),
        difference=difference,
        step=step,
        cost=cost,
        terminal_cost=lambda x: 0.5 * difference(target, x) @ terminal @ difference(target, x),
        linearize=linearize,
        cost_derivatives=lambda x, u: (running @ difference(target, x), weight @ u, running, weight),
        terminal_cost_derivatives=lambda x: (terminal @ difference(target, x), terminal),
        retract=retract,
    )


@pytest.fixture
def unstable(double_integrator: LinearQuadratic) -> PythonProblem:
    """A mass that an accelerating force drives away: without control its rate is soon beyond all numbers."""
    problem = double_integrator.problem()
    h = 0.1

    def step(x: Array, u: Array, _: float) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):
            rate = x[1] + h * (x[0] ** 3 + u[0])
            return np.array([x[0] + h * rate, rate])

    def linearize(x: Array, u: Array, _: float) -> tuple[Array, Array]:
        rate = np.array([3.0 * h * x[0] ** 2, 1.0])
        return np.array([np.array([1.0, 0.0]) + h * rate, rate]), np.array([[h * h], [h]])

    return replace(problem, step=step, linearize=linearize, initial_state=np.array([3.0, 1.0]))
