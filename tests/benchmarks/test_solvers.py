"""The benchmark of the expert: what is concluded from runs, and that all is measured; never how fast."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene
from dq_space_arm_env.common.tables import Column
from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from experts import BoxDDP, GuidedDDP
from experts.ddp.second_order import SecondOrder
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import QUICK
from scripts.benchmarks.harness import Row, select, shortcomings
from scripts.benchmarks.solvers import BENCHMARK, _compare, constrained, random_starts, receding
from scripts.benchmarks.solvers import accuracy as contenders_module
from scripts.benchmarks.solvers.accuracy import OURS, Contender, best_costs, compare_solvers, contenders
from scripts.benchmarks.solvers.iterations import measure_iterations
from scripts.benchmarks.solvers.random_starts import (
    UNSOLVED,
    draw_starts,
    judged,
    measure_starts,
    summarized,
)
from scripts.benchmarks.solvers.receding import Controller, World, cost_of, fly, measure_flights
from scripts.benchmarks.solvers.runs import (
    GUIDED,
    TITLES,
    Search,
    SolverRun,
    box_ddp,
    guided_ddp,
    median_run,
    relative_gaps,
    time_to_gap,
)
from scripts.benchmarks.solvers.tracking import measure_tracking

SHORT = replace(QUICK, piece_repeats=1, horizons=(10,))


@pytest.fixture(scope="module")
def problem(spread_scene: Scene) -> ArmProblem:
    return ArmProblem(spread_scene)


@pytest.fixture(scope="module")
def guided(problem: ArmProblem) -> GuidedDDP:
    return GuidedDDP(problem)


def made_up(costs: list[float], seconds: list[float], **others: Any) -> SolverRun:
    """A run that nobody made."""
    given: dict[str, Any] = {
        "solver": "made up",
        "costs": np.array(costs),
        "seconds": np.array(seconds),
        "iterations": len(costs) - 1,
        "converged": True,
        "stop_reason": "it was enough",
        "controls": np.zeros((1, 1)),
        "replayed_cost": costs[-1],
        "parts": {},
        **others,
    }
    return SolverRun(**given)


# Time to accuracy ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap", "seconds"), [(1.0, 0.0), (0.5, 1.0), (1e-2, 3.0), (1e-3, 3.0), (1e-4, None)])
def test_time_to_a_gap_is_that_of_the_first_cost_within_it(gap: float, seconds: float | None) -> None:
    run = made_up([200.0, 150.0, 110.0, 100.05], [0.0, 1.0, 2.0, 3.0])
    assert time_to_gap(run, 100.0, gap) == seconds


def test_gaps_never_rise_and_stand_negative_and_zero_costs() -> None:
    run = made_up([200.0, 101.0, 300.0, 100.0], [0.0, 1.0, 2.0, 3.0])
    assert relative_gaps(run, 100.0) == pytest.approx([1.0, 0.01, 0.01, 0.0])
    assert time_to_gap(run, 100.0, 0.02) == 1.0
    assert relative_gaps(made_up([-50.0, -90.0], [0.0, 1.0]), -100.0) == pytest.approx([0.5, 0.1])
    assert time_to_gap(made_up([1e-9, 0.0], [0.0, 1.0]), 0.0, 1e-4) == 1.0


def test_a_solver_is_judged_by_the_costs_that_it_minimizes() -> None:
    run = made_up([9.0, 8.0], [0.0, 1.0], own_costs=np.array([20.0, 10.0]))
    assert time_to_gap(run, 10.0, 0.0) == 1.0
    results = [(run, "theirs"), (made_up([7.0, 6.0], [0.0, 1.0]), OURS)]
    assert best_costs(results, known=6.5) == {OURS: 6.0, "theirs": 10.0}
    assert best_costs(results, known=5.0)[OURS] == 5.0


def test_repeated_runs_have_the_median_of_their_times() -> None:
    runs = [made_up([2.0, 1.0], [0.0, t], parts={"sweep": 10 * t}) for t in (3.0, 1.0, 2.0)]
    combined = median_run(runs)
    assert combined.seconds.tolist() == [0.0, 2.0]
    assert combined.parts == {"sweep": 20.0}
    assert combined.costs.tolist() == [2.0, 1.0]


def test_runs_of_ours_tell_costs_and_times_of_every_iteration(problem: ArmProblem) -> None:
    run = box_ddp(problem, SecondOrder.HYBRID, 200)(None)
    solution = BoxDDP(problem).solve()
    assert run.costs[1:] == pytest.approx(solution.history["cost"], rel=1e-12)
    still = BoxDDP(problem, max_iterations=0).solve()
    assert run.costs[0] == still.cost
    assert run.replayed_cost == pytest.approx(solution.cost, rel=1e-12)
    assert (run.iterations, run.converged) == (solution.iterations, True)
    assert run.seconds[0] == 0.0
    assert (np.diff(run.seconds) > 0.0).all()
    assert set(run.parts) == {"derivatives", "sweep", "rollout"}


def test_guided_runs_begin_with_the_policy_of_the_library(problem: ArmProblem, guided: GuidedDDP) -> None:
    (start,) = draw_starts(problem, 1, seed=0)
    run = guided_ddp(problem, guided)(start)
    zero = box_ddp(problem, SecondOrder.HYBRID, 200)(start)
    assert run.costs[0] < zero.costs[0]
    assert (np.diff(run.costs) <= 0.0).all()
    assert run.replayed_cost == pytest.approx(guided.solve(start).cost, rel=1e-12)


def test_iterations_in_long_steps_take_time_but_have_no_cost_of_the_problem(problem: ArmProblem) -> None:
    solver = GuidedDDP(problem, coarsening=4)
    (start,) = draw_starts(problem, 1, seed=0)
    long_steps = solver.solve(start).metadata["long_steps"]
    run = guided_ddp(problem, solver)(start)
    before = sum(attempt["iterations"] for attempt in long_steps)
    assert 0 < before < run.iterations
    assert set(run.costs[: before + 1]) == {run.costs[0]}
    assert run.costs[before + 1] < run.costs[0]
    assert run.costs[-1] == pytest.approx(run.replayed_cost, rel=1e-6)
    assert len(run.costs) == len(run.seconds) == run.iterations + 1


def test_other_problems_are_measured_by_their_own_best(problem: ArmProblem, guided: GuidedDDP) -> None:
    """A solver of another problem is started from our best controls, to learn the best cost of its own."""
    solve = box_ddp(problem, SecondOrder.GAUSS_NEWTON, 200)
    asked: list[FloatArray] = []

    def shifted(x0: FloatArray | None) -> SolverRun:
        run = solve(x0)
        return replace(run, own_costs=run.costs + 1000.0)

    def from_controls(x0: FloatArray | None, controls: FloatArray) -> SolverRun:
        asked.append(controls)
        return made_up([1000.0], [0.0], own_costs=np.array([1000.0]))

    entrants = [
        Contender("ours", solve),
        Contender("knowing", solve, knows_nominal_start=True),
        Contender("theirs", shifted, formulation="theirs", is_slow=True, solve_from=from_controls),
    ]
    search = Search(problem, guided.library, 200)
    rows = list(compare_solvers(problem, entrants, search, "nominal start", None, SHORT))
    ours, theirs = select(rows, table="comparisons")  # without the one that has solved this start beforehand
    assert ours["best_known"] <= min(
        row["cost"] for row in select(rows, table="histories", solver=ours["solver"])
    )
    assert ours["best_known"] == pytest.approx(guided.solve().cost, rel=1e-6)
    assert (ours["minimizes"], theirs["minimizes"]) == (OURS, "theirs")
    assert select(rows, table="histories")[-1]["gap"] > 0.0
    (remark,) = select(rows, table="notes")
    assert "best known cost, 1000" in remark["note"]
    assert asked[0].shape == (problem.horizon, problem.n_controls)
    assert shortcomings(rows) == []


def test_solvers_that_are_not_there_are_named(
    problem: ArmProblem, guided: GuidedDDP, monkeypatch: pytest.MonkeyPatch
) -> None:
    for peer in (contenders_module.crocoddyl_peer, contenders_module.interior_point_peer):
        monkeypatch.setattr(peer, "is_available", lambda: False)
    found, notes = contenders(problem, guided, replace(SHORT, peers=True))
    assert [contender.name for contender in found] == [*TITLES.values(), GUIDED]
    assert "paper's formulation" in notes[0]
    assert "Crocoddyl is left out: it is not installed" in notes[1]
    assert "IPOPT is left out: it is not installed" in notes[2]


# Iterations ------------------------------------------------------------------------------------------------


def test_times_to_a_cost_leave_out_scenes_with_constraints(guided: GuidedDDP) -> None:
    """Their iterations violate constraints, below the cost of any maneuver that keeps to them."""
    (row,) = _compare(ArmProblem("joint-limits"), guided, SHORT)
    assert "leave out scene joint-limits" in row["note"]


def test_iterations_are_those_of_the_solver(problem: ArmProblem) -> None:
    rows = list(measure_iterations(problem, SHORT))
    variants = select(rows, table="iterations")
    assert [row["variant"] for row in variants] == list(TITLES.values())
    for row, second_order in zip(variants, SecondOrder, strict=True):
        solution = BoxDDP(problem, second_order=second_order).solve()
        assert (row["iterations"], row["cost"]) == (solution.iterations, solution.cost)
        assert 0.0 < row["iteration_ms"] <= 1e3 * row["median_s"]
        assert row["best_s"] <= row["median_s"]
    best, median = select(rows, table="pieces")
    for name in ("first_derivatives", "second_derivatives", "gauss_newton_sweep", "exact_sweep", "rollout"):
        assert 0.0 < best[name] <= median[name]


# Random starts ---------------------------------------------------------------------------------------------


def solved(cost: float, good: bool = True, **others: Any) -> Row:
    return {"cost": cost, "converged": True, "success": good, **others}


@pytest.mark.parametrize(
    ("ours", "best", "gap"),
    [
        (solved(101.0), solved(100.0), 0.01),
        (solved(100.0), solved(101.0), 0.0),
        (solved(100.0, good=False), solved(110.0), np.inf),  # the lower cost misses the target
        (solved(110.0), solved(100.0, good=False), 0.0),
        (solved(101.0, good=False), solved(100.0, good=False), 0.01),
    ],
)
def test_a_minimum_is_judged_among_those_that_reach_the_target(ours: Row, best: Row, gap: float) -> None:
    assert judged(ours, best)["gap"] == pytest.approx(gap)


def test_shares_of_random_starts() -> None:
    counts = ("iterations", "long_step_iterations", "seconds")
    rows = [
        {"converged": i != 1, "success": i != 2, "gap": gap, **dict.fromkeys(counts, i + 1)}
        for i, gap in enumerate((0.0, 0.9e-4, 1.1e-4, np.inf))
    ]
    summary = summarized(rows)
    assert [summary[key] for key in ("converged", "succeeded", "both", "close")] == [0.75, 0.75, 0.5, 0.5]
    for key in counts:
        assert (summary[f"{key}_median"], summary[f"{key}_90"]) == pytest.approx((2.5, 3.7))


def test_a_share_of_one_in_a_hundred_is_no_more_than_that() -> None:
    counts = dict.fromkeys(("iterations", "long_step_iterations", "seconds"), 1)
    rows = [{"converged": i > 1, "success": True, "gap": 0.0, **counts} for i in range(200)]
    assert summarized(rows)["unsolved"] == UNSOLVED
    assert summarized(rows)["missed"] == 0.0


def test_the_judge_compares_its_guesses_without_long_steps_too(
    problem: ArmProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(random_starts, "FURTHER_GUESSES", 2)
    for coarsening in (1, 2):
        judge = random_starts._judge(problem, GuidedDDP(problem, coarsening=coarsening), SHORT)
        assert judge.compare == (coarsening == 1)


def test_starts_under_constraints_that_are_not_solved_are_told() -> None:
    row = {"solver": GUIDED, "solved": True, "above_same": None}
    rows = [row] * 9 + [{**row, "solved": False}]
    assert shortcomings(constrained.claims("scene", rows)) == []
    (sentence,) = shortcomings(constrained.claims("scene", [{**row, "solved": False}, *rows]))
    assert sentence.startswith(f"constrained: scene, {GUIDED}: the error 1.8e-01 is above 0.1")
    above = [*rows, {**row, "above_same": 1e-5}]
    (sentence,) = shortcomings(constrained.claims("scene", above))
    assert sentence.endswith("J above theirs in the same minimum")


def test_starts_of_a_seed_are_the_same_however_many(problem: ArmProblem) -> None:
    few, many = draw_starts(problem, 2, 5), draw_starts(problem, 4, 5)
    assert np.array_equal(few, many[:2])
    assert not np.array_equal(few, draw_starts(problem, 2, 6))


def test_random_starts_are_the_episodes_of_the_environment(problem: ArmProblem, guided: GuidedDDP) -> None:
    rows = list(measure_starts(problem, guided, 1.5, SHORT))
    found, (summary,) = select(rows, table="random starts"), select(rows, table="start summaries")
    env = DQSpaceArmEnv(problem.scene)
    assert [row["seed"] for row in found] == [0, 1]
    for row in found:
        env.reset(seed=row["seed"])
        solution = guided.solve(np.asarray(env.state, dtype=np.float64), parameters=env.parameters)
        assert row["cost"] == solution.cost
        assert row["success"] == problem.is_success(solution.states, solution.controls)
        assert row["gap"] >= 0.0
    assert (summary["starts"], summary["preparation_s"]) == (2, 1.5)
    assert len(select(rows, table="claims")) == 2


# Receding horizon ------------------------------------------------------------------------------------------


def test_an_undisturbed_episode_costs_what_the_plan_says(problem: ArmProblem) -> None:
    solution = BoxDDP(problem).solve()

    def cost(control: Controller, world: World, seed: int = 0) -> float:
        to_action = problem.kernels.layout.to_action
        return cost_of(fly(problem, lambda x, k: to_action(control(x, k)), world, seed))

    def open_loop(state: FloatArray, stage: int) -> FloatArray:
        return np.asarray(solution.controls[stage])

    undisturbed = cost(open_loop, World("none"))
    assert undisturbed == pytest.approx(solution.cost, rel=1e-12)
    pushed = [cost(open_loop, World("pushes", push=0.05), seed) for seed in (0, 0, 1)]
    assert pushed[0] == pushed[1] != pushed[2]
    # Who does not look at the state is not disturbed by noise.
    noise = World("noise", noise=0.1)
    assert cost(open_loop, noise) == undisturbed
    assert cost(solution.policy(), noise) != undisturbed


@pytest.mark.slow
def test_times_of_actions_are_those_that_were_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight that ends early has no further ones."""
    one = np.ones(1)
    ended = {"action_seconds": np.array([3e-3, 1e-3, 0.0, 0.0, 0.0]), "length": np.array([2])}
    errors = {"is_success": one, "attitude_error": one, "position_error": one}
    flight = SimpleNamespace(diverged=one > 0.0, cost=one, **ended, **errors)
    monkeypatch.setattr(receding, "fly", lambda *given: flight)
    plan = SimpleNamespace(solution=SimpleNamespace(cost=1.0))
    expert: Any = SimpleNamespace(reset=lambda state: None, plan=plan, horizon=2, fallbacks=0, replans=0)
    made_up: Any = SimpleNamespace(scene=SimpleNamespace(name="made up"), initial_state=one, time_step=2e-3)
    row = receding._flight(made_up, expert, World("none"), [0])
    assert (row["median_ms"], row["late"]) == (2.0, 0.5)


