import numpy as np
import pytest

from dq_space_arm_env.kernels.bound import buffer_table
from experts.ddp.rollout import FINISHED, NO_RETRACTION, closed_loop_rollout, rollout
from experts.problems.shooting_problem import rate_limits, stage_bounds


class Arrays:
    """Arrays and buffer tables of a rollout of a problem."""

    def __init__(self, problem, controls):
        n = problem.horizon
        self.problem = problem
        self.time_step = np.array([problem.time_step])
        self.states, self.controls = np.zeros((n + 1, problem.n_states)), np.array(controls)
        self.stage_costs, self.terminal_cost = np.full(n, np.nan), np.full(1, np.nan)
        self.states[0] = problem.initial_state
        self.step_buffers = buffer_table(
            self.states, self.controls, self.time_step, self.states[1:], self.stage_costs
        )
        self.terminal_buffers = buffer_table(self.states[-1:], self.terminal_cost)

    def address(self, name):
        return self.problem.kernel(name).address

    def run(self):
        return rollout(
            self.address("step_with_cost"),
            self.step_buffers,
            self.address("terminal_cost"),
            self.terminal_buffers,
            self.states,
            self.stage_costs,
            self.terminal_cost,
        )

    def follow(self, reference, feedforward, gains, alpha):
        deviations = np.zeros((self.problem.horizon, self.problem.n_tangent))
        return closed_loop_rollout(
            self.address("difference"),
            buffer_table(reference.states, self.states, deviations),
            self.address("step_with_cost"),
            self.step_buffers,
            NO_RETRACTION,
            buffer_table(),
            self.address("terminal_cost"),
            self.terminal_buffers,
            reference.controls,
            feedforward,
            gains,
            alpha,
            *stage_bounds(self.problem),
            self.states,
            self.controls,
            deviations,
            self.stage_costs,
            self.terminal_cost,
            rate_limits(self.problem),
        )


def random_controls(problem, seed=0):
    bounds = problem.control_lower, problem.control_upper
    return np.random.default_rng(seed).uniform(*bounds, size=(problem.horizon, problem.n_controls))


def test_states_and_costs_follow_the_dynamics(unicycle):
    arrays = Arrays(unicycle, random_controls(unicycle))
    cost, stage = arrays.run()
    x, total = unicycle.initial_state, 0.0
    for k, u in enumerate(arrays.controls):
        total += unicycle.cost(x, u)
        x = unicycle.step(x, u, unicycle.time_step)
        np.testing.assert_array_equal(arrays.states[k + 1], x)
    assert stage == FINISHED
    assert cost == pytest.approx(total + unicycle.terminal_cost(x), rel=1e-13)
    assert cost == pytest.approx(arrays.stage_costs.sum() + arrays.terminal_cost[0], rel=1e-13)


def test_feedback_acts_in_tangent_coordinates_and_is_clipped(unicycle):
    rng = np.random.default_rng(1)
    reference = Arrays(unicycle, random_controls(unicycle))
    reference.run()
    feedforward = rng.normal(size=reference.controls.shape)
    gains = rng.normal(size=(unicycle.horizon, 2, 3))
    trial = Arrays(unicycle, np.zeros_like(reference.controls))
    cost, stage = trial.follow(reference, feedforward, gains, 0.4)
    assert stage == FINISHED
    assert np.isfinite(cost)
    for k in range(unicycle.horizon):
        deviation = unicycle.difference(reference.states[k], trial.states[k])
        wanted = reference.controls[k] + 0.4 * feedforward[k] + gains[k] @ deviation
        expected = np.clip(wanted, unicycle.control_lower, unicycle.control_upper)
        np.testing.assert_allclose(trial.controls[k], expected, rtol=1e-12, atol=1e-12)
    on_bound = np.isin(trial.controls, [unicycle.control_lower, unicycle.control_upper])
    assert 0.1 < on_bound.mean() < 0.9


def test_rollout_stops_at_the_first_state_that_is_not_finite(double_integrator):
    double_integrator.A = np.diag([1e60, 1.0])
    arrays = Arrays(double_integrator.problem(), np.zeros((40, 1)))
    with np.errstate(over="ignore"):
        cost, stage = arrays.run()
    assert (cost, stage) == (np.inf, 3)  # the square in the cost overflows before the state does
    assert np.isnan(arrays.stage_costs[4:]).all()


def test_control_that_is_not_a_number_is_not_clipped_away(unicycle):
    reference = Arrays(unicycle, random_controls(unicycle))
    reference.run()
    feedforward = np.zeros_like(reference.controls)
    feedforward[5, 1] = np.nan
    trial = Arrays(unicycle, np.zeros_like(reference.controls))
    assert trial.follow(reference, feedforward, np.zeros((80, 2, 3)), 1.0) == (np.inf, 5)
