import copy
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import Solution, StopReason


@pytest.fixture
def solution(unicycle):
    return BoxDDP(unicycle, max_iterations=6).solve()


def test_save_and_load_give_back_everything(solution, tmp_path):
    solution.metadata = {"scene": {"name": "parking"}}
    path = tmp_path / "parking.solution"
    solution.save(path)
    loaded = Solution.load(path)
    for name in ("states", "controls", "feedback_gains", "history"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(solution, name))
    for name in ("cost", "stop_reason", "message", "optimality", "iterations", "metadata", "converged"):
        assert getattr(loaded, name) == getattr(solution, name)
    assert isinstance(loaded.stop_reason, StopReason)
    assert list(tmp_path.iterdir()) == [path]


def test_diverged_solution_survives_a_round_trip(double_integrator, tmp_path):
    double_integrator.A = np.diag([1e60, 1.0])
    with np.errstate(over="ignore"):
        BoxDDP(double_integrator.problem()).solve().save(tmp_path / "bad.npz")
    assert Solution.load(tmp_path / "bad.npz").cost == np.inf


def test_save_that_fails_leaves_the_old_file(solution, tmp_path):
    path = tmp_path / "solution.npz"
    solution.save(path)
    before = path.read_bytes()
    solution.metadata = {"scene": object()}
    with pytest.raises(TypeError, match="JSON"):
        solution.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_other_files_are_not_taken_for_solutions(tmp_path):
    np.savez(tmp_path / "other.npz", states=np.zeros(3))
    with pytest.raises(ValueError, match="lacks controls, facts, feedback_gains, history"):
        Solution.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"multipliers": np.zeros(3)}, "multipliers has shape"),
        ({"multipliers": np.zeros((2, 2))}, "multipliers has shape"),
        ({"constraints": {"color": 1.0}}, "constraints is .* it should have"),
        ({"constraints": 3}, "constraints is 3, it should have"),
    ],
)
def test_wrong_constraints_of_a_file_are_named(solution, tmp_path, changes, message):
    solution.save(tmp_path / "solution.npz")
    arrays = dict(np.load(tmp_path / "solution.npz"))
    facts = json.loads(str(arrays["facts"]))
    facts |= {name: value for name, value in changes.items() if name == "constraints"}
    arrays |= {name: value for name, value in changes.items() if name != "constraints"}
    np.savez(tmp_path / "wrong.npz", **{**arrays, "facts": json.dumps(facts)})
    with pytest.raises(ValueError, match=message):
        Solution.load(tmp_path / "wrong.npz")


def test_policy_repeats_the_trajectory(solution, unicycle):
    policy = solution.policy()
    x = unicycle.initial_state
    for k in range(unicycle.horizon):
        u = policy(x, k)
        np.testing.assert_allclose(u, solution.controls[k], rtol=0.0, atol=1e-12)
        x = unicycle.step(x, u, unicycle.time_step)
    np.testing.assert_allclose(x, solution.states[-1], rtol=0.0, atol=1e-10)


def test_policy_feeds_the_tangent_deviation_back_within_the_bounds(solution, unicycle):
    policy = solution.policy()
    reached = False
    for k in range(0, unicycle.horizon, 7):
        state = solution.states[k] + np.array([0.0, 0.0, 0.3, -0.2])
        deviation = unicycle.difference(solution.states[k], state)
        wanted = solution.controls[k] + solution.feedback_gains[k] @ deviation
        expected = np.clip(wanted, unicycle.control_lower, unicycle.control_upper)
        np.testing.assert_allclose(policy(state, k), expected, rtol=1e-12, atol=1e-12)
        reached = reached or np.any(wanted != expected)
    assert reached


def test_feedback_brings_a_disturbed_start_closer_than_the_plan_alone(unicycle):
    solution = BoxDDP(unicycle).solve()
    policy = solution.policy()
    start = unicycle.initial_state + np.array([0.0, 0.0, 0.05, 0.05])

    def final_cost(control):
        x = start
        for k in range(unicycle.horizon):
            x = unicycle.step(x, control(x, k), unicycle.time_step)
        return unicycle.terminal_cost(x)

    assert final_cost(policy) < 0.2 * final_cost(lambda x, k: solution.controls[k])


def test_loaded_solution_needs_a_problem_for_its_policy(solution, unicycle, pendulum, tmp_path):
    solution.save(tmp_path / "solution.npz")
    loaded = Solution.load(tmp_path / "solution.npz")
    with pytest.raises(ValueError, match=r"policy\(problem\)"):
        loaded.policy()
    with pytest.raises(ValueError, match=r"the problem needs gains \(120, 1, 2\)"):
        loaded.policy(pendulum)
    for horizon in (79, 81):
        with pytest.raises(ValueError, match=rf"the problem needs gains \({horizon}, 2, 3\)"):
            loaded.policy(replace(unicycle, horizon=horizon))
    state = solution.states[3] * 1.01
    np.testing.assert_array_equal(loaded.policy(unicycle)(state, 3), solution.policy()(state, 3))


def test_copies_and_pickles_are_those_of_a_file(solution, unicycle):
    state = solution.states[3] * 1.01
    for twin in (pickle.loads(pickle.dumps(solution)), copy.deepcopy(solution)):
        assert twin.problem is None
        assert twin.stop_reason is solution.stop_reason
        np.testing.assert_array_equal(twin.policy(unicycle)(state, 3), solution.policy()(state, 3))
    assert copy.copy(solution).problem is unicycle


def test_copies_of_a_policy_have_their_own_buffers_and_pickles_are_refused(solution):
    policy = solution.policy()
    state = solution.states[3] * 1.01
    expected = policy(state, 3)
    for twin in (copy.copy(policy), copy.deepcopy(policy)):
        policy(solution.states[9], 9)
        np.testing.assert_array_equal(twin(state, 3), expected)
        assert not np.shares_memory(twin._state, policy._state)
    with pytest.raises(TypeError, match=r"pickle or save its solution, and call policy\(problem\)"):
        pickle.dumps(policy)


@pytest.mark.parametrize("state", [0.0, np.zeros(1), np.zeros((1, 4)), np.zeros(3)])
def test_policy_refuses_states_of_another_shape(solution, state):
    with pytest.raises(ValueError, match=r"state has shape \(.*\); expected \(4,\)"):
        solution.policy()(state, 0)


@pytest.mark.parametrize("k", [-1, 80])
def test_policy_refuses_stages_outside_the_trajectory(solution, k):
    with pytest.raises(IndexError, match=f"stage {k} is outside the trajectory, which has stages 0 to 79"):
        solution.policy()(solution.states[0], k)
