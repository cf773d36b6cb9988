"""Exact second derivatives in the solver: quadratic convergence, the hybrid, and what is recorded of it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from experts import BoxDDP, GuidedDDP, StopReason
from experts.ddp.backward_pass import PASS_COMPLETED
from experts.ddp.derivatives import mirrored
from experts.ddp.second_order import (
    EXACT_MU_FACTOR,
    LARGEST_MU,
    LONGEST_PAUSE,
    MU_FACTOR,
    SMALLEST_MU,
    STRONGEST_EXACT_MU,
    WEAKEST_EXACT_MU,
    ExactRegularization,
    HybridSwitch,
    Regularization,
    SecondOrder,
)
from experts.ddp.solution import IterationRecord
from experts.maneuver_plan import ManeuverPlan
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import PaperProblem
from scripts.benchmarks.robots import OTHER_MOTIONS, robots

ONE_OF_EACH_KIND = ("free-floating", "no-wrist", "paper", "planar", "reaction-wheels", "tip-load")


def newton_steps(problem, controls):
    """Relative reductions that consecutive unregularized exact steps predict, from near a minimum."""
    solver = BoxDDP(problem, second_order="exact", initial_regularization=0.0, tolerance=1e-16)
    solution = solver.solve(u_init=controls)
    assert solution.history["exact"].all()
    return solution.history["expected_decrease"] / solution.cost


def nearly_optimal(problem, seed=0, disturbance=0.02):
    """The controls of a solution, disturbed where they are not at a bound."""
    solution = BoxDDP(problem, tolerance=1e-12).solve()
    limit = np.asarray(problem.control_upper)
    noise = disturbance * limit * np.random.default_rng(seed).normal(size=solution.controls.shape)
    free = np.abs(solution.controls) < 0.99 * limit
    return solution.controls + np.where(free, np.clip(noise, -0.01 * limit, 0.01 * limit), 0.0)


@pytest.mark.slow
def test_exact_steps_converge_quadratically(pendulum):
    """The predicted reduction is the squared norm of the gradient: each step doubles its exponent."""
    free = replace(pendulum, control_lower=np.array([-50.0]), control_upper=np.array([50.0]))
    reductions = newton_steps(free, nearly_optimal(free))
    assert len(reductions) >= 3
    for before, after in pairwise(reductions):
        assert after < max(1e3 * before**1.7, 1e-15)


def test_exact_steps_converge_quadratically_on_a_maneuver_of_the_arm():
    problem = ArmProblem("no-wrist")
    reductions = newton_steps(problem, nearly_optimal(problem, disturbance=1e-3))
    assert reductions[0] > 1e-5
    assert len(reductions) <= 5
    for before, after in pairwise(reductions):
        assert after < max(1e2 * before**1.7, 1e-14)


def test_gauss_newton_is_slower_near_the_minimum(pendulum):
    free = replace(pendulum, control_lower=np.array([-50.0]), control_upper=np.array([50.0]))
    controls = nearly_optimal(free)
    settings = {"initial_regularization": 0.0}
    solutions = {
        name: BoxDDP(free, second_order=name, **settings).solve(u_init=controls)
        for name in ("exact", "gauss_newton")
    }
    assert all(solution.converged for solution in solutions.values())
    assert solutions["exact"].iterations < solutions["gauss_newton"].iterations
    assert solutions["exact"].cost <= solutions["gauss_newton"].cost


@pytest.mark.parametrize("name", SecondOrder)
def test_every_choice_ends_at_a_minimum(pendulum, name):
    solution = BoxDDP(pendulum, second_order=name).solve()
    assert solution.converged
    assert solution.optimality <= 1e-7
    if name in (SecondOrder.GAUSS_NEWTON, SecondOrder.EXACT):
        assert np.all(solution.history["exact"] == (name is SecondOrder.EXACT))


@pytest.mark.slow
def test_minimum_is_confirmed_by_exact_second_derivatives():
    """The hybrid ends only where Newton's step exists, whichever model led there."""
    solver = BoxDDP("reaction-wheels")
    solution = solver.solve()
    assert solution.converged
    solver._work.differentiate()
    solver._work.differentiate_twice()
    outcome = solver._work.backward_pass(0.0, exact=True)
    assert outcome.status == PASS_COMPLETED
    assert -(outcome.linear + outcome.quadratic) <= 1e-7 * solution.cost
    np.testing.assert_array_equal(solver._work.update.K, solution.feedback_gains)


