"""Users' problems in CasADi: derivatives, optima that IPOPT finds too, and what is refused."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env.kernels.bound import buffer_table, run_kernel
from experts import BoxDDP, CasadiProblem, GuidedDDP, PythonProblem, RecedingHorizonExpert, runge_kutta
from scripts.examples import cart_pole as cart_pole_example
from scripts.examples import planar_quadrotor as quadrotor_example
from scripts.examples.cart_pole import cart_pole
from scripts.examples.planar_quadrotor import HOVER, planar_quadrotor

H = 1e-6


def run(problem, name, *inputs, outputs, batched=False):
    """Results of a kernel, for inputs with a row each; `h` is appended where it belongs."""
    arrays = [np.ascontiguousarray(array, dtype=np.float64) for array in inputs]
    rows = len(arrays[0])
    results = [np.zeros((rows, *shape)) for shape in outputs]
    kernel = problem.kernel(name, batched=batched)
    run_kernel(kernel.address, 0, rows, buffer_table(*arrays, *results))
    return results


def central(function, x):
    """Derivatives (..., n) by central differences."""
    return np.stack([(function(x + H * e) - function(x - H * e)) / (2 * H) for e in np.eye(len(x))], axis=-1)


def small(**changes):
    """A problem of every kind of term: a coupled, nonconvex cost, parameters, functions of the C library."""
    settings = {
        "step": lambda x, u, p: [x[0] + 0.1 * x[1], x[1] + 0.1 * casadi.tanh(p[0] * x[0] + u[0] * u[1])],
        "stage_cost": lambda x, u, p: (
            casadi.exp(0.1 * x[0]) + 0.3 * x[1] * u[0] + casadi.sumsqr(u) - casadi.cos(p[1] * x[1])
        ),
        "terminal_cost": lambda x, p: p[1] * x[0] ** 4 + x[1] ** 2 + x[0] * x[1],
        "initial_state": [1.0, -0.5],
        "n_controls": 2,
        "horizon": 20,
        "control_lower": [-0.5, -np.inf],
        "parameters": [0.7, 1.3],
    }
    return CasadiProblem(**{**settings, **changes})


# Derivatives ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batched", [False, True])
def test_derivatives_are_those_of_step_and_costs(batched):
    problem, rng, rows, h = small(), np.random.default_rng(0), 11, [[0.1]]
    x, u, multiplier = (rng.normal(size=(rows, 2)) for _ in range(3))
    p = rng.uniform(0.5, 1.5, size=(rows, 2))
    vectors, matrix = [(2,), (2,)], (2, 2)
    found_a, found_b = run(problem, "linearize", x, p, u, h, outputs=[matrix, matrix], batched=batched)
    lx, lu, lxx, luu, lux = run(
        problem, "cost_derivatives", x, p, u, outputs=[*vectors, *[matrix] * 3], batched=batched
    )
    exact = run(problem, "lagrangian_hessian", x, p, u, multiplier, h, outputs=[matrix] * 3, batched=batched)
    end_lx, end_lxx = run(problem, "terminal_cost_derivatives", x, p, outputs=[(2,), matrix])
    (end_exact,) = run(problem, "terminal_cost_hessian", x, p, outputs=[matrix])
    for k in range(rows):

        def step(z, k=k):
            return run(problem, "step_with_cost", z[None, :2], p[k : k + 1], z[None, 2:], h, outputs=vectors)

        def gradient(z, k=k):
            given = z[None, :2], p[k : k + 1], z[None, 2:]
            slopes = run(problem, "cost_derivatives", *given, outputs=[*vectors, *[matrix] * 3])[:2]
            a, b = run(problem, "linearize", *given, h, outputs=[matrix, matrix])
            weighted = np.concatenate([multiplier[k] @ a[0], multiplier[k] @ b[0]])
            return np.concatenate([slopes[0][0], slopes[1][0]]), weighted

        z = np.concatenate([x[k], u[k]])
        by = central(lambda z: step(z)[0][0], z)
        np.testing.assert_allclose(np.hstack([found_a[k], found_b[k]]), by, rtol=0, atol=1e-8)
        slopes = central(lambda z: step(z)[1][0, 0], z)
        np.testing.assert_allclose(np.concatenate([lx[k], lu[k]]), slopes, rtol=0, atol=1e-8)
        cost_bend, step_bend = (central(lambda z, i=i: gradient(z)[i], z) for i in range(2))
        found = np.block([[lxx[k], lux[k].T], [lux[k], luu[k]]])
        np.testing.assert_allclose(found, cost_bend, rtol=0, atol=1e-8)
        lagrangian = np.block([[exact[0][k], exact[1][k].T], [exact[1][k], exact[2][k]]])
        np.testing.assert_allclose(lagrangian, cost_bend + step_bend, rtol=0, atol=1e-8)

        def end(y, k=k):
            return run(problem, "terminal_cost", y[None], p[k : k + 1], outputs=[(1,)])[0][0, 0]

        np.testing.assert_allclose(end_lx[k], central(end, x[k]), rtol=1e-6, atol=1e-8)
        assert np.array_equal(end_lxx[k], end_exact[k])
    corner = run(problem, "terminal_cost_derivatives", [[1.0, 0.0]], [[0.0, 2.0]], outputs=[(2,), matrix])
    assert corner[0].tolist() == [[8.0, 1.0]]
    assert corner[1].tolist() == [[[24.0, 1.0], [1.0, 2.0]]]


def test_functions_of_casadi_make_the_same_problem():
    x, u = casadi.MX.sym("x", 4), casadi.MX.sym("u", 1)
    plain = cart_pole()
    step, cost, end = (
        casadi.Function("step", [x, u], [runge_kutta(cart_pole_example.rate, 0.02)(x, u)]),
        casadi.Function("cost", [x, u], [cart_pole_example.stage_cost(x, u)]),
        casadi.Function("end", [x], [cart_pole_example.terminal_cost(x)]),
    )
    settings = {"control_lower": -8.0, "control_upper": [8.0]}
    problem = CasadiProblem(step, cost, end, initial_state=[0] * 4, n_controls=1, horizon=150, **settings)
    expected, found = (BoxDDP(each, max_iterations=5).solve() for each in (plain, problem))
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)


# Optima ---------------------------------------------------------------------------------------------------


def optimum_of_ipopt(problem, example, solution, p=()):
    """Cost and controls that IPOPT finds for the same steps and costs, from a slightly wrong guess."""
    step = runge_kutta(example.rate, example.TIME_STEP)
    opti = casadi.Opti()
    x = opti.variable(problem.n_states, problem.horizon + 1)
    u = opti.variable(problem.n_controls, problem.horizon)
    opti.subject_to(x[:, 0] == problem.initial_state)
    cost = example.terminal_cost(x[:, -1], *p)
    for k in range(problem.horizon):
        opti.subject_to(x[:, k + 1] == step(x[:, k], u[:, k], *p))
        opti.subject_to(opti.bounded(problem.control_lower, u[:, k], problem.control_upper))
        cost += example.stage_cost(x[:, k], u[:, k], *p)
    opti.minimize(cost)
    opti.set_initial(x, 0.99 * solution.states.T)
    opti.set_initial(u, 0.99 * solution.controls.T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "tol": 1e-10})
    found = opti.solve()
    return found.value(cost), np.reshape(found.value(u), (problem.n_controls, -1)).T


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("second_order", "tolerance", "gap"),
    [("gauss_newton", 1e-7, 1e-5), ("hybrid", 1e-12, 1e-7)],
)
def test_cart_pole_swings_up_as_ipopt_does(second_order, tolerance, gap):
    problem = cart_pole()
    solution = BoxDDP(problem, second_order=second_order, tolerance=tolerance).solve()
    assert solution.converged
    assert np.abs(solution.states[-1] - cart_pole_example.UPRIGHT).max() < 0.02
    assert np.abs(solution.controls).max() == 8.0
    cost, controls = optimum_of_ipopt(problem, cart_pole_example, solution)
    assert solution.cost == pytest.approx(cost, rel=gap)
    np.testing.assert_allclose(solution.controls, controls, rtol=0, atol=20.0 * np.sqrt(gap))


def test_quadrotor_flies_as_ipopt_does_to_any_target():
    problem, target = planar_quadrotor(), [1.0, 0.5]
    solution = BoxDDP(problem, tolerance=1e-12).solve(u_init=np.full((100, 2), HOVER), parameters=target)
    assert solution.converged
    assert (solution.controls == 0.0).any()
    cost, _ = optimum_of_ipopt(problem, quadrotor_example, solution, (casadi.DM(target),))
    assert solution.cost == pytest.approx(cost, rel=1e-7)


@pytest.mark.parametrize("second_order", ["gauss_newton", "hybrid", "exact"])
def test_costs_that_couple_states_and_controls_converge(second_order):
    problem = small(control_upper=0.4)
    assert problem.has_mixed_cost
    assert not cart_pole().has_mixed_cost
    solution = BoxDDP(problem, second_order=second_order, tolerance=1e-13).solve()
    assert solution.converged
    for k, i in ((0, 0), (3, 1), (19, 0)):
        for sign in (-1.0, 1.0):
            controls = solution.controls.copy()
            controls[k, i] = np.clip(controls[k, i] + sign * 1e-3, -0.5, 0.4)
            assert BoxDDP(problem, max_iterations=0).solve(u_init=controls).cost >= solution.cost


def test_a_quadratic_problem_with_a_coupled_cost_takes_one_step():
    A, B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.1]])
    problem = CasadiProblem(
        lambda x, u: casadi.mtimes(A, x) + casadi.mtimes(B, u),
        lambda x, u: casadi.sumsqr(x) + casadi.sumsqr(u) + 1.2 * x[1] * u[0],
        casadi.sumsqr,
        initial_state=[1.0, -1.0],
        n_controls=1,
        horizon=30,
    )
    solver = BoxDDP(problem, second_order="gauss_newton", initial_regularization=0.0)
    from_zero = solver.solve()
    assert (from_zero.converged, from_zero.iterations) == (True, 1)
    still = np.zeros((31, 2))
    assert solver.solve(x_init=still).cost == pytest.approx(from_zero.cost, rel=1e-12)


def test_every_solver_takes_the_problem():
    problem = planar_quadrotor()
    direct = BoxDDP(problem).solve(u_init=np.full((100, 2), HOVER))
    guess = np.linspace(problem.initial_state, np.zeros(6), 101)
    shot = BoxDDP(problem, threads=2).solve(u_init=np.full((100, 2), HOVER), x_init=guess)
    guided = GuidedDDP(problem, library=[direct]).solve(np.array([-1.8, 1.0, 0.8, 0.0, 0.0, 0.0]))
    assert direct.converged
    assert shot.cost == pytest.approx(direct.cost, rel=1e-5)
    assert guided.converged
    assert guided.metadata["guess"] == "policy 0"
    assert direct.policy()(direct.states[3], 3) == pytest.approx(direct.controls[3])


def test_bounds_may_differ_from_stage_to_stage():
    upper = np.linspace(0.1, 0.02, 20)[:, None] * [1.0, 1.0]
    solution = BoxDDP(small(control_lower=-upper, control_upper=upper)).solve()
    assert solution.converged
    assert np.all(np.abs(solution.controls) <= upper)
    assert np.any(np.abs(solution.controls) == upper)


def test_parameters_may_differ_from_stage_to_stage():
    solver, rows = BoxDDP(small(), tolerance=1e-12), np.tile([0.7, 1.3], (21, 1))
    expected = solver.solve().cost
    assert solver.solve(parameters=rows).cost == expected
    rows[-1, 1] = 0.4  # of the terminal cost alone
    lighter = solver.solve(parameters=rows)
    assert lighter.converged
    assert lighter.cost < expected


# What is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "sentence"),
    [
        ({"step": lambda x, u, p: x[0]}, ValueError, r"step returns .* expected 2 numbers, .* of initial"),
        ({"stage_cost": lambda x, u, p: x[0] if x[0] > 0 else u[0]}, TypeError, "use casadi.if_else"),
        ({"stage_cost": lambda x, u, p: u}, ValueError, r"stage_cost returns .* expected a scalar"),
        ({"terminal_cost": lambda x, p: None}, TypeError, "terminal_cost returns NoneType"),
        ({"terminal_cost": lambda x, p: casadi.MX.sym("m")}, TypeError, "terminal_cost returns MX"),
        ({"stage_cost": lambda x, u, p: casadi.SX.sym("mass")}, ValueError, "the symbols mass, which"),
        (
            {"terminal_cost": lambda x, p: casadi.erf(x[0])},
            NotImplementedError,
            "terminal_cost holds CasADi's OP_ERF, which does not compile: .*, or use PythonProblem",
        ),
        ({"initial_state": [[1.0, 2.0]]}, ValueError, r"initial_state has shape \(1, 2\)"),
        ({"initial_state": [1.0, np.nan]}, ValueError, r"initial_state\[1\] is nan"),
        ({"parameters": [0.7, np.inf]}, ValueError, r"parameters\[1\] is inf"),
        ({"control_lower": [0.0]}, ValueError, r"control_lower has shape \(1,\)"),
        ({"control_upper": [1.0, np.nan]}, ValueError, "input 1 has bounds"),
        ({"control_upper": -1.0}, ValueError, "the lower one must not exceed the upper one"),
        ({"control_upper": "1"}, TypeError, "control_upper: of type"),
        ({"horizon": 0}, ValueError, "horizon is 0"),
        ({"horizon": True}, ValueError, "horizon is True; it must be a whole number"),
        ({"horizon": 10.0}, ValueError, r"horizon is 10\.0; it must be a whole number"),
        ({"n_controls": -1}, ValueError, "n_controls is -1"),
        ({"time_step": -0.1}, ValueError, "time_step is -0.1"),
    ],
)
def test_contradictions_are_refused(changes, error, sentence):
    with pytest.raises(error, match=sentence):
        small(**changes)


@pytest.mark.parametrize("duration", [0.0, -0.1, np.nan, np.inf, "0.1"])
def test_a_step_of_no_duration_is_refused(duration):
    with pytest.raises(ValueError, match=r"time_step is .*; it must be a positive number of seconds"):
        runge_kutta(lambda x, u: x, duration)


@pytest.mark.parametrize("kind", [CasadiProblem, PythonProblem])
def test_one_rate_is_not_spread_over_all_states(kind):
    step = runge_kutta(lambda x, u: [u[0]], 0.1)
    with pytest.raises(ValueError, match=r"dynamics returns 1 numbers; expected 2, .* or initial_state"):
        kind(step, lambda x, u: u[0] ** 2, lambda x: x[0], initial_state=[0, 0], n_controls=1, horizon=3)


def test_the_receding_horizon_takes_scenes_only():
    with pytest.raises(TypeError, match="takes scenes only, no CasadiProblem: give a scene"):
        RecedingHorizonExpert(small())


def test_a_control_without_a_weight_is_refused():
    problem = small(stage_cost=lambda x, u, p: u[0] ** 2)
    with pytest.raises(ValueError, match="with respect to input 1 at stage 0"):
        BoxDDP(problem).solve()


@pytest.mark.parametrize(
    "thing",
    [42, None, (1, 2), lambda x, u: x, CasadiProblem],
    ids=["int", "None", "tuple", "function", "class"],
)
def test_what_is_no_problem_is_refused(thing):
    with pytest.raises(TypeError, match=r"neither a scene nor a problem.*Give a scene or its name"):
        BoxDDP(thing)


def test_an_incomplete_problem_is_told_what_it_lacks():
    class Incomplete:
        n_states = n_tangent = n_controls = horizon = 1

        def kernel(self, name):
            raise AssertionError

    with pytest.raises(TypeError, match="it lacks time_step, parameters, control_lower"):
        GuidedDDP(Incomplete())
