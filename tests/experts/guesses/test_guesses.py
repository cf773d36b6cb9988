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
from dq_space_arm_env.scene.layout import StateLayout
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
from experts.guesses.guided import START_REGULARIZATIONS
from experts.guesses.initial_guesses import STRAYED, ZERO_REGULARIZATION, ranked_guesses
from experts.guesses.other_side import contacts_of, other_side
from experts.guesses.policies import coarsened, follow, refined
from experts.guesses.preparation import preparation_key
from experts.guesses.screw_motion import ScrewMotion
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.solvers.runs import roll_out

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


@pytest.fixture(scope="module")
def paper():
    solver = GuidedDDP("paper")
    assert solver.coarsening == (8,)  # prepared before a test takes a part of the preparation's place
    return solver


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


# Long steps ------------------------------------------------------------------------------------------------


def test_a_policy_in_longer_steps_is_itself_again_in_the_shorter_ones(paper):
    problem, solution = paper.problem, BoxDDP(paper.problem, max_iterations=3).solve()
    longer = problem.coarsened(8)
    coarse = coarsened(solution, longer)
    fine = refined(coarse, problem)
    assert coarse.states.shape == (126, problem.n_states)
    assert fine.states.shape == solution.states.shape
    again = coarsened(fine, longer)
    for name in ("states", "controls", "feedback_gains", "parameters"):
        np.testing.assert_allclose(getattr(again, name), getattr(coarse, name), rtol=1e-14, atol=1e-14)
    # Between its own states the policy stays close to the solution's.
    position = problem.kernels.layout.state.joint_angles
    assert np.abs(fine.states[:, position] - solution.states[:, position]).max() < 5e-3


def test_limited_controls_change_evenly_in_the_shorter_steps():
    """A change that a long step may have is within the limits of its short ones."""
    rates = {"kind": "control_rate", "name": "slew", "joint_torque": 2.0}
    scene = load_scene("planar").replace(constraints=[rates], simulation={"steps": 80, "dt": 0.05})
    problem, layout = ArmProblem(scene), StateLayout.of(scene)
    coarse = problem.coarsened(8)
    np.testing.assert_allclose(coarse.rate_limits.change, 8.0 * problem.rate_limits.change, rtol=1e-14)
    policy = refined(BoxDDP(coarse, max_iterations=5).solve(), problem)
    trial = follow(policy, problem, policy.states[0])
    for states, controls in ((policy.states, policy.controls), (trial.states, trial.controls)):
        kept = controls[:, layout.previous_controls]
        np.testing.assert_array_equal(states[1:, layout.state.actuators], kept)
        change = np.abs(np.diff(kept, axis=0, prepend=states[:1, layout.state.actuators]))
        assert change.max() == pytest.approx(0.1, rel=1e-9)


def resting_cost(problem, start):
    """Cost of doing nothing."""
    return roll_out(problem, start, np.zeros((problem.horizon, problem.n_controls))).cost