def test_saddle_is_not_a_minimum(pendulum):
    """Upright, with the upright pose the most expensive one: no first-order reason to move."""
    saddle = replace(
        pendulum,
        initial_state=np.zeros(2),
        terminal_cost=lambda x: 50.0 * np.cos(x[0]) ** 2 + 2.5 * x[1] ** 2,
        terminal_cost_derivatives=lambda x: (
            np.array([-50.0 * np.sin(2.0 * x[0]), 5.0 * x[1]]),
            np.diag([0.0, 5.0]),
        ),
        terminal_cost_hessian=lambda x: np.diag([-100.0 * np.cos(2.0 * x[0]), 5.0]),
    )
    gauss_newton = BoxDDP(saddle, second_order="gauss_newton").solve()
    assert gauss_newton.converged
    assert gauss_newton.iterations == 0
    hybrid = BoxDDP(saddle, plateau_iterations=5).solve()
    assert not hybrid.converged
    assert hybrid.optimality == np.inf
    pushed = BoxDDP(saddle).solve(u_init=np.full((saddle.horizon, 1), 1e-3))
    assert pushed.converged
    assert pushed.cost < 0.9 * hybrid.cost


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("scene", [*robots(), *OTHER_MOTIONS])
def test_hybrid_ends_no_higher_than_gauss_newton(scene):
    hybrid = BoxDDP(scene).solve()
    gauss_newton = BoxDDP(scene, second_order="gauss_newton").solve()
    assert hybrid.converged
    assert hybrid.iterations < 100
    assert hybrid.cost <= gauss_newton.cost * (1.0 + 1e-6)


@pytest.mark.parametrize(
    "scene",
    [name if name == "planar" else pytest.param(name, marks=pytest.mark.slow) for name in ONE_OF_EACH_KIND],
)
def test_hybrid_converges_and_says_which_model_led_to_each_step(scene):
    solution = BoxDDP(scene).solve()
    assert solution.converged
    assert solution.iterations <= 60
    assert solution.history["exact"].dtype == np.bool_
    assert not solution.history["exact"][0]  # the first step is never slow
    assert np.all(np.diff(solution.history["cost"]) <= 0.0)


def record(exact, cost, alpha):
    return IterationRecord(1, cost, alpha, exact, *np.zeros(9))


def test_hybrid_tries_the_exact_model_after_two_slow_steps_and_pauses_when_it_fails():
    switch = HybridSwitch()
    switch.observe(record(False, 99.0, 1.0), 100.0)
    switch.observe(record(False, 50.0, 1.0), 99.0)
    switch.observe(record(False, 40.0, 0.1), 50.0)
    assert not switch.tries_exact
    switch.observe(record(False, 39.5, 1.0), 40.0)
    assert switch.tries_exact
    pauses = []
    for _ in range(6):
        switch.postpone_exact()
        pauses.append(0)
        switch.observe(record(False, 39.5, 1.0), 39.5)
        while not switch.tries_exact:
            pauses[-1] += 1
            switch.observe(record(False, 39.5, 1.0), 39.5)
    assert pauses == [0, 1, 3, 7, 7, 7]
    assert max(pauses) < LONGEST_PAUSE
    switch.observe(record(True, 30.0, 1.0), 39.5)
    switch.postpone_exact()
    assert switch.pause == 1
    switch.request_exact()
    assert switch.tries_exact


def test_problem_without_second_derivatives_takes_gauss_newton(unicycle):
    assert BoxDDP(unicycle).second_order is SecondOrder.GAUSS_NEWTON
    for name in ("exact", "hybrid"):
        with pytest.raises(ValueError, match=f"second_order is '{name}', but the problem has no exact"):
            BoxDDP(unicycle, second_order=name)
    assert not PaperProblem().has_second_order


def test_unknown_choice_is_refused(pendulum):
    with pytest.raises(ValueError, match="second_order is 'newton'; choose one of gauss_newton, exact,"):
        BoxDDP(pendulum, second_order="newton")


def test_exact_derivatives_that_are_not_finite_are_reported(pendulum):
    broken = replace(pendulum, terminal_cost_hessian=lambda x: np.full((2, 2), np.nan))
    solution = BoxDDP(broken, second_order="exact").solve()
    assert solution.stop_reason is StopReason.DIVERGED
    assert "derivatives are not finite" in solution.message


