"""Box-DDP on problems whose solution is known, and its answers to bad input and bad luck."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear, minimize

from experts.ddp.backward_pass import PASS_COMPLETED
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.second_order import LARGEST_MU
from experts.ddp.solution import StopReason
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem


def solve_condensed(system, limit, initial_state=None):
    """Optimal stacked controls and cost by an independent active-set solver."""
    state = system.initial_state if initial_state is None else initial_state
    H, g, constant = system.condensed(state)
    root = np.linalg.cholesky(H).T
    solved = lsq_linear(root, -np.linalg.solve(root.T, g), (-limit, limit), method="bvls", tol=1e-15)
    U = solved.x
    return U, 0.5 * U @ H @ U + g @ U + constant


def riccati_gains(system):
    """Gains of the unconstrained problem and the Hessian of its cost-to-go at stage 0."""
    P, gains = system.P, []
    for _ in range(system.horizon):
        K = -np.linalg.solve(system.R + system.B.T @ P @ system.B, system.B.T @ P @ system.A)
        P = system.Q + system.A.T @ P @ (system.A + system.B @ K)
        gains.insert(0, K)
    return np.array(gains), P


@pytest.fixture(params=["double_integrator", "coupled_masses"])
def system(request):
    return request.getfixturevalue(request.param)


# Linear-quadratic problems --------------------------------------------------------------------------------


def test_unconstrained_problem_is_solved_in_one_unregularized_step(system):
    solution = BoxDDP(system.problem(), initial_regularization=0.0).solve()
    gains, P = riccati_gains(system)
    x0 = system.initial_state
    assert solution.converged
    assert solution.iterations == 1
    assert solution.cost == pytest.approx(0.5 * x0 @ P @ x0, rel=1e-12)
    np.testing.assert_allclose(solution.feedback_gains, gains, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solution.controls[0], gains[0] @ x0, rtol=1e-9)


def test_costs_of_an_unstable_first_rollout_are_no_measure_of_the_optimum(double_integrator):
    """From zero controls the cost is 1e20 times the optimum; with all of that as scale any step would do."""
    unstable = replace(double_integrator, A=double_integrator.A + 0.2 * np.eye(2), horizon=140)
    _, P = riccati_gains(unstable)
    optimum = 0.5 * unstable.initial_state @ P @ unstable.initial_state
    assert BoxDDP(unstable.problem(), max_iterations=0).solve().cost > 1e20 * optimum
    solution = BoxDDP(unstable.problem()).solve()
    assert solution.converged
    assert solution.cost == pytest.approx(optimum, rel=1e-7)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_maneuver_that_costs_nothing_is_found(double_integrator, scale):
    nothing = np.zeros(2)
    system = replace(double_integrator, Q=scale * double_integrator.Q, R=scale * double_integrator.R)
    solution = BoxDDP(system.problem()).solve(nothing, np.ones((system.horizon, 1)))
    assert solution.converged
    assert solution.cost < 1e-30 * scale


def test_gains_at_rest_do_not_count_on_an_input_without_room(coupled_masses):
    held = 1
    problem, others = coupled_masses.problem(), np.arange(3) != held
    problem.control_lower[held] = problem.control_upper[held] = 0.0
    gains, _ = riccati_gains(
        replace(coupled_masses, B=coupled_masses.B[:, others], R=coupled_masses.R[others][:, others])
    )
    solution = BoxDDP(problem).solve(np.zeros(4))
    assert not solution.feedback_gains[:, held].any()
    np.testing.assert_allclose(solution.feedback_gains[:, others], gains, rtol=1e-9, atol=1e-12)


def test_no_step_leads_to_states_that_are_not_finite_even_where_they_cost_nothing(double_integrator):
    system = replace(double_integrator, A=np.eye(2), B=np.eye(2, 1), Q=np.zeros((2, 2)), R=1e-6 * np.eye(1))
    problem = replace(
        replace(system, P=np.diag([1.0, 0.0]), horizon=4, initial_state=np.array([4.0, 0.0])).problem(),
        step=lambda x, u, h: np.array([x[0] + u[0], x[1] if x[0] > 2.0 else np.inf]),
        cost=lambda x, u: 0.5e-6 * u @ u,
        terminal_cost=lambda x: 0.5 * x[0] ** 2,
        difference=lambda reference, x: np.array([x[0] - reference[0], 0.0]),
    )
    solution = BoxDDP(problem, initial_regularization=0.0).solve()
    assert solution.cost < 4.0
    assert np.isfinite(solution.states).all()
    assert not solution.converged


@pytest.mark.parametrize("initial_regularization", [0.0, 1.0, 1e4])
def test_first_step_achieves_the_predicted_reduction(system, initial_regularization):
    solver = BoxDDP(system.problem(), initial_regularization=initial_regularization)
    before = BoxDDP(system.problem(), max_iterations=0).solve().cost
    first = solver.solve().history[0]
    assert first["alpha"] == 1.0
    assert before - first["cost"] == pytest.approx(first["expected_decrease"], rel=1e-9)


@pytest.mark.parametrize("limit", [1.0, 0.4, 0.2])
def test_bounded_problem_agrees_with_a_dense_quadratic_program(system, limit):
    solution = BoxDDP(system.problem(limit), tolerance=1e-14).solve()
    U, cost = solve_condensed(system, limit)
    on_bound = np.abs(U.reshape(solution.controls.shape)) == limit
    assert on_bound.any()
    assert solution.converged
    assert solution.cost == pytest.approx(cost, rel=1e-12)
    np.testing.assert_allclose(solution.controls.ravel(), U, rtol=0, atol=1e-6)
    assert np.all(np.abs(solution.controls) <= limit)
    assert np.all(solution.feedback_gains[on_bound] == 0.0)


def test_value_gradient_is_the_derivative_of_the_optimal_cost(system):
    limit, step = 0.4, 1e-5
    solver = BoxDDP(system.problem(limit), tolerance=1e-15)
    assert solver.solve().converged
    outcome = solver._work.backward_pass(0.0)
    assert outcome.status == PASS_COMPLETED
    assert outcome.clamped > 0
    differences = [
        solve_condensed(system, limit, system.initial_state + step * e)[1]
        - solve_condensed(system, limit, system.initial_state - step * e)[1]
        for e in np.eye(len(system.initial_state))
    ]
    expected = np.array(differences) / (2.0 * step)
    np.testing.assert_allclose(solver._work.update.Vx, expected, rtol=1e-6, atol=1e-7)


# Nonlinear problems ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum", "unicycle"])
def test_nonlinear_problem_converges_within_its_bounds(name, request):
    problem = request.getfixturevalue(name)
    solution = BoxDDP(problem).solve()
    assert solution.converged
    assert solution.optimality <= 1e-7
    assert np.all(np.diff(solution.history["cost"]) <= 0.0)
    assert np.all((problem.control_lower <= solution.controls) & (solution.controls <= problem.control_upper))
    on_bound = (solution.controls == problem.control_lower) | (solution.controls == problem.control_upper)
    assert on_bound.any()
    assert np.all(solution.feedback_gains[on_bound] == 0.0)
    for k, u in enumerate(solution.controls):
        np.testing.assert_array_equal(
            solution.states[k + 1], problem.step(solution.states[k], u, problem.time_step)
        )


def test_converged_solution_is_a_minimum_for_an_independent_optimizer(unicycle):
    solution = BoxDDP(unicycle, tolerance=1e-12).solve()

    def cost_and_gradient(stacked):
        controls = stacked.reshape(solution.controls.shape)
        states = [unicycle.initial_state]
        for u in controls:
            states.append(unicycle.step(states[-1], u, unicycle.time_step))
        cost = unicycle.terminal_cost(states[-1])
        costate, _ = unicycle.terminal_cost_derivatives(states[-1])
        gradient = np.zeros_like(controls)
        for k in range(len(controls) - 1, -1, -1):
            A, B = unicycle.linearize(states[k], controls[k], unicycle.time_step)
            lx, lu, *_ = unicycle.cost_derivatives(states[k], controls[k])
            cost += unicycle.cost(states[k], controls[k])
            gradient[k], costate = lu + B.T @ costate, lx + A.T @ costate
        return cost, gradient.ravel()

    bounds = list(zip(unicycle.control_lower, unicycle.control_upper, strict=True)) * unicycle.horizon
    options = {"maxiter": 200, "ftol": 1e-15, "gtol": 1e-10}
    start = solution.controls.ravel()
    polished = minimize(cost_and_gradient, start, jac=True, bounds=bounds, options=options)
    cost, gradient = cost_and_gradient(start)
    lower, upper = np.array(bounds).T
    projected = np.clip(start - gradient, lower, upper) - start
    assert cost == pytest.approx(solution.cost, rel=1e-12)
    assert polished.fun == pytest.approx(solution.cost, rel=1e-9)
    assert np.abs(projected).max() < 1e-5


def test_solution_does_not_depend_on_the_unit_of_the_cost(unicycle):
    factor = 2.0**40
    scaled = replace(
        unicycle,
        cost=lambda x, u: factor * unicycle.cost(x, u),
        terminal_cost=lambda x: factor * unicycle.terminal_cost(x),
        cost_derivatives=lambda x, u: tuple(factor * d for d in unicycle.cost_derivatives(x, u)),
        terminal_cost_derivatives=lambda x: tuple(factor * d for d in unicycle.terminal_cost_derivatives(x)),
    )
    solution, other = BoxDDP(unicycle).solve(), BoxDDP(scaled).solve()
    np.testing.assert_array_equal(other.controls, solution.controls)
    assert other.iterations == solution.iterations


def test_warm_start_from_the_solution_needs_no_iteration(pendulum):
    solver = BoxDDP(pendulum)
    solution = solver.solve()
    again = solver.solve(u_init=solution.controls)
    assert again.converged
    assert again.iterations == 0
    assert again.cost == solution.cost
    np.testing.assert_array_equal(again.feedback_gains, solution.feedback_gains)


@pytest.mark.slow
def test_solver_can_be_used_again(unicycle):
    solver = BoxDDP(unicycle)
    first = solver.solve()
    kept = first.states.copy(), first.controls.copy(), first.feedback_gains.copy()
    solver.solve(x0=np.array([1.0, 0.0, -0.5, 0.2]))
    for array, before in zip((first.states, first.controls, first.feedback_gains), kept, strict=True):
        np.testing.assert_array_equal(array, before)
    np.testing.assert_array_equal(solver.solve().controls, first.controls)


# Reasons to stop ------------------------------------------------------------------------------------------


def test_iteration_limit_is_not_called_convergence(pendulum):
    solution = BoxDDP(pendulum, max_iterations=5).solve()
    assert solution.stop_reason is StopReason.MAX_ITERATIONS
    assert not solution.converged
    assert solution.iterations == len(solution.history) == 5
    assert solution.optimality > 1e-7
    assert solution.cost == solution.history["cost"][-1]
    assert "5 iterations" in solution.message


def test_gains_belong_to_the_returned_trajectory_however_the_solve_ends(double_integrator):
    solution = BoxDDP(double_integrator.problem(), max_iterations=1, initial_regularization=1e4).solve()
    assert not solution.converged
    np.testing.assert_allclose(solution.feedback_gains, riccati_gains(double_integrator)[0], rtol=1e-9)


def test_idle_iterations_are_a_plateau_not_convergence(pendulum):
    """Damping so strong that the cost hardly moves, although the trajectory is far from optimal."""
    settings = {"plateau_iterations": 2, "plateau_decrease": 1e-7, "second_order": "gauss_newton"}
    solution = BoxDDP(pendulum, initial_regularization=1e9, **settings).solve()
    assert solution.stop_reason is StopReason.PLATEAU
    assert solution.iterations == 2
    assert np.all(solution.history["optimality"] < 1e-7)
    assert solution.optimality > 0.1


@pytest.mark.slow
def test_a_regularized_step_with_no_predicted_reduction_is_not_convergence(pendulum):
    solution = BoxDDP(pendulum, initial_regularization=1e9).solve()
    assert solution.converged
    assert solution.history["optimality"][0] < 1e-7
    assert solution.cost == pytest.approx(BoxDDP(pendulum).solve().cost, rel=1e-2)


def test_no_step_lowers_the_cost_of_a_wrong_model(double_integrator):
    problem = double_integrator.problem()
    wrong = replace(problem, linearize=lambda x, u, h: (double_integrator.A, -double_integrator.B))
    solution = BoxDDP(wrong).solve()
    assert solution.stop_reason is StopReason.REGULARIZATION_LIMIT
    assert np.all(solution.history["alpha"][-3:] == 0.0)
    assert np.all(solution.history["regularization"] <= LARGEST_MU)
    assert np.all(np.diff(solution.history["cost"]) <= 0.0)
    assert solution.optimality > 1e-3


@pytest.mark.parametrize("size", [1.0, 1e-12])
def test_a_small_cost_does_not_make_a_wrong_model_converge(double_integrator, size):
    """What counts as rounding goes with the states, so that a cost of 1e-24 has its digits too."""
    problem = replace(double_integrator.problem(), initial_state=size * double_integrator.initial_state)
    wrong = replace(problem, linearize=lambda x, u, h: (double_integrator.A, -double_integrator.B))
    assert BoxDDP(problem).solve().converged
    solution = BoxDDP(wrong).solve()
    assert solution.stop_reason is StopReason.REGULARIZATION_LIMIT
    assert solution.optimality > 1e-3


# Nothing to do --------------------------------------------------------------------------------------------


def test_a_cost_of_zero_is_a_minimum(system):
    solution = BoxDDP(replace(system.problem(), initial_state=np.zeros(len(system.initial_state)))).solve()
    assert solution.converged
    assert solution.iterations == 0
    assert solution.cost == solution.optimality == 0.0
    np.testing.assert_allclose(solution.feedback_gains, riccati_gains(system)[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("offset", [1e-16, -3e-16])
@pytest.mark.parametrize("initial_regularization", [0.0, 1000.0])
def test_a_start_at_the_target_up_to_rounding_has_converged(unicycle, offset, initial_regularization):
    """Cost and promise are rounding errors of equal size, 1e-30: their ratio says nothing."""
    at_target = replace(unicycle, initial_state=np.array([1.0, 2.0 * offset, offset, -offset]))
    solution = BoxDDP(at_target, initial_regularization=initial_regularization).solve()
    assert 0.0 < solution.cost < 1e-28
    assert solution.converged
    assert solution.iterations == 0
    assert np.all(solution.controls == 0.0)


@pytest.mark.parametrize("offset", [1e-10, 1e-6])
def test_a_start_near_the_target_is_still_solved(unicycle, offset):
    near = replace(unicycle, initial_state=np.array([1.0, 0.0, offset, 0.0]))
    before = BoxDDP(near, max_iterations=0).solve()
    assert not before.converged
    solution = BoxDDP(near).solve()
    assert solution.converged
    assert solution.iterations > 0
    assert solution.cost < 0.5 * before.cost


def test_a_predicted_reduction_below_rounding_is_none(double_integrator):
    """With x of 1e9 the cost of x - 1e9 is exact to (1e9 eps)^2 only."""
    origin, Q, P = np.array([1e9, 0.0]), double_integrator.Q, double_integrator.P
    shifted = replace(
        double_integrator.problem(),
        initial_state=origin + np.array([2e-7, 0.0]),
        step=lambda x, u, h: origin + double_integrator.A @ (x - origin) + double_integrator.B @ u,
        cost=lambda x, u: 0.5 * ((x - origin) @ Q @ (x - origin) + u @ double_integrator.R @ u),
        terminal_cost=lambda x: 0.5 * (x - origin) @ P @ (x - origin),
        cost_derivatives=lambda x, u: (Q @ (x - origin), double_integrator.R @ u, Q, double_integrator.R),
        terminal_cost_derivatives=lambda x: (P @ (x - origin), P),
    )
    solution = BoxDDP(shifted).solve()
    assert solution.converged
    assert solution.cost > 0.0


def test_a_large_number_beside_the_cost_hides_no_reduction(double_integrator):
    """A clock in the state is off by seconds; position and velocity have all their digits."""
    plain = double_integrator
    timed = replace(
        plain,
        A=block_diag(plain.A, 1.0),
        B=np.vstack([plain.B, [[0.0]]]),
        Q=block_diag(plain.Q, 0.0),
        P=block_diag(plain.P, 0.0),
        initial_state=np.append(plain.initial_state, 1e15),
    )
    expected, solution = BoxDDP(plain.problem()).solve(), BoxDDP(timed.problem()).solve()
    assert solution.converged
    assert solution.iterations == expected.iterations
    assert solution.cost == pytest.approx(expected.cost, rel=1e-12)


def test_cost_that_no_regularization_makes_convex(double_integrator):
    problem = double_integrator.problem()
    concave = replace(
        problem, terminal_cost_derivatives=lambda x: (double_integrator.P @ x, -1e30 * np.eye(2))
    )
    solution = BoxDDP(concave).solve()
    assert solution.stop_reason is StopReason.REGULARIZATION_LIMIT
    assert "stage 39" in solution.message
    assert "not convex" in solution.message
    assert np.all(solution.feedback_gains == 0.0)


def test_first_rollout_that_diverges_is_reported(double_integrator):
    double_integrator.A = np.diag([1e60, 1.0])
    with np.errstate(over="ignore"):
        solution = BoxDDP(double_integrator.problem()).solve()
    assert solution.stop_reason is StopReason.DIVERGED
    assert solution.cost == np.inf
    assert solution.iterations == len(solution.history) == 0
    assert "stage 3" in solution.message
    assert np.all(solution.feedback_gains == 0.0)


def test_a_rollout_that_diverges_has_no_states_of_another_solve(double_integrator):
    solver, start = BoxDDP(double_integrator.problem()), np.array([1e200, 0.0])
    solver.solve()
    with np.errstate(over="ignore"):
        solution = solver.solve(start)
    assert solution.stop_reason is StopReason.DIVERGED
    np.testing.assert_array_equal(solution.states[0], start)
    assert np.isnan(solution.states[1:]).all()


def test_trial_that_diverges_is_only_a_refused_step(pendulum):
    """Dynamics that leave the floating-point range at the rates of the first full step."""

    def step(x, u, h):
        return pendulum.step(x, u, h) if abs(x[1]) < 5.0 else np.full(2, np.nan)

    solution = BoxDDP(replace(pendulum, step=step), max_iterations=20, initial_regularization=1.0).solve()
    assert solution.stop_reason is not StopReason.DIVERGED
    assert np.isfinite(solution.cost)
    assert solution.history["alpha"][0] < 1.0


def test_interruption_returns_the_best_so_far(pendulum):
    def interrupt(record):
        if record.iteration == 3:
            raise KeyboardInterrupt

    solution = BoxDDP(pendulum).solve(callback=interrupt)
    reference = BoxDDP(pendulum, max_iterations=3).solve()
    assert solution.stop_reason is StopReason.INTERRUPTED
    assert solution.iterations == 3
    assert solution.cost == reference.cost
    np.testing.assert_array_equal(solution.states, reference.states)
    np.testing.assert_array_equal(solution.feedback_gains, reference.feedback_gains)


# Bad input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x0": [np.nan, 0.0]}, r"x0\[0\] is nan; every entry must be finite"),
        ({"x0": [0.0, 0.0, 0.0]}, r"x0 has shape \(3,\); expected \(2,\)"),
        ({"u_init": np.zeros((119, 1))}, r"u_init has shape \(119, 1\); expected \(120, 1\)"),
        ({"u_init": np.zeros(120)}, r"u_init has shape \(120,\); expected \(120, 1\)"),
        ({"u_init": np.full((120, 1), np.inf)}, r"u_init\[0, 0\] is inf"),
        ({"u_init": np.linspace(0.0, 5.1, 120)[:, None]}, r"u_init\[117, 0\] is 5\.0.*\[-5\.0, 5\.0\]"),
    ],
)
def test_wrong_start_is_refused(pendulum, arguments, message):
    with pytest.raises(ValueError, match=message):
        BoxDDP(pendulum).solve(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"x0": ["1", "2"]},
        {"x0": [1.0 + 1.0j, 0.0]},
        {"x0": np.ma.masked_array([1.0, 5.0], mask=[False, True])},
        {"u_init": [["0"]] * 120},
        {"x_init": [["0", "0"]] * 121},
    ],
)
def test_a_start_of_anything_but_real_numbers_is_refused(pendulum, arguments):
    problem = replace(pendulum, retract=lambda x, dx: x + dx)
    with pytest.raises(TypeError, match=f"{next(iter(arguments))}: .*, should be real numbers"):
        BoxDDP(problem).solve(**arguments)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_iterations": -1}, "max_iterations is -1; it must be a whole number, at least 0"),
        ({"max_iterations": 2.5}, "max_iterations is 2.5; it must be a whole number"),
        ({"threads": True}, "threads is True; it must be a whole number, at least 1"),
        ({"tolerance": np.nan}, "tolerance is nan"),
        ({"tolerance": np.inf}, "tolerance is inf; it must be a finite number, at least 0"),
        ({"tolerance": "1e-7"}, "tolerance is '1e-7'; it must be a finite number"),
        ({"initial_regularization": None}, "initial_regularization is None"),
        ({"plateau_decrease": -1e-9}, "plateau_decrease is -1e-09"),
        ({"plateau_iterations": 0}, "plateau_iterations is 0"),
        ({"initial_regularization": -1.0}, "initial_regularization is -1.0"),
    ],
)
def test_wrong_setting_is_refused(pendulum, settings, message):
    with pytest.raises(ValueError, match=message):
        BoxDDP(pendulum, **settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon is 0"),
        ({"time_step": -0.1}, "time_step is -0.1"),
        ({"time_step": "fast"}, "time_step is 'fast'"),
        ({"control_lower": np.zeros(2)}, r"control_lower has shape \(2,\); expected \(1,\), or \(120, 1\)"),
        ({"control_lower": np.array([6.0])}, r"input 0 has bounds \[6\.0, 5\.0\]"),
        ({"control_upper": np.array([np.nan])}, r"input 0 has bounds \[-5\.0, nan\]"),
        ({"control_lower": np.array([np.inf]), "control_upper": np.array([np.inf])}, "no finite number"),
    ],
)
def test_problem_that_contradicts_itself_is_refused(pendulum, changes, message):
    with pytest.raises(ValueError, match=message):
        BoxDDP(replace(pendulum, **changes))


def test_a_scene_without_actuators_is_refused():
    body = {"name": "body", "base": {"mass": 50, "inertia": [3, 3, 3]}, "target": {"pose": {}}}
    for solver in (BoxDDP, GuidedDDP):
        with pytest.raises(ValueError, match="scene 'body' has no actuator; give it one with a finite limit"):
            solver(body)


def test_input_without_a_weight_is_refused(pendulum):
    derivatives = pendulum.cost_derivatives
    free = replace(pendulum, cost_derivatives=lambda x, u: (*derivatives(x, u)[:3], np.zeros((1, 1))))
    with pytest.raises(ValueError, match="input 0 at stage 0; every input needs a positive weight"):
        BoxDDP(free).solve()


@pytest.mark.parametrize("solver", [BoxDDP, GuidedDDP])
@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_solvers_share_their_work_arrays_with_nobody(pendulum, solver, duplicate):
    with pytest.raises(TypeError, match=r"cannot be copied or pickled, .* make another one of the same"):
        duplicate(solver(pendulum))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, pickle.dumps])
def test_problems_share_with_nobody_what_their_kernels_read(duplicate):
    problem = ArmProblem("paper")
    problem.kernel("difference")
    assert copy.copy(problem).parameters is problem.parameters
    with pytest.raises(TypeError, match=r"cannot be copied or pickled, .* make another problem of the same"):
        duplicate(problem)
