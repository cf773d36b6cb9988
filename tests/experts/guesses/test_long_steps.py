"""What `GuidedDDP` prepares: long steps, the model of second derivatives, and what is kept on disk."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.start import draw_initial_state
from experts import BoxDDP, GuidedDDP, StopReason
from experts.guesses.policies import coarsened, follow, refined
from experts.guesses.preparation import preparation_key
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.solvers.runs import roll_out


def random_start(scene, seed):
    return draw_initial_state(load_scene(scene), np.random.default_rng(seed))


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


@pytest.mark.parametrize("settings", [{}, {"coarsening": [8, 4]}, {"coarsening": 1}])
def test_the_preparation_reports_its_iterations_and_can_be_interrupted(monkeypatch, settings):
    nothing_kept(monkeypatch)
    solver, silent = GuidedDDP("planar", **settings), GuidedDDP("planar", **settings)
    records = []

    def stop_at_the_fifth(record):
        records.append(record)
        if len(records) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solver.prepare(stop_at_the_fifth)
    assert len(records) == 5
    records.clear()
    solver.prepare(records.append)
    known = len(records)
    assert known >= sum(solution.iterations for solution in solver.library) > 0
    silent.prepare()
    assert solver.coarsening == silent.coarsening
    np.testing.assert_array_equal(solver.library[0].controls, silent.library[0].controls)
    solver.prepare(records.append)
    solver.solve()
    assert len(records) == known  # nothing left to prepare, and solves are not part of it


def test_an_interrupt_while_another_model_is_tried_begins_anew(monkeypatch):
    nothing_kept(monkeypatch)
    interrupts = [True]

    def reaches(solver):
        """Only the mirrored model reaches the target; the first look at it is interrupted."""
        if solver._solver.second_order != "mirrored":
            return False
        if interrupts:
            raise KeyboardInterrupt(interrupts.pop())
        return bool(solver.library)

    monkeypatch.setattr(GuidedDDP, "_reaches", reaches)
    solver = GuidedDDP("planar")
    with pytest.raises(KeyboardInterrupt):
        solver.prepare()
    solver.prepare()
    assert solver.second_order == "mirrored"


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


@pytest.mark.endurance
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
    assert [attempt["guess"] for attempt in solution.metadata["attempts"]] == ["zero controls"]


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


def test_the_same_preparation_serves_all_parameters():
    problem = ArmProblem(load_scene("planar").replace(parameters=["actuators.joint_torque"]))
    key = preparation_key(problem, {})
    problem.parameters.set(0.9 * problem.parameters.nominal)
    assert preparation_key(problem, {}) == key


def test_the_library_is_in_the_steps_of_the_problem(paper):
    (maneuver,) = paper.library
    assert maneuver.problem is paper.problem
    last = paper.problem.horizon - 1
    np.testing.assert_allclose(maneuver.policy()(maneuver.states[last], last), maneuver.controls[last])


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
