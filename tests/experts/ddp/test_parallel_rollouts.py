"""Several step lengths at once against one rollout after another."""

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from experts import BoxDDP
from experts.ddp.parallel_rollouts import LANES
from experts.ddp.shooting import SHORTER_STEPS, ShootingWorkspace, line_search
from experts.problems.arm_problem import ArmProblem

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def prepared():
    """A workspace with an update, some of whose inputs meet their bounds."""
    scene = load_scene("no-wrist")  # nine inputs: no whole number of tiles
    problem = ArmProblem(scene.replace(parameters=["actuators", "target.pose"]))
    names = problem.kernels.parameters.names
    is_limit = np.array([name.startswith("actuators") for name in names])
    problem.parameters.set(problem.parameters.nominal / np.where(is_limit, 20.0, 1.0))
    work = ShootingWorkspace(problem, second_order=False)
    work.start(problem.initial_state, np.zeros((problem.horizon, problem.n_controls)))
    work.differentiate()
    work.backward_pass(1.0)
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


def test_a_lane_that_diverges_leaves_the_others_alone(prepared):
    lengths = np.array([0.5, np.nan, 0.25, 1e300])
    costs = prepared.try_steps(lengths)
    assert np.isposinf(costs[1])
    assert costs[0] == pytest.approx(prepared.try_step(0.5), rel=1e-9)
    assert costs[2] == pytest.approx(prepared.try_step(0.25), rel=1e-9)


class _Direction:
    """A search direction that predicts a given reduction."""

    def __init__(self, share):
        self.share = share

    def predicted_reduction(self, alpha):
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
    assert line_search(work, _Direction(1.0)) == SHORTER_STEPS[4]
    assert work.trial.cost == before - 2.0
    assert line_search(work, _Direction(1e9)) == 0.0


def test_threads_change_nothing():
    alone = BoxDDP("no-wrist", max_iterations=3).solve()
    together = BoxDDP("no-wrist", max_iterations=3, threads=2).solve()
    np.testing.assert_array_equal(alone.states, together.states)
    np.testing.assert_array_equal(alone.controls, together.controls)
