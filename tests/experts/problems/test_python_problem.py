"""Users' problems in NumPy: the same as in CasADi, differences, and exceptions that come through."""

import gc
import math
import os
import signal
import threading

import casadi
import numpy as np
import pytest

from experts import BoxDDP, CasadiProblem, GuidedDDP, PythonProblem, runge_kutta
from experts.problems.differences import hessian, jacobian

STEP, HORIZON = 0.05, 40


def rate(library):
    """Pendulum with a motor: angle from upright and rate."""
    return lambda x, u, p: [x[1], p[0] * library.sin(x[0]) + u[0]]


def stage_cost(x, u, p):
    return STEP * (0.1 * u[0] ** 2 + 0.01 * x[1] ** 2 + 0.002 * x[1] * u[0])


def terminal_cost(x, p):
    return p[1] * x[0] ** 2 + 5.0 * x[1] ** 2


def functions(library):
    return runge_kutta(rate(library), STEP), stage_cost, terminal_cost


SETTINGS = {
    "initial_state": [2.5, 0.0],
    "n_controls": 1,
    "horizon": HORIZON,
    "control_lower": -5.0,
    "control_upper": 5.0,
    "parameters": [9.81, 50.0],
}


def pendulum(**changes):
    """The problem with some functions or settings replaced."""
    step, cost, end = functions(np)
    given = {"step": step, "stage_cost": cost, "terminal_cost": end, **SETTINGS}
    return PythonProblem(**{**given, **changes})


