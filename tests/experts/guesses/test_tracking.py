"""Tracking of a guessed trajectory by linear-quadratic feedback."""

import numpy as np
import pytest

from experts import BoxDDP
from experts.guesses.policies import track


def test_what_obeys_the_dynamics_is_repeated(unicycle):
    solution = BoxDDP(unicycle, max_iterations=3).solve()
    controls, cost = track(unicycle, solution.states, solution.controls)
    np.testing.assert_allclose(controls, solution.controls, rtol=0, atol=1e-12)
    assert cost == pytest.approx(solution.cost, rel=1e-12)


@pytest.mark.slow
def test_the_gains_are_those_of_the_regulator(double_integrator):
    """Around rest at the origin they steer a deviation as the optimal controls do.

    The guess begins where the rollout does, so nothing is done about the deviation at the first stage.
    """
    problem = double_integrator.problem()
    states = np.zeros((problem.horizon + 1, 2))
    states[0] = double_integrator.initial_state
    controls, cost = track(problem, states, np.zeros((problem.horizon, 1)))
    H, g, c = double_integrator.condensed(states[0])
    best = -np.linalg.solve(H[1:, 1:], g[1:])
    np.testing.assert_allclose(controls[:, 0], [0.0, *best], rtol=0, atol=1e-9)
    expected = 0.5 * best @ H[1:, 1:] @ best + g[1:] @ best + c
    assert cost == pytest.approx(expected, rel=1e-9)


def test_feedback_follows_what_open_loop_controls_lose(unicycle):
    """Controls with a steady error: their rollout strays, the tracked one stays near the guess."""
    solution = BoxDDP(unicycle).solve()
    guess = np.clip(solution.controls + np.array([0.0, 0.3]), unicycle.control_lower, unicycle.control_upper)
    controls, cost = track(unicycle, solution.states, guess)
    open_loop = BoxDDP(unicycle, max_iterations=0).solve(u_init=guess)
    assert cost < 0.2 * open_loop.cost
    assert np.all((controls >= unicycle.control_lower) & (controls <= unicycle.control_upper))


def test_a_rollout_that_diverges_costs_infinitely_much(double_integrator):
    double_integrator.A = np.diag([1e60, 1.0])
    problem = double_integrator.problem()
    states = np.ones((problem.horizon + 1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        _, cost = track(problem, states, np.zeros((problem.horizon, 1)))
    assert cost == np.inf
