"""Guesses of the states for multiple shooting, and what must hold for every solution."""

import numpy as np
import pytest


def random_guess(problem, seed=0, spread=0.3):
    """States that have nothing to do with the controls: the initial state moved about at random."""
    rng = np.random.default_rng(seed)
    offsets = spread * rng.normal(size=(problem.horizon + 1, problem.n_tangent))
    states = np.array([problem.retract(problem.initial_state, offset) for offset in offsets])
    lower, upper = np.maximum(problem.control_lower, -2.0), np.minimum(problem.control_upper, 2.0)
    return states, rng.uniform(lower, upper, size=(problem.horizon, problem.n_controls))


def assert_rolled_out(solution, problem, x0=None):
    """The states are those that the controls lead to, bit for bit, and the cost is theirs."""
    x = problem.initial_state if x0 is None else x0
    cost = 0.0
    np.testing.assert_array_equal(solution.states[0], x)
    for k, u in enumerate(solution.controls):
        cost += problem.cost(x, u)
        x = problem.step(x, u, problem.time_step)
        np.testing.assert_array_equal(solution.states[k + 1], x)
    assert solution.cost == pytest.approx(cost + problem.terminal_cost(x), rel=1e-12)
    assert np.all((problem.control_lower <= solution.controls) & (solution.controls <= problem.control_upper))
