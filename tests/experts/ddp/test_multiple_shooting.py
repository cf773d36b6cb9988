"""Multiple shooting: solves that begin with a guess of the states, which the dynamics need not follow."""

from dataclasses import replace

import numpy as np
import pytest
from guessed_states import assert_rolled_out, random_guess

from experts import BoxDDP, StopReason
from experts.ddp.backward_pass import PASS_COMPLETED
from experts.ddp.multiple_shooting import MultipleShooting
from experts.ddp.shooting import ShootingWorkspace
from experts.problems.arm_problem import ArmProblem


def gaps_of(problem, states, controls):
    """f_k = step(x_k, u_k) (-) x_k+1."""
    rows = zip(states, controls, states[1:], strict=False)
    return np.array([problem.difference(y, problem.step(x, u, problem.time_step)) for x, u, y in rows])


def opened(problem, states, controls):
    """Multiple shooting with derivatives along a guess, ready to sweep."""
    shooting = MultipleShooting(ShootingWorkspace(problem, second_order=False))
    shooting.begin(problem.initial_state, states, controls)
    shooting.work.differentiate()
    return shooting


def first_cost(problem, states, controls):
    return sum(map(problem.cost, states, controls)) + problem.terminal_cost(states[-1])


@pytest.fixture(params=["double_integrator", "coupled_masses"])
def system(request):
    return request.getfixturevalue(request.param)


# Linear dynamics -------------------------------------------------------------------------------------------


def test_unconstrained_linear_quadratic_problem_is_solved_in_one_full_step(system):
    problem = system.problem()
    states, controls = random_guess(problem)
    solution = BoxDDP(problem).solve(u_init=controls, x_init=states)
    H, g, constant = system.condensed(system.initial_state)
    U = -np.linalg.solve(H, g)
    assert solution.converged
    assert solution.iterations == 1
    assert (solution.history["alpha"][0], solution.history["gap"][0]) == (1.0, 0.0)
    np.testing.assert_allclose(solution.controls.ravel(), U, rtol=0, atol=1e-9)
    assert solution.cost == pytest.approx(0.5 * g @ U + constant, rel=1e-10)
    assert_rolled_out(solution, problem)


@pytest.mark.parametrize("limit", [0.3, 0.1])
def test_bounds_hold_while_gaps_are_open(system, limit):
    problem = system.problem(limit)
    states, controls = random_guess(problem, spread=1.0)
    shooting = opened(problem, states, np.clip(controls, -limit, limit))
    outcome = shooting.work.backward_pass(0.0, gaps=shooting.gaps)
    assert outcome.clamped > 0
    for alpha in (0.1, 0.5, 1.0):
        assert np.isfinite(shooting.try_step(alpha))
        trial = shooting.work.trial.controls
        assert np.all(np.abs(trial) <= limit)
    assert np.any(np.abs(trial) == limit)
    solver = BoxDDP(problem, tolerance=1e-13)

    def check_bounds(record):
        assert np.all(np.abs(solver._work.current.controls) <= limit)

    solution = solver.solve(None, np.clip(controls, -limit, limit), check_bounds, x_init=states)
    reference = BoxDDP(problem, tolerance=1e-13).solve()
    assert solution.converged
    assert solution.cost == pytest.approx(reference.cost, rel=1e-11)
    np.testing.assert_allclose(solution.controls, reference.controls, rtol=0, atol=1e-5)


def test_predicted_change_of_the_cost_is_exact_on_a_linear_quadratic_problem(system):
    problem = system.problem()
    shooting = opened(problem, *random_guess(problem))
    cost = shooting.work.current.cost
    assert shooting.work.backward_pass(3.0, gaps=shooting.gaps).status == PASS_COMPLETED
    linear, quadratic = shooting.change_of_cost()
    for alpha in (0.01, 0.3, 1.0):
        change = shooting.try_step(alpha) - cost
        assert change == pytest.approx(alpha * (linear + alpha * quadratic), rel=1e-9, abs=1e-9)


# Gaps ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum", "unicycle"])
def test_gaps_and_cost_of_a_guess(name, request):
    problem = request.getfixturevalue(name)
    states, controls = random_guess(problem)
    shooting = opened(problem, states, controls)
    expected = gaps_of(problem, states, controls)
    first = problem.difference(states[0], problem.initial_state)
    np.testing.assert_allclose(shooting.gaps, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shooting.initial_gap[0], first, rtol=0, atol=1e-12)
    norms = np.linalg.norm(np.vstack([first, expected]), axis=1)
    assert shooting.largest_gap == pytest.approx(norms.max(), rel=1e-12)
    assert shooting.work.current.cost == pytest.approx(first_cost(problem, states, controls), rel=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "unicycle"])
@pytest.mark.parametrize("alpha", [0.5, 0.1])
def test_a_step_leaves_the_share_one_minus_alpha_of_every_gap(name, alpha, request):
    """Also on the manifold and off the reference, to the last digits."""
    problem = request.getfixturevalue(name)
    shooting = opened(problem, *random_guess(problem, spread=0.05))
    before, first = shooting.gaps.copy(), shooting.initial_gap[0].copy()
    shooting.work.backward_pass(0.0, gaps=shooting.gaps)
    assert np.isfinite(shooting.try_step(alpha))
    shooting.accept(alpha)
    current = shooting.work.current
    after = gaps_of(problem, current.states, current.controls)
    np.testing.assert_allclose(after, (1.0 - alpha) * before, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shooting.gaps, after, rtol=0, atol=1e-12)
    left = problem.difference(current.states[0], problem.initial_state)
    np.testing.assert_allclose(left, (1.0 - alpha) * first, rtol=0, atol=1e-12)
    assert shooting.largest_gap == pytest.approx(np.linalg.norm([*after, left], axis=1).max(), rel=1e-9)


