"""The guessing expert: policies of solved maneuvers as guesses, what wins, and what it says about it."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import dq_space_arm_env  # noqa: F401 - registers the environment
from dq_space_arm_env import load_scene
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.scene.constraint_rows import path_rows, penalized_rows
from dq_space_arm_env.scene.start import (
    draw_initial_state,
    episode_scene,
    episode_start,
    number_of_draws,
    parameter_values,
    start_from_draws,
)
from experts import BoxDDP, GuidedDDP, StopReason
from experts.demonstrations.outcomes import GUESSES
from experts.guesses.attempts import START_REGULARIZATIONS
from experts.guesses.initial_guesses import STRAYED, ZERO_REGULARIZATION, ranked_guesses
from experts.guesses.other_side import contacts_of, other_side
from experts.guesses.policies import follow
from experts.guesses.screw_motion import ScrewMotion
from experts.problems.arm_problem import ArmProblem

ELSEWHERE = np.array([0.6, 0.8, -0.2, 0.7])  # another start of the unicycle
SHIFT = np.array([0.0, 0.0, 0.3, 0.3])


def names(solution):
    return [attempt["guess"] for attempt in solution.metadata["attempts"]]


class WithGoal:
    """A problem whose task counts every episode as a success, or none."""

    def __init__(self, problem, success):
        self._problem, self._success = problem, success

    def __getattr__(self, name):
        return getattr(self._problem, name)

    def is_success(self, states, controls):
        assert len(states) == len(controls) + 1 == self.horizon + 1
        return self._success


# The guess -------------------------------------------------------------------------------------------------


def test_following_a_solution_is_a_rollout_of_its_policy(unicycle):
    solution = BoxDDP(unicycle).solve()
    followed = follow(solution, unicycle, ELSEWHERE)
    controls, cost = followed.controls, followed.cost
    policy, state, expected_cost = solution.policy(), ELSEWHERE, 0.0
    for k, u in enumerate(controls):
        np.testing.assert_allclose(u, policy(state, k), rtol=1e-12, atol=1e-12)
        expected_cost += unicycle.cost(state, u)
        state = unicycle.step(state, u, unicycle.time_step)
    assert cost == pytest.approx(expected_cost + unicycle.terminal_cost(state), rel=1e-12)
    assert np.abs(controls - solution.controls).max() > 0.1


def test_the_library_holds_the_cheapest_of_several_solves_of_the_initial_state(pendulum):
    solver = GuidedDDP(pendulum)
    costs = [BoxDDP(pendulum, initial_regularization=r).solve().cost for r in START_REGULARIZATIONS]
    (member,) = solver.library
    assert max(costs) > min(costs)
    assert member.cost == min(costs)


def test_the_initial_state_is_the_librarys_own(unicycle):
    solver = GuidedDDP(unicycle)
    solution = solver.solve()
    assert solution.iterations == 0
    assert solution.cost == pytest.approx(solver.library[0].cost, rel=1e-12)
    np.testing.assert_array_equal(solution.controls, solver.library[0].controls)


def test_an_empty_library_leaves_zero_controls(unicycle):
    solution = GuidedDDP(unicycle, library=[]).solve(ELSEWHERE)
    expected = BoxDDP(unicycle, initial_regularization=ZERO_REGULARIZATION).solve(ELSEWHERE)
    assert names(solution) == [solution.metadata["guess"]] == ["zero controls"]
    np.testing.assert_array_equal(solution.controls, expected.controls)


def test_a_library_with_other_constraints_gives_policies_without_multipliers(unicycle):
    solution = replace(BoxDDP(unicycle).solve(), multipliers=np.ones((81, 2)))
    for rows, known in ((2, True), (5, False)):
        constrained = copy(unicycle)
        constrained.constraints = SimpleNamespace(multipliers=np.zeros((81, rows)))
        (guess,) = ranked_guesses(constrained, ELSEWHERE, [solution], None)
        assert (guess.multipliers is not None) is known


def with_screw_motion(solver, states, controls):
    """A solver whose kinematic guess is a given trajectory."""
    solver._kinematic_guess = lambda x0: ScrewMotion(states, controls)
    return solver


def drifting(unicycle, x0):
    """The trajectory of a start with no control at all."""
    states, controls = [x0], np.zeros((unicycle.horizon, 2))
    for u in controls:
        states.append(unicycle.step(states[-1], u, unicycle.time_step))
    return np.array(states), controls


def test_a_screw_motion_is_solved_first_if_its_rollout_is_cheaper_than_that_of_a_policy_astray(unicycle):
    far = BoxDDP(unicycle).solve(np.array([0.0, 1.0, 0.05, 0.05]))
    good = BoxDDP(unicycle, max_iterations=8).solve(ELSEWHERE)
    rollout = follow(far, unicycle, ELSEWHERE).cost
    assert rollout > max(STRAYED * far.cost, good.cost)
    solver = with_screw_motion(GuidedDDP(unicycle, library=[far]), good.states, good.controls)
    assert names(solver.solve(ELSEWHERE)) == ["screw motion"]
    assert names(GuidedDDP(unicycle, library=[far], screw_motion=False).solve(ELSEWHERE)) == ["policy 0"]


def test_a_policy_with_the_cheaper_rollout_comes_first_all_the_same(unicycle):
    far = BoxDDP(unicycle).solve(np.array([0.0, 1.0, 0.05, 0.05]))
    problem, motion = WithGoal(unicycle, False), drifting(unicycle, ELSEWHERE)
    solvers = (GuidedDDP(problem, library=[far], attempts=n, reach_target=False) for n in (3, 2))
    three, two = (with_screw_motion(solver, *motion) for solver in solvers)
    assert names(three.solve(ELSEWHERE)) == ["policy 0", "screw motion", "zero controls"]
    assert names(two.solve(ELSEWHERE)) == ["policy 0", "zero controls"]


def test_where_a_policy_is_near_no_screw_motion_is_asked_for(unicycle):
    near = BoxDDP(unicycle).solve()
    assert follow(near, unicycle, ELSEWHERE).cost < STRAYED * near.cost
    solver = GuidedDDP(WithGoal(unicycle, False), library=[near], attempts=3, reach_target=False)
    solution = with_screw_motion(solver, *drifting(unicycle, ELSEWHERE)).solve(ELSEWHERE)
    assert names(solution) == ["policy 0", "zero controls"]


@pytest.mark.slow
def test_an_arm_needs_no_library():
    """The screw motion alone leads to the minimum, in one solve."""
    start = random_start("paper", 1)
    solution = GuidedDDP("paper", library=[]).solve(start)
    assert names(solution) == ["screw motion"]
    assert solution.converged
    np.testing.assert_array_equal(solution.states[0], start)
    assert names(GuidedDDP("paper", library=[], screw_motion=False, max_iterations=1).solve(start)) == [
        "zero controls"
    ]


# Which solution wins ---------------------------------------------------------------------------------------


def test_a_solution_depends_on_nothing_but_its_start(unicycle):
    solver = GuidedDDP(unicycle)
    first = solver.solve(ELSEWHERE)
    solver.solve(ELSEWHERE + SHIFT)
    for other in (solver.solve(ELSEWHERE), GuidedDDP(unicycle).solve(ELSEWHERE)):
        np.testing.assert_array_equal(other.states, first.states)
        np.testing.assert_array_equal(other.feedback_gains, first.feedback_gains)
        assert other.metadata == first.metadata
    assert len(solver.library) == 1


def test_converged_solutions_are_remembered_up_to_a_number(unicycle):
    solver = GuidedDDP(unicycle, remember=2)
    first = solver.solve(ELSEWHERE)
    assert first.iterations > 0
    again = solver.solve(ELSEWHERE)
    assert (again.metadata["guess"], again.iterations) == ("policy 1", 0)
    assert len(solver.library) == 2  # nothing new in what took no iteration
    second = solver.solve(ELSEWHERE + SHIFT)
    assert solver.solve(ELSEWHERE - SHIFT).converged
    assert solver.library[1:] == (first, second)


@pytest.mark.parametrize("attempts", [1, 2, 3, 4])
def test_guesses_are_tried_until_one_converges_and_the_cheapest_is_kept(unicycle, attempts):
    library = [BoxDDP(unicycle).solve(), BoxDDP(unicycle).solve(ELSEWHERE + SHIFT)]
    solver = GuidedDDP(unicycle, library=library, attempts=attempts, max_iterations=1)
    solution = solver.solve(ELSEWHERE)
    expected = ["policy 1", "policy 0", "zero controls"] if attempts > 2 else ["policy 1", "zero controls"]
    assert names(solution) == expected[:attempts]
    tried = solution.metadata["attempts"]
    assert solution.cost == min(attempt["cost"] for attempt in tried)
    assert all(attempt["stop_reason"] == "max_iterations" for attempt in tried)
    assert solution.stop_reason is StopReason.MAX_ITERATIONS
    assert GuidedDDP(unicycle, library=library).solve(ELSEWHERE).cost < solution.cost


@pytest.mark.parametrize(("success", "attempts"), [(True, 1), (False, 2)])
def test_a_final_state_that_is_no_success_calls_for_another_guess(unicycle, success, attempts):
    solution = GuidedDDP(WithGoal(unicycle, success), reach_target=False).solve(ELSEWHERE)
    assert solution.converged
    assert len(names(solution)) == attempts


def test_if_every_rollout_diverges_the_solution_says_so(double_integrator):
    double_integrator.A = np.diag([1e60, 1.0])
    solver = GuidedDDP(double_integrator.problem())
    with np.errstate(over="ignore"):
        solution = solver.solve()
    assert solver.library == ()
    assert solution.stop_reason is StopReason.DIVERGED
    assert names(solution) == ["zero controls"]


@pytest.mark.parametrize("rate", [1e5, 1e8, 1e160])
def test_an_arm_that_whirls_beyond_all_numbers_diverges(rate):
    """Kinematics overflow before the dynamics, or leave singular matrices: there is no such guess."""
    solver = GuidedDDP("planar")
    start = np.array(solver.problem.initial_state)
    start[solver.problem.kernels.layout.state.joint_rates] = rate
    assert solver.solve(start).stop_reason is StopReason.DIVERGED


# Interrupts ------------------------------------------------------------------------------------------------


def test_after_an_interrupt_no_other_guess_is_tried(unicycle):
    def interrupt(record):
        raise KeyboardInterrupt

    solution = GuidedDDP(WithGoal(unicycle, False)).solve(ELSEWHERE, callback=interrupt)
    assert solution.stop_reason is StopReason.INTERRUPTED
    assert names(solution) == ["policy 0"]


def test_an_interrupt_between_two_solves_leaves_what_the_first_found(unicycle, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    solver = GuidedDDP(unicycle, compare=True)
    expected = solver.solve(ELSEWHERE)
    monkeypatch.setattr(GuidedDDP, "_other_side", interrupt)
    found = solver.solve(ELSEWHERE)
    assert found.stop_reason is StopReason.INTERRUPTED
    np.testing.assert_array_equal(found.controls, expected.controls)
    monkeypatch.setattr("experts.guesses.guided.ranked_guesses", interrupt)
    with pytest.raises(KeyboardInterrupt):  # there is nothing yet
        solver.solve(ELSEWHERE)


def test_an_interrupt_leaves_no_half_made_library(unicycle, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    solver = GuidedDDP(unicycle)
    with monkeypatch.context() as patch:
        patch.setattr(BoxDDP, "_iterate", interrupt)
        with pytest.raises(KeyboardInterrupt):
            solver.solve(ELSEWHERE)
    assert solver.solve(ELSEWHERE).cost == GuidedDDP(unicycle).solve(ELSEWHERE).cost


# Bad input -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"remember": -1}, "remember is -1; it must be a whole number, at least 0"),
        ({"attempts": 0}, "attempts is 0; it must be a whole number, at least 1"),
        ({"attempts": 1.5}, "attempts is 1.5; it must be a whole number"),
        ({"max_iterations": -1}, "max_iterations is -1"),
        ({"reserve": 0.5}, "reserve is 0.5; it must be less than 0.5"),
        ({"reserve": "some"}, "reserve is 'some'"),
        ({"second_order": "some"}, "second_order is 'some'"),
    ],
)
def test_bad_settings_are_refused(unicycle, settings, message):
    with pytest.raises(ValueError, match=message):
        GuidedDDP(unicycle, **settings)


def test_a_start_of_text_is_refused(unicycle):
    with pytest.raises(TypeError, match="x0: of type <U1, should be real numbers"):
        GuidedDDP(unicycle).solve(["1", "0", "0", "0"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_states": 5}, r"library\[0\].states has shape \(81, 4\); expected \(81, 5\)"),
        ({"horizon": 81}, r"library\[0\].states has shape \(81, 4\); expected \(82, 4\)"),
        ({"n_tangent": 4}, r"library\[0\].feedback_gains has shape \(80, 2, 3\); expected \(80, 2, 4\)"),
    ],
)
def test_a_library_of_another_problem_is_refused(unicycle, changes, message):
    solution = BoxDDP(unicycle, max_iterations=0).solve()
    with pytest.raises(ValueError, match=message):
        GuidedDDP(replace(unicycle, **changes), library=[solution])


def test_a_library_of_something_else_is_refused(unicycle):
    with pytest.raises(TypeError, match=r"library\[0\] is of type int; it must be a Solution"):
        GuidedDDP(unicycle, library=[5])


# Scenes ----------------------------------------------------------------------------------------------------


def test_a_start_that_is_no_state_is_refused():
    solver = GuidedDDP("planar")
    with pytest.raises(ValueError, match="x0 is no state: its rotations have the lengths 0"):
        solver.solve(np.zeros(solver.problem.n_states))


def random_start(scene, seed):
    return draw_initial_state(load_scene(scene), np.random.default_rng(seed))


@pytest.mark.sampled
@pytest.mark.parametrize("seed", [4, 13])
def test_starts_of_which_zero_controls_make_little(paper, seed):
    """Starts from which zero controls end in a poor minimum, or do not end."""
    start = random_start("paper", seed)
    solution, from_zero = paper.solve(start), BoxDDP("paper", max_iterations=60).solve(start)
    assert solution.converged
    assert solution.cost <= from_zero.cost * (1.0 + 1e-6)
    np.testing.assert_array_equal(solution.states[0], start)


def test_joints_are_not_wound_up(paper):
    start = random_start("paper", 24)
    joints = paper.problem.kernels.layout.state.joint_angles

    def largest_turn(solution):
        return np.abs(solution.states[:, joints] - start[joints]).max()

    assert largest_turn(paper.solve(start)) < 2.5
    assert largest_turn(BoxDDP("paper", max_iterations=60).solve(start)) > 3.5


def test_success_is_what_the_environment_calls_so(paper):
    env = gymnasium.make("DQSpaceArm-v0", scene="paper")
    answers = set()
    for state in paper.solve().states[::50]:
        env.reset(options={"initial_state": state})
        _, _, _, _, info = env.step(np.zeros(env.action_space.shape))
        answer = paper.problem.misses(env.unwrapped.state) <= 1.0
        assert answer == info["is_success"]
        answers.add(answer)
    assert answers == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_library_serves_the_same_scene_with_another_target(seed):
    scene = load_scene("random-target")
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, number_of_draws(scene))
    start = start_from_draws(scene, draws)
    p = parameter_values(scene, episode_start(scene, draws.tolist()))
    library = GuidedDDP(scene).library
    solution = GuidedDDP(scene, library=library, screw_motion=False, attempts=1).solve(start, parameters=p)
    alone = GuidedDDP(episode_scene(scene, p)).solve(start)
    assert solution.converged
    assert solution.metadata["guess"] == "policy 0, moved"
    assert solution.cost <= 1.01 * alone.cost


@pytest.mark.endurance
def test_fifty_random_starts(paper):
    """Convergence, success, effort, and cost beside the best that either expert finds.

    Of the cheapest maneuvers a third ends farther than 10 cm from the target, for thrusters are dear: these
    starts need constraints.
    """
    starts = [random_start("paper", seed) for seed in range(50)]
    guided = [paper.solve(start) for start in starts]
    from_zero = BoxDDP("paper", initial_regularization=ZERO_REGULARIZATION)
    others = [from_zero.solve(start) for start in starts]
    iterations = [sum(a["iterations"] for a in solution.metadata["attempts"]) for solution in guided]
    costs, others_costs = (np.array([s.cost for s in found]) for found in (guided, others))
    success = np.array([paper.problem.is_success(s.states, s.controls) for s in guided])
    assert np.mean([solution.converged for solution in guided]) >= 0.98
    assert np.median(iterations) <= 20
    assert np.mean(costs <= 1.01 * np.minimum(costs, others_costs)) >= 0.98
    assert success.mean() >= 0.98
    assert np.mean([paper.problem.is_success(s.states, s.controls) for s in others]) <= 0.8


@pytest.mark.slow
def test_a_second_guess_helps_where_the_first_does_not_converge():
    start = random_start("far", 31)
    settings = {"max_iterations": 100, "coarsening": 1}
    solvers = (GuidedDDP("far", attempts=attempts, **settings) for attempts in (1, 2))
    first, both = (solver.solve(start) for solver in solvers)
    assert not first.converged
    assert both.converged
    assert both.metadata["guess"] == "zero controls"
    assert both.cost < first.cost


@pytest.mark.slow
def test_a_cheaper_way_is_found_on_the_other_side_of_an_obstacle():
    """Two classes of paths around the ball of `keep-out`, of which the other guesses find the dearer one."""
    env = DQSpaceArmEnv("keep-out")
    env.reset(seed=2)
    solution = GuidedDDP("keep-out").solve(env.state)
    costs = {"other side": [], "same side": []}
    for attempt in solution.metadata["long_steps"]:
        if attempt["stop_reason"] == "converged":
            side = "other side" if attempt["guess"] == "other side" else "same side"
            costs[side].append(attempt["cost"])
    assert solution.converged
    assert solution.metadata["guess"] == "other side"
    assert "other side" in GUESSES  # demonstrations know it
    assert min(costs["other side"]) < 0.998 * min(costs["same side"])


def test_where_no_obstacle_is_in_the_way_no_other_side_is_guessed(paper):
    assert other_side(paper.problem, paper.library[0]) is None
    diverged = replace(paper.library[0], multipliers=np.zeros((0, 0)))
    assert other_side(ArmProblem("keep-out"), diverged) is None


def test_contacts_are_found_among_multipliers_and_among_rows_that_have_none():
    """A rate of controls is a row of the constraints, but the expert has no multiplier of it."""
    scene = load_scene("keep-out")  # all its rows are distances
    rate = {"name": "slew", "kind": "control_rate", "joint_torque": 4.0, "base_torque": 5.0}
    for constraints in ([rate, *scene.constraints], [*scene.constraints, rate]):
        mixed = scene.replace(constraints=constraints)
        contacts = contacts_of(mixed)
        assert [path_rows(mixed)[contact.row] for contact in contacts.values()] == list(path_rows(scene))
        assert [penalized_rows(mixed)[column] for column in contacts] == list(path_rows(scene))