@pytest.fixture
def no_finalizers():
    """Python loses an interrupt that comes while it runs one."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(scope="module")
def twin():
    """The same problem in CasADi."""
    return CasadiProblem(*functions(casadi), **SETTINGS)


@pytest.fixture(scope="module")
def derivatives(twin):
    """Exact derivatives, as functions of NumPy."""
    x, u, p, m = (casadi.SX.sym(name, size) for name, size in zip("xupm", (2, 1, 2, 2), strict=True))
    step, cost, end = (
        casadi.vertcat(functions(casadi)[0](x, u, p)),
        stage_cost(x, u, p),
        terminal_cost(x, p),
    )

    def of(arguments, *results):
        function = casadi.Function("f", arguments, [casadi.densify(result) for result in results])
        flat = [result.shape[1] == 1 and result.shape[0] == 2 for result in results]

        def call(*values):
            found = [np.array(value) for value in function.call(values)]
            return [value.ravel() if is_flat else value for value, is_flat in zip(found, flat, strict=True)]

        return call

    def blocks(scalar):
        hessian, gradient = casadi.hessian(scalar, casadi.vertcat(x, u))
        return gradient, hessian[:2, :2], hessian[2:, :2], hessian[2:, 2:]

    slope, *bends = blocks(cost)
    stage = of([x, u, p], slope[:2], *bends)
    slope_by_control = of([x, u, p], slope[2:])
    hessian, gradient = casadi.hessian(end, x)
    _, *exact = blocks(cost + casadi.dot(m, step))

    def stage_cost_derivatives(*given):
        lx, *others = stage(*given)
        return lx, slope_by_control(*given)[0].ravel(), *others

    linear = of([x, u, p], casadi.jacobian(step, x), casadi.jacobian(step, u))
    return {
        "linearize": lambda *given: [matrix.reshape(2, -1) for matrix in linear(*given)],
        "stage_cost_derivatives": stage_cost_derivatives,
        "terminal_cost_derivatives": of([x, p], gradient, hessian),
        "lagrangian_hessian": of([x, u, m, p], *exact),
    }


@pytest.fixture(scope="module")
def expected(twin):
    return BoxDDP(twin, tolerance=1e-12).solve()


def test_differences_have_the_digits_they_claim():
    def curved(x):
        return np.array([np.exp(x[0]) * np.sin(x[1]), x[0] * x[1]])

    x = np.array([0.3, 0.8])
    e, s, c = np.exp(0.3), np.sin(0.8), np.cos(0.8)
    np.testing.assert_allclose(jacobian(curved, x), [[e * s, e * c], [0.8, 0.3]], rtol=3e-10)
    bend = [[e * s, e * c], [e * c, -e * s]]
    np.testing.assert_allclose(hessian(lambda x: curved(x)[0], x), bend, rtol=3e-7)
    far = np.array([3.0, -200.0])  # the cost's rounding sets the error
    found = hessian(lambda x: x @ x + x[0] * x[1], far)
    np.testing.assert_allclose(found, [[2.0, 1.0], [1.0, 2.0]], rtol=0, atol=1e-7 * (far @ far))
    np.testing.assert_allclose(jacobian(lambda x: x @ x, far), 2.0 * far, rtol=0, atol=1e-10 * (far @ far))


def test_differences_lead_to_the_same_optimum(expected):
    solution = BoxDDP(pendulum()).solve()
    assert solution.converged
    assert np.abs(solution.controls).max() == 5.0
    assert solution.cost == pytest.approx(expected.cost, rel=1e-6)


def test_given_derivatives_make_the_same_steps(twin, expected, derivatives):
    problem = pendulum(**derivatives)
    assert problem.has_second_order
    solution = BoxDDP(problem, tolerance=1e-12).solve()
    assert (solution.converged, solution.iterations) == (True, expected.iterations)
    assert solution.cost == pytest.approx(expected.cost, rel=1e-12)
    np.testing.assert_allclose(solution.controls, expected.controls, rtol=0, atol=1e-6)
    np.testing.assert_allclose(solution.feedback_gains, expected.feedback_gains, rtol=0, atol=1e-4)


def test_every_solver_takes_the_problem(expected):
    problem = pendulum()
    guess = np.linspace(problem.initial_state, np.zeros(2), HORIZON + 1)
    shot = BoxDDP(problem, threads=2).solve(x_init=guess)
    guided = GuidedDDP(problem, library=[expected]).solve(np.array([2.4, 0.1]))
    zero = GuidedDDP(problem, library=[]).solve()
    assert shot.converged
    assert guided.converged
    assert guided.metadata["guess"] == "policy 0"
    assert zero.cost == pytest.approx(expected.cost, rel=1e-4)
    assert shot.policy()(shot.states[3], 3) == pytest.approx(shot.controls[3])


def test_functions_may_keep_their_arguments_but_not_change_them():
    step, kept = functions(np)[0], []

    def keeping(x, u, p):
        kept.append(x)
        return step(x, u, p)

    solver = BoxDDP(pendulum(step=keeping), max_iterations=0)
    kept.clear()
    solution = solver.solve()
    np.testing.assert_array_equal(kept[:HORIZON], solution.states[:-1])

    def careless(x, u, p):
        x += 1.0
        return x

    with pytest.raises(ValueError, match="read-only"):
        pendulum(step=careless)


class OwnError(Exception):
    """Raised by a user's function."""


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", ["step", "stage_cost", "terminal_cost"])
def test_exceptions_reach_the_user(name, threads):
    original = dict(zip(("step", "stage_cost", "terminal_cost"), functions(np), strict=True))[name]
    calls, limit = [0], 10**9

    def failing(*given):
        calls[0] += 1
        if calls[0] > limit:
            raise OwnError(name)
        return original(*given)

    problem = pendulum(horizon=300, **{name: failing})
    solver = BoxDDP(problem, threads=threads, max_iterations=1)
    calls[0], limit = 0, 10 if name == "terminal_cost" else 900  # in the midst of derivatives
    with pytest.raises(OwnError, match=name) as caught:
        solver.solve()
    assert any(entry.name == "failing" for entry in caught.traceback)
    calls[0], limit = 0, 10**9
    after = solver.solve()  # nothing is left of the failure
    assert after.cost == BoxDDP(pendulum(horizon=300), max_iterations=1).solve().cost