def test_predicted_slope_is_the_derivative_of_the_cost(unicycle):
    """L of a nonlinear problem, where no control of the step reaches a bound.

    Gaps are small, since the model leaves out how they turn increments on a curved space.
    """
    free = replace(unicycle, control_lower=np.full(2, -50.0), control_upper=np.full(2, 50.0))
    states = BoxDDP(free).solve().states
    offsets = 1e-4 * np.random.default_rng(0).normal(size=(len(states), 3))
    states = np.array([free.retract(x, offset) for x, offset in zip(states, offsets, strict=True)])
    shooting = opened(free, states, np.full((free.horizon, 2), 0.3))
    shooting.work.backward_pass(1.0, gaps=shooting.gaps)
    linear, _ = shooting.change_of_cost()
    step = 1e-5
    slope = (shooting.try_step(step) - shooting.try_step(0.0)) / step
    assert slope == pytest.approx(linear, rel=1e-2)


def test_gaps_close_for_good_and_the_record_tells(unicycle):
    states, controls = random_guess(unicycle, seed=3)
    records = []
    solution = BoxDDP(unicycle).solve(u_init=controls, callback=records.append, x_init=states)
    gap = solution.history["gap"]
    assert solution.converged
    assert solution.history["iteration"].tolist() == list(range(1, len(records) + 1))
    assert np.all(np.diff(gap) <= 0.0)
    assert gap[-1] == 0.0
    assert [record.gap for record in records] == gap.tolist()
    closed = solution.history[gap == 0.0]
    assert np.all(np.diff(closed["cost"]) <= 0.0)
    assert np.all(np.isfinite(closed["optimality"][1:]))
    assert_rolled_out(solution, unicycle)


# Same minimum ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pendulum", "unicycle"])
def test_a_disturbed_solution_leads_back_to_it(name, request):
    problem = request.getfixturevalue(name)
    reference = BoxDDP(problem, tolerance=1e-12).solve()
    offsets = 0.02 * np.random.default_rng(1).normal(size=(problem.horizon + 1, problem.n_tangent))
    states = np.array([problem.retract(x, z) for x, z in zip(reference.states, offsets, strict=True)])
    solver = BoxDDP(problem, tolerance=1e-12)
    solution = solver.solve(u_init=reference.controls, x_init=states)
    assert solution.converged
    assert solution.history["gap"][0] < np.inf
    assert solution.cost == pytest.approx(reference.cost, rel=1e-9)
    np.testing.assert_allclose(solution.states, reference.states, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_the_solution_as_a_guess_needs_no_iteration(pendulum):
    solver = BoxDDP(pendulum)
    solution = solver.solve()
    again = solver.solve(u_init=solution.controls, x_init=solution.states)
    assert again.converged
    assert again.iterations == 0
    np.testing.assert_array_equal(again.states, solution.states)
    np.testing.assert_array_equal(again.feedback_gains, solution.feedback_gains)


def test_unstable_dynamics_of_which_no_rollout_is_finite(unstable):
    """Single shooting has nothing to start from; a straight line through the states is enough."""
    with np.errstate(over="ignore", invalid="ignore"):
        assert BoxDDP(unstable).solve().stop_reason is StopReason.DIVERGED
        line = np.linspace(1.0, 0.0, unstable.horizon + 1)[:, None] * unstable.initial_state
        solution = BoxDDP(unstable).solve(x_init=line)
    assert solution.converged
    assert solution.history["gap"][-1] == 0.0
    assert_rolled_out(solution, unstable)


@pytest.mark.slow
def test_a_start_far_from_the_guess(unicycle):
    """The guess ends where it should but begins elsewhere, turned by a right angle and more."""
    elsewhere = np.array([np.cos(-1.0), np.sin(-1.0), -0.7, -0.4])
    guess = BoxDDP(unicycle).solve()
    solution = BoxDDP(unicycle).solve(elsewhere, guess.controls, x_init=guess.states)
    assert solution.converged
    assert_rolled_out(solution, unicycle, elsewhere)
    assert solution.cost <= BoxDDP(unicycle).solve(elsewhere).cost * 1.01


# The arm ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def arm():
    problem = ArmProblem("no-wrist")
    return problem, BoxDDP(problem).solve()


@pytest.mark.slow
def test_a_disturbed_maneuver_of_the_arm_leads_back_to_it(arm):
    problem, reference = arm
    offsets = 1e-3 * np.random.default_rng(0).normal(size=(problem.horizon + 1, problem.n_tangent))
    states = problem.kernels.retract(reference.states, offsets)
    solver = BoxDDP(problem, initial_regularization=1.0)
    solution = solver.solve(u_init=reference.controls, x_init=states)
    assert solution.converged
    assert solution.history["gap"].max() < 0.02
    assert solution.cost == pytest.approx(reference.cost, rel=1e-5)
    rows = solution.states[:-1], solution.controls
    np.testing.assert_array_equal(problem.kernels.step(*rows), solution.states[1:])


@pytest.mark.slow
def test_rounded_poses_are_made_unit_dual_quaternions(arm):
    problem, reference = arm
    rounded = reference.states.astype(np.float32)
    solution = BoxDDP(problem, initial_regularization=1.0).solve(u_init=reference.controls, x_init=rounded)
    assert solution.converged
    assert solution.iterations <= 3
    assert solution.cost == pytest.approx(reference.cost, rel=1e-6)