@pytest.mark.slow
def test_an_integrator_without_second_derivatives_leaves_gauss_newton():
    scene = load_scene("planar")
    problem = ArmProblem(scene.replace(simulation={"dt": 0.1, "steps": 20}), "rodas4")
    assert not problem.has_second_order
    assert BoxDDP(problem).second_order == "gauss_newton"
    assert BoxDDP(problem).solve().cost < BoxDDP(problem, max_iterations=1).solve().cost
    with pytest.raises(ValueError, match="the problem has no exact second derivatives; gauss_newton needs"):
        BoxDDP(problem, second_order="exact")
    plan = ManeuverPlan.make(GuidedDDP(problem), problem.initial_state, 5, [BoxDDP(problem).solve()])
    assert np.linalg.eigvalsh(plan.Vxx).min() > -1e-9


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["rk6", "momentum_rk4"])
def test_methods_of_higher_order_do_with_the_second_derivatives_of_rk4(integrator):
    """Where the solver ends is decided by gradients, which are the method's own."""
    problem = ArmProblem("planar", integrator)
    solution, its_rk4 = BoxDDP(problem).solve(), BoxDDP(ArmProblem("planar", "rk4")).solve()
    assert solution.converged
    assert abs(solution.iterations - its_rk4.iterations) <= 3
    assert solution.cost == pytest.approx(its_rk4.cost, rel=1e-5)
    exact = BoxDDP(problem, second_order="exact").solve(u_init=solution.controls)
    assert exact.converged
    assert exact.iterations <= 2


def test_repeated_increases_grow_quadratically() -> None:
    regularization = Regularization(1.0)
    values = []
    for _ in range(3):
        regularization.increase()
        values.append(regularization.mu)
    assert values == pytest.approx([MU_FACTOR, MU_FACTOR**3, MU_FACTOR**6])


def test_repeated_decreases_reach_zero_and_leave_it_upward() -> None:
    regularization = Regularization(1.0)
    for _ in range(8):
        regularization.decrease()
    assert regularization.mu == 0.0
    regularization.increase()
    assert regularization.mu == SMALLEST_MU


@pytest.mark.parametrize(("alpha", "direction"), [(1.0, -1), (0.5, 0), (0.25, 0), (0.1, 1), (0.001, 1)])
def test_follows_the_accepted_step(alpha: float, direction: int) -> None:
    regularization = Regularization(1.0)
    regularization.adapt(alpha)
    assert (regularization.mu > 1.0) - (regularization.mu < 1.0) == direction


def test_is_exhausted_beyond_its_range() -> None:
    regularization = Regularization(LARGEST_MU)
    assert not regularization.exhausted
    regularization.increase()
    assert regularization.exhausted


def test_the_exact_model_beside_the_mirrored_one_remembers_its_regularization():
    remembered = ExactRegularization()
    remembered.adapt(0.25)
    assert remembered.mu == EXACT_MU_FACTOR * WEAKEST_EXACT_MU
    remembered.adapt(0.5)
    assert remembered.mu == EXACT_MU_FACTOR * WEAKEST_EXACT_MU
    for _ in range(2):
        remembered.adapt(1.0)
    assert remembered.mu == WEAKEST_EXACT_MU
    while remembered.increase():
        pass
    assert STRONGEST_EXACT_MU / EXACT_MU_FACTOR < remembered.mu <= STRONGEST_EXACT_MU


# The mirrored model ----------------------------------------------------------------------------------------


def test_negative_eigenvalues_change_sign():
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(7, 6, 6))
    matrices += matrices.transpose(0, 2, 1)
    matrices[:, :, 4] = matrices[:, 4, :] = 0.0  # coupled with nothing
    matrices[:, 4, 4] = -2.0
    found = mirrored(matrices)
    for before, after in zip(matrices, found, strict=True):
        expected = np.sort(np.abs(np.linalg.eigvalsh(before)))
        np.testing.assert_allclose(np.linalg.eigvalsh(after), expected, rtol=0, atol=5e-14)
        np.testing.assert_allclose(after @ after, before @ before, rtol=0, atol=1e-13)
    positive = matrices @ matrices
    np.testing.assert_allclose(mirrored(positive), positive, rtol=0, atol=1e-12)


def test_the_mirrored_model_finds_the_same_minimum(pendulum):
    mirrored_solution = BoxDDP(pendulum, second_order="mirrored").solve()
    assert mirrored_solution.converged
    assert mirrored_solution.cost == pytest.approx(BoxDDP(pendulum).solve().cost, rel=1e-6)


@pytest.mark.slow
def test_the_mirrored_model_does_not_creep():
    """Gauss-Newton's leaves out the curvature of the pose's cost."""
    problem = ArmProblem("six-joint").coarsened(4)
    solvers = (BoxDDP(problem, second_order=name, max_iterations=80) for name in ("mirrored", "hybrid"))
    without_creeping, creeping = (solver.solve() for solver in solvers)
    assert without_creeping.converged
    assert without_creeping.cost < 0.95 * creeping.cost