def test_a_result_of_another_shape_in_mid_solve_is_not_spread_over_the_state():
    problem = PythonProblem(
        lambda x, u: x + u if x[0] == 1.0 else x[0] + u[0],
        lambda x, u: u @ u,
        lambda x: x @ x,
        initial_state=[1.0, 2.0],
        n_controls=2,
        horizon=3,
        linearize=lambda x, u: (np.eye(2), np.eye(2)),
    )
    with pytest.raises(ValueError, match=r"returns an array of shape \(\); expected \(2,\)"):
        BoxDDP(problem).solve(u_init=np.ones((3, 2)))


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("delay", [0.03, 0.1, 0.17])
def test_an_interrupt_ends_the_solve_with_its_best_trajectory(delay, no_finalizers):
    BoxDDP(pendulum()).solve()  # all code is loaded: Numba, which loads it, has finalizers of its own
    solver = BoxDDP(pendulum(), max_iterations=10**6, tolerance=0.0, plateau_decrease=0.0)
    begun = threading.Event()

    def press():
        begun.wait(20.0)
        threading.Event().wait(delay)
        os.kill(os.getpid(), signal.SIGINT)

    presser = threading.Thread(target=press)
    presser.start()
    solution = solver.solve(callback=lambda record: begun.set())
    presser.join()
    assert solution.stop_reason == "interrupted"
    assert np.isfinite(solution.cost)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("changes", "stage", "culprit"),
    [
        ({"step": lambda x, u, p: x + np.nan}, 0, "the step"),
        ({"stage_cost": lambda x, u, p: np.nan}, 0, "the stage cost"),
        ({"terminal_cost": lambda x, p: np.nan}, "N", "the terminal cost"),
    ],
)
def test_numbers_that_are_not_finite_end_the_solve_and_the_function_is_named(changes, stage, culprit):
    problem = pendulum(**changes)
    solution = BoxDDP(problem).solve()
    stage = problem.horizon if stage == "N" else stage
    assert (solution.stop_reason, solution.message) == (
        "diverged",
        f"the first rollout is not finite from stage {stage} on: {culprit} is not",
    )


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"step": lambda x, u, p: x[0]}, ValueError, r"^step has shape \(\); expected \(2,\)"),
        (
            {"stage_cost": lambda x, u, p: u**2},
            ValueError,
            r"^stage_cost has shape \(1,\); expected \(\), a single number, such as u\[0\] \*\* 2",
        ),
        ({"terminal_cost": lambda x, p: "1"}, TypeError, "^terminal_cost: of type"),
        ({"terminal_cost": lambda x, p: 1j}, TypeError, "^terminal_cost: of type complex128"),
        ({"linearize": lambda x, u, p: (np.eye(2), np.ones(2))}, ValueError, r"B has shape \(2,\); expected"),
        ({"linearize": lambda x, u, p: (np.eye(2),)}, ValueError, "linearize has 1 results; expected A, B"),
        (
            {"terminal_cost_derivatives": lambda x, p: (x, x)},
            ValueError,
            r"derivatives: lxx has shape \(2,\)",
        ),
        ({"stage_cost_derivatives": lambda x, u, p: (x, u)}, ValueError, "not enough values"),
        ({"control_upper": -6.0}, ValueError, "the lower one must not exceed the upper one"),
        ({"initial_state": []}, ValueError, "n_states is 0"),
    ],
)
def test_contradictions_are_refused(changes, error, sentence):
    with pytest.raises(error, match=sentence):
        pendulum(**changes)


def test_bounds_are_copies():
    upper = np.array([5.0])
    problem = pendulum(control_upper=upper)
    upper[0] = -7.0
    assert problem.control_upper == 5.0


def test_steps_that_diverge_are_not_gone_on_with():
    """Functions of the math module raise where those of NumPy return NaN."""

    def problem(sin):
        def step(x, u):
            assert np.isfinite(x).all()
            return [x[0] + 0.1 * (np.exp(u[0]) - 1.0 + 0.1 * sin(x[0]) + x[0] ** 3)]

        return PythonProblem(
            step,
            lambda x, u: 1e-4 * u[0] ** 2 + (x[0] - 2.0) ** 2,
            lambda x: (x[0] - 2.0) ** 2,
            initial_state=[0.0],
            n_controls=1,
            horizon=20,
        )

    with np.errstate(over="ignore", invalid="ignore"):
        solutions = [BoxDDP(problem(sin)).solve() for sin in (np.sin, math.sin)]
    assert solutions[0].converged
    assert solutions[1].cost == solutions[0].cost
