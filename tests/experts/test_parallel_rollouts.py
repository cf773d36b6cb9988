"""Several step lengths at once against one rollout after another."""

import numpy as np
import pytest

from experts import BoxDDP
from experts.arm_problem import ArmProblem
from experts.line_search import SHORTER_STEPS, line_search
from experts.parallel_rollouts import LANES
from experts.shooting import ShootingWorkspace


@pytest.fixture(scope="module")
def prepared():
    """A workspace with an update, some of whose inputs meet their bounds."""
    problem = ArmProblem("no-wrist")  # nine inputs: no whole number of tiles
    problem.control_lower, problem.control_upper = problem.control_lower / 20.0, problem.control_upper / 20.0
    work = ShootingWorkspace(problem, second_order=False)
    work.start(problem.initial_state, np.zeros((problem.horizon, problem.n_controls)))
    work.differentiate()
    work.sweep(1.0)
    return work


def test_every_lane_is_the_rollout_of_its_step_length(prepared):
    costs = prepared.try_steps(SHORTER_STEPS)
    at_bounds = 0
    for lane, alpha in enumerate(SHORTER_STEPS):
        assert prepared.try_step(alpha) == pytest.approx(costs[lane], rel=1e-9)
        states, controls = prepared.trial.states.copy(), prepared.trial.controls.copy()
        prepared.choose(lane, costs[lane])
        np.testing.assert_allclose(prepared.trial.states, states, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(prepared.trial.controls, controls, rtol=1e-7, atol=1e-7)
        at_bounds += np.count_nonzero(np.abs(controls) == prepared.problem.control_upper)
    assert at_bounds > 0


def test_fewer_lengths_than_lanes(prepared):
    costs = prepared.try_steps(np.array([0.25, 0.125]))
    assert costs.shape == (2,)
    assert costs[1] == pytest.approx(prepared.try_step(0.125), rel=1e-9)


def test_a_lane_that_diverges_leaves_the_others_alone(prepared):
    lengths = np.array([0.5, np.nan, 0.25, 1e300])
    costs = prepared.try_steps(lengths)
    assert np.isposinf(costs[1])
    assert costs[0] == pytest.approx(prepared.try_step(0.5), rel=1e-9)
    assert costs[2] == pytest.approx(prepared.try_step(0.25), rel=1e-9)


def test_all_lanes_diverge():
    problem = ArmProblem("no-wrist")
    work = ShootingWorkspace(problem, second_order=False)
    work.start(problem.initial_state, np.zeros((problem.horizon, problem.n_controls)))
    work.current.states[0, 8] = np.inf
    assert np.all(np.isposinf(work.try_steps(np.full(LANES, 0.5))))


class _Promise:
    """A sweep's outcome that promises what it is told to."""

    def __init__(self, share):
        self.share = share

    def promise(self, alpha):
        return self.share * alpha


def test_the_best_of_the_shorter_steps_is_taken(prepared, monkeypatch):
    work = prepared
    before = work.current.cost
    costs = np.full(LANES, before)
    costs[[2, 4]] = before - 1.0, before - 2.0
    monkeypatch.setattr(work, "try_step", lambda alpha: np.inf)
    monkeypatch.setattr(work, "try_steps", lambda lengths: costs)
    monkeypatch.setattr(work, "choose", lambda lane, cost: setattr(work.trial, "cost", cost))
    monkeypatch.setattr(work, "accept", lambda: None)
    assert line_search(work, _Promise(1.0)) == SHORTER_STEPS[4]
    assert work.trial.cost == before - 2.0
    assert line_search(work, _Promise(1e9)) == 0.0


def test_threads_change_nothing():
    alone = BoxDDP("no-wrist", max_iterations=3).solve()
    together = BoxDDP("no-wrist", max_iterations=3, threads=2).solve()
    np.testing.assert_array_equal(alone.states, together.states)
    np.testing.assert_array_equal(alone.controls, together.controls)


def test_threads_are_counted_from_one():
    with pytest.raises(ValueError, match="threads is 0; it must be at least 1"):
        BoxDDP("no-wrist", threads=0)