def test_flights_have_every_horizon_and_disturbance(problem: ArmProblem) -> None:
    rows = list(measure_flights(problem, replace(SHORT, horizons=(10, 500, 900), episodes=2)))
    flights = select(rows, table="flights")
    # A horizon is no longer than the maneuver.
    assert [flight["horizon"] for flight in flights] == 3 * [10, problem.horizon]
    plan_cost = BoxDDP(problem).solve().cost
    for flight in flights:
        assert flight["plan_cost"] == pytest.approx(plan_cost, rel=1e-6)
        assert 0.0 < flight["median_ms"] <= flight["percentile_99_ms"]
    assert flights[0]["cost"] == pytest.approx(flights[0]["open_loop_cost"], rel=1e-5)
    assert len(select(rows, table="claims")) == 2
    assert shortcomings(rows) == []
    (shown, *_) = (table for table in BENCHMARK.tables if table.name == "flights")
    named = {each.key: each.title for each in shown.columns if isinstance(each, Column)}
    assert [named[key].split()[0] for key in ("attitude_error_deg", "position_error_m")] == ["largest"] * 2


@pytest.mark.slow
def test_the_tip_follows_a_target_that_the_papers_formulation_cannot() -> None:
    rows = list(measure_tracking())
    assert [row["status"] for row in rows if row["table"] == "claims"] == ["handled", "handled"]
    late = next(row for row in rows if row["time"] == "14")
    assert late["distance_mm"] < 1.0 < 100.0 < late["fixed_distance_mm"]
    assert late["angle_deg"] < 0.05 < 10.0 < late["fixed_angle_deg"]