def test_costs_in_long_steps_are_those_of_fewer_stages(paper):
    """The stages' costs fall by the factor, as their number does; so does the weight of the final pose."""
    problem, start = paper.problem, random_start("paper", 0)
    coarse = problem.coarsened(8)
    assert (coarse.horizon, coarse.time_step) == (problem.horizon // 8, 8 * problem.time_step)
    start[problem.kernels.layout.state.pose.stop :] = 0.0  # at rest only the pose costs
    assert 8.0 * resting_cost(coarse, start) == pytest.approx(resting_cost(problem, start), rel=1e-12)


@pytest.mark.parametrize("seed", [1, 2])
def test_long_steps_lead_to_the_same_minimum(paper, seed):
    start = random_start("paper", seed)
    solution = paper.solve(start)
    alone = GuidedDDP("paper", coarsening=1).solve(start)
    assert paper.coarsening == (8,)
    assert solution.converged
    assert solution.cost == pytest.approx(alone.cost, rel=1e-6)
    assert solution.iterations < alone.iterations
    assert {attempt["guess"] for attempt in solution.metadata["long_steps"]} >= {"zero controls"}
    assert alone.metadata["long_steps"] == []


def test_twice_coarsened_is_coarsened_by_the_product(paper):
    once, twice = paper.problem.coarsened(8), paper.problem.coarsened(2).coarsened(4)
    assert (twice.horizon, twice.time_step) == (once.horizon, once.time_step)
    start = random_start("paper", 0)
    assert resting_cost(twice, start) == resting_cost(once, start)


def nothing_kept(monkeypatch):
    """Neither read what processes prepared nor leave anything to them."""
    monkeypatch.setattr("experts.guesses.guided.read_preparation", lambda key: None)
    monkeypatch.setattr("experts.guesses.guided.keep_preparation", lambda key, preparation: None)


@pytest.fixture
def halving(monkeypatch):
    """A solver whose long steps do not lead to the minimum before they are halved."""
    monkeypatch.setattr(GuidedDDP, "leads_to_minimum", lambda self, coarse: coarse.problem.horizon == 250)
    nothing_kept(monkeypatch)
    return GuidedDDP("paper")


@pytest.mark.parametrize("seed", [1, 2])
def test_halved_steps_lead_to_the_same_minimum(paper, halving, seed):
    start = random_start("paper", seed)
    usual, solution = paper.solve(start), halving.solve(start)
    assert halving.coarsening == (8, 4)
    assert solution.converged
    assert solution.cost == pytest.approx(usual.cost, rel=1e-6)
    # What was solved in the longest steps comes first, and costs are the problem's own.
    longest, usual_longest = (
        [attempt["cost"] for attempt in found.metadata["long_steps"]] for found in (solution, usual)
    )
    assert longest[: len(usual_longest)] == pytest.approx(usual_longest, rel=1e-12)
    assert longest[len(usual_longest) :] == pytest.approx([solution.cost], rel=0.1)
    assert len(halving.library[0].controls) == halving.problem.horizon


def test_long_steps_whose_policy_strays_are_not_halved(monkeypatch):
    monkeypatch.setattr(GuidedDDP, "leads_to_minimum", lambda self, coarse: coarse.problem.horizon == 250)
    monkeypatch.setattr("experts.guesses.coarsening.STRAYED", 0.5)
    nothing_kept(monkeypatch)
    solver = GuidedDDP("paper")
    assert solver.coarsening == (4,)
    assert {attempt["guess"] for attempt in solver.solve().metadata["long_steps"]} == {
        "policy 0",
        "zero controls",
    }
    assert len(solver.solve().metadata["long_steps"]) == 2  # in steps of one length


@pytest.mark.endurance
def test_solves_of_six_joints_converge():
    solver = GuidedDDP("six-joint")
    solutions = [solver.solve(random_start("six-joint", seed)) for seed in range(8)]
    assert all(solution.converged for solution in solutions)
    assert np.median([solution.iterations for solution in solutions]) <= 20
    # Within 1 % of the best costs that are known of these starts.
    best = np.array([400.16, 131.43, 331.82, 161.57, 129.41, 344.04, 104.79, 432.20])
    assert np.all([solution.cost for solution in solutions] <= 1.01 * best)


def test_the_model_that_reaches_the_target_is_taken(monkeypatch):
    nothing_kept(monkeypatch)
    mirrored, start = GuidedDDP("planar", second_order="mirrored"), random_start("planar", 1)
    expected = mirrored.solve(start).controls.tobytes()
    monkeypatch.setattr(GuidedDDP, "_reaches", lambda solver: solver.second_order == "mirrored")
    chosen = GuidedDDP("planar")
    assert (chosen.coarsening, chosen.second_order) == (mirrored.coarsening, "mirrored")
    assert chosen.solve(start).controls.tobytes() == expected
    assert GuidedDDP("planar", second_order="hybrid").second_order == "hybrid"
    assert GuidedDDP("planar", reach_target=False).second_order == "hybrid"


def link(name, mass, inertia, center_of_mass, position, **rotation):
    joint = {"position": position, **rotation}
    return {"name": name, "mass": mass, "inertia": inertia, "center_of_mass": center_of_mass, "joint": joint}


UPRIGHT = {"rotation": {"axis": [1, 0, 0], "angle": 90}}
SERVICER = {
    "name": "servicer",
    "base": {"mass": 150.0, "inertia": [20.0, 22.0, 18.0]},
    "links": [
        link("yaw", 4, [0.03, 0.03, 0.02], [0, 0, 0.1], [0, 0, 0.5]),
        link("upper", 5, [0.02, 0.3, 0.3], [0.4, 0, 0], [0, 0, 0.2], **UPRIGHT),
        link("fore", 3, [0.01, 0.15, 0.15], [0.35, 0, 0], [0.8, 0, 0]),
        link("hand", 1.5, [0.01, 0.01, 0.01], [0.1, 0, 0], [0.7, 0, 0]),
    ],
    "tip": {"position": [0.25, 0, 0]},
    "actuators": {
        field: {"limit": limit}
        for field, limit in (("base_force", 15.0), ("base_torque", 3.0), ("joint_torque", 8.0))
    },
    "initial_state": {"joint_angles": [0.0, 0.9, -1.2, 0.3]},
    "target": {
        "pose": {"position": [1.9, 0.3, 1.2], **UPRIGHT},
        "grasp": {"position": [-0.3, 0, 0]},
        "motion": {
            "kind": "tumbling",
            "inertia": [4, 5, 6],
            "angular_velocity": [0.01, 0.03, 0.02],
            "linear_velocity": [0.01, 0.005, 0],
        },
    },
    "cost": {"tip_twist": 1.0, "terminal_tip_twist": 1000.0},
    "simulation": {"dt": 0.03, "steps": 500},
}


@pytest.mark.slow
def test_the_mirrored_model_reaches_what_the_hybrid_creeps_to():
    """Light hand, four joints: the cheapest maneuver ends 14 degrees off, where Gauss-Newton creeps."""
    hybrid = GuidedDDP(SERVICER, second_order="hybrid", coarsening=5)
    missed = hybrid.solve()
    assert not hybrid.problem.is_success(missed.states, missed.controls)
    solver = GuidedDDP(SERVICER)
    solution = solver.solve()
    assert solver.second_order == "mirrored"
    assert solution.converged
    assert solver.problem.is_success(solution.states, solution.controls)
    assert solution.cost == pytest.approx(791.5672, rel=1e-6)


@pytest.mark.slow
def test_steps_too_long_for_a_scene_are_not_taken():
    """Joints that turn within a long step: no policy of theirs survives."""
    scene = load_scene("planar").replace(simulation={"dt": 1.0, "steps": 56})
    solver = GuidedDDP(scene)
    assert solver.coarsening == ()
    assert solver.solve().metadata["long_steps"] == []


def test_a_user_who_stops_it_in_long_steps_gets_the_trajectory_so_far(paper):
    def interrupt(record):
        raise KeyboardInterrupt

    solution = paper.solve(random_start("paper", 1), callback=interrupt)
    assert solution.stop_reason is StopReason.INTERRUPTED
    assert np.isfinite(solution.cost)
    assert len(solution.controls) == paper.problem.horizon


def test_an_interrupt_at_any_iteration_ends_the_solve():
    """In long steps several guesses are compared: an earlier one may have converged, and be the best."""
    planar, start = GuidedDDP("planar"), random_start("planar", 0)
    records = []
    planar.solve(start, callback=records.append)
    for last in range(1, len(records) + 1):
        seen = []

        def interrupt(record, seen=seen, last=last):
            seen.append(record)
            if len(seen) == last:
                raise KeyboardInterrupt

        solution = planar.solve(start, callback=interrupt)
        assert solution.stop_reason is StopReason.INTERRUPTED
        assert len(seen) == last
        assert np.isfinite(solution.cost)


def test_an_interrupt_counts_where_the_guess_from_long_steps_is_optimal_or_diverges(monkeypatch):
    def interrupt(record):
        raise KeyboardInterrupt

    planar = GuidedDDP("planar")
    optimal = planar.solve()
    monkeypatch.setattr("experts.guesses.guided.refined", lambda solution, problem: optimal)
    assert planar.solve(callback=interrupt).stop_reason is StopReason.INTERRUPTED
    nowhere = replace(optimal, controls=np.full_like(optimal.controls, np.nan))
    monkeypatch.setattr("experts.guesses.guided.refined", lambda solution, problem: nowhere)
    solution = planar.solve(random_start("planar", 0), callback=interrupt)
    assert solution.stop_reason is StopReason.INTERRUPTED
    assert names(solution) == ["zero controls"]


def test_a_number_of_steps_that_does_not_divide_the_stages_is_refused():
    with pytest.raises(ValueError, match="factor is 7; it must divide the 1000 stages"):
        GuidedDDP("paper", coarsening=7)
    for coarsening in (0, -8, 2.5, 2.0, (4, 3), (2, 4), ("8",)):
        with pytest.raises(ValueError, match="it must be whole numbers of steps, each a multiple"):
            GuidedDDP("paper", coarsening=coarsening)


def test_delays_count_steps_and_leave_no_long_ones():
    delayed = load_scene("planar").replace(actuators={"joint_torque": {"limit": 1.0, "delay": 2}})
    problem = ArmProblem(delayed)
    assert problem.can_coarsen(1)
    assert not any(problem.can_coarsen(factor) for factor in (2, 4, 8))
    with pytest.raises(ValueError, match="factor is 4; it must be 1: delays of actuators are whole steps"):
        problem.coarsened(4)


def test_only_scenes_have_long_steps(unicycle):
    assert GuidedDDP(unicycle, coarsening=[]).coarsening == ()
    with pytest.raises(
        ValueError, match=r"coarsening is \(2,\); only the maneuver of a scene has long steps"
    ):
        GuidedDDP(unicycle, coarsening=2)


@pytest.fixture
def kept(monkeypatch, tmp_path):
    """Lists the files of preparations in an empty cache."""
    GuidedDDP("planar", library=[]).solve()  # compiles
    monkeypatch.setattr("dq_space_arm_env.common.code_cache.cache_directory", lambda: tmp_path)
    return lambda: list(tmp_path.glob("guided-ddp-*"))


def test_another_process_reads_what_one_prepared_and_solves_the_same(monkeypatch, kept):
    first = GuidedDDP("planar")
    start = random_start("planar", 3)
    expected = first.solve(start)
    assert len(kept()) == 1
    monkeypatch.setattr("experts.guesses.guided.find_coarsening", None)
    second = GuidedDDP("planar")
    assert (second.coarsening, second.second_order) == (first.coarsening, first.second_order)
    assert second.solve(start).controls.tobytes() == expected.controls.tobytes()
    np.testing.assert_array_equal(first.library[0].states, second.library[0].states)


def test_other_settings_have_another_preparation(kept):
    for settings in ({}, {"tolerance": 1e-6}, {"reach_target": False}, {"max_iterations": 100}):
        _ = GuidedDDP("planar", **settings).coarsening
    assert len(kept()) == 4
    for settings in ({"remember": 1}, {"coarsening": 8}, {"library": []}):
        GuidedDDP("planar", **settings).solve()
    assert len(kept()) == 4


def test_success_as_constraint_has_another_preparation():
    problem = ArmProblem("planar")
    keys = [preparation_key(each, {}) for each in (problem, problem.constrained(), problem.constrained(0.3))]
    assert len(set(keys)) == 3
    assert preparation_key(problem.constrained(0.3), {}) == keys[2]


def test_a_damaged_preparation_is_made_again(kept):
    _ = GuidedDDP("planar").coarsening
    (path,) = kept()
    content = path.read_bytes()
    path.write_bytes(content[:-100])
    with pytest.warns(UserWarning, match="is damaged"):
        _ = GuidedDDP("planar").coarsening
    assert len(path.read_bytes()) == len(content)


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
