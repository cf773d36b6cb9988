"""The benchmark of the expert: what is concluded from runs, and that all is measured; never how fast."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from experts import BoxDDP, GuidedDDP, StopReason
from experts.arm_problem import ArmProblem
from experts.models import SecondOrder
from experts.problem import FloatArray
from experts.report.solvers import contenders as contenders_module
from experts.report.solvers.accuracy import SolverResult, best_costs, compare_solvers
from experts.report.solvers.best_known import Search
from experts.report.solvers.contenders import OURS, Contender, contenders
from experts.report.solvers.effort import QUICK
from experts.report.solvers.iterations import Pieces, measure_iterations
from experts.report.solvers.ours import GUIDED, TITLES, box_ddp, guided_ddp, uninterrupted
from experts.report.solvers.random_starts import (
    RandomStart,
    StartSolve,
    draw_starts,
    missing_share,
    solve_random_starts,
    summarize_starts,
)
from experts.report.solvers.receding import Disturbance, disturbances, fly, measure_flights, with_masses
from experts.report.solvers.runs import SolverRun, median_run, relative_gaps, time_to_gap

SHORT = replace(QUICK, piece_repeats=1, horizons=(10,), compared_starts=1)


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


def test_a_cost_that_rises_again_does_not_undo_what_was_reached() -> None:
    run = made_up([200.0, 101.0, 300.0, 100.0], [0.0, 1.0, 2.0, 3.0])
    assert relative_gaps(run, 100.0) == pytest.approx([1.0, 0.01, 0.01, 0.0])
    assert time_to_gap(run, 100.0, 0.02) == 1.0


def test_nothing_is_above_a_best_cost_of_zero_but_what_is_not_zero() -> None:
    run = made_up([1e-9, 0.0], [0.0, 1.0])
    assert time_to_gap(run, 0.0, 1e-4) == 1.0


def test_gaps_of_negative_costs_are_positive() -> None:
    assert relative_gaps(made_up([-50.0, -90.0], [0.0, 1.0]), -100.0) == pytest.approx([0.5, 0.1])


def test_a_solver_is_judged_by_the_costs_that_it_minimizes() -> None:
    run = made_up([9.0, 8.0], [0.0, 1.0], own_costs=np.array([20.0, 10.0]))
    assert time_to_gap(run, 10.0, 0.0) == 1.0
    results = [SolverResult(run, "theirs"), SolverResult(made_up([7.0, 6.0], [0.0, 1.0]), OURS)]
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


def test_an_interrupted_solve_interrupts_the_benchmark(problem: ArmProblem) -> None:
    def interrupt(record: object) -> None:
        raise KeyboardInterrupt

    solution = BoxDDP(problem).solve(callback=interrupt)
    assert solution.stop_reason is StopReason.INTERRUPTED
    with pytest.raises(KeyboardInterrupt):
        uninterrupted(solution)


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
    found = compare_solvers(problem, entrants, search, "nominal start", None, SHORT)
    assert len(found.results) == 2  # not who has solved this start beforehand
    assert found.best["theirs"] == 1000.0
    assert found.best[OURS] <= found.results[0].run.costs.min()
    assert found.best[OURS] == pytest.approx(guided.library[0].cost, rel=1e-6)
    assert asked[0].shape == (problem.horizon, problem.n_controls)


def test_solvers_that_are_not_there_are_named(
    problem: ArmProblem, guided: GuidedDDP, monkeypatch: pytest.MonkeyPatch
) -> None:
    for peer in (contenders_module.crocoddyl_peer, contenders_module.ipopt_peer):
        monkeypatch.setattr(peer, "is_available", lambda: False)
    found, notes = contenders(problem, guided, replace(SHORT, peers=True))
    assert [contender.name for contender in found] == [*TITLES.values(), GUIDED]
    assert "paper's formulation" in notes[0]
    assert "Crocoddyl is left out: it is not installed" in notes[1]
    assert "IPOPT is left out: it is not installed" in notes[2]


def test_what_crocoddyl_cannot_do_is_said(
    problem: ArmProblem, guided: GuidedDDP, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contenders_module.crocoddyl_peer, "is_available", lambda: True)
    _, notes = contenders(problem, guided, replace(SHORT, peers=True))
    assert "a planar base" in notes[1]
    assert "--slow-peers" in notes[2]


# Iterations ------------------------------------------------------------------------------------------------


def test_an_iteration_is_the_sum_of_its_pieces() -> None:
    pieces = Pieces(1.0, 5.0, 2.0, 3.0, 0.5)
    assert pieces.gauss_newton_iteration == 3.5
    assert pieces.exact_iteration == 9.5
    assert pieces.ratio == 9.5 / 3.5
    assert replace(pieces, exact_sweep=None).ratio is None


def test_iterations_are_those_of_the_solver(problem: ArmProblem) -> None:
    costs = measure_iterations(problem, SHORT)
    for variant in costs.variants:
        solution = BoxDDP(problem, second_order=variant.second_order).solve()
        assert (variant.iterations, variant.cost) == (solution.iterations, solution.cost)
        parts = variant.derivatives_ms + variant.sweep_ms + variant.rollout_ms + variant.rest_ms
        assert 0.0 < variant.iteration_ms <= 1e3 * variant.median_seconds
        assert variant.best_seconds <= variant.median_seconds
        assert parts > 0.0
    assert [variant.second_order for variant in costs.variants] == list(SecondOrder)
    for name, best in vars(costs.best).items():
        assert 0.0 < best <= getattr(costs.median, name)


# Random starts ---------------------------------------------------------------------------------------------


def made_up_start(index: int, cost: float, converged: bool, success: bool, reachable: bool) -> RandomStart:
    """A start whose best known cost is 100, solved by one solver in index + 1 iterations and seconds."""
    solve = StartSolve("made up", cost, index + 1, float(index + 1), converged, success)
    return RandomStart(index, (solve,), 100.0, reachable)


def test_shares_of_random_starts() -> None:
    starts = [
        made_up_start(0, 100.0, True, True, True),
        made_up_start(1, 101.0, False, True, True),
        made_up_start(2, 101.5, True, False, False),
        made_up_start(3, 150.0, True, True, True),
    ]
    (summary,) = summarize_starts(starts)
    assert (summary.converged, summary.succeeded, summary.both, summary.best) == (0.75, 0.75, 0.5, 0.5)
    assert summary.iterations == pytest.approx((2.5, 3.7))
    assert summary.seconds == pytest.approx((2.5, 3.7))
    assert missing_share(starts) == 0.25
    assert summarize_starts([]) == []


def test_starts_of_a_seed_are_the_same_however_many(problem: ArmProblem) -> None:
    few, many = draw_starts(problem, 2, 5), draw_starts(problem, 4, 5)
    assert np.array_equal(few, many[:2])
    assert not np.array_equal(few, draw_starts(problem, 2, 6))


def test_random_starts_are_judged_by_the_best_of_many_guesses(problem: ArmProblem, guided: GuidedDDP) -> None:
    states = draw_starts(problem, 2, 0)
    starts = list(solve_random_starts(problem, guided, SHORT, states))
    assert [start.index for start in starts] == [0, 1]
    for start, state in zip(starts, states, strict=True):
        names = [solve.solver for solve in start.solves]
        assert names == [TITLES[SecondOrder.GAUSS_NEWTON], TITLES[SecondOrder.HYBRID], GUIDED]
        assert start.best_cost <= min(solve.cost for solve in start.solves)
        solution = guided.solve(state)
        assert start.solves[2].cost == solution.cost
        assert start.solves[2].is_success == problem.is_success(solution.states[-1])
        attempts = solution.metadata["attempts"]
        assert start.solves[2].iterations == sum(attempt["iterations"] for attempt in attempts)


# Receding horizon ------------------------------------------------------------------------------------------


def test_an_undisturbed_episode_costs_what_the_plan_says(problem: ArmProblem) -> None:
    solution = BoxDDP(problem).solve()
    world = compile_scene(problem.scene)
    start = problem.initial_state
    episode = fly(world, lambda x, k: solution.controls[k], Disturbance("none"), start, seed=0)
    assert episode.cost == pytest.approx(solution.cost, rel=1e-12)
    pushed = [
        fly(world, lambda x, k: solution.controls[k], Disturbance("pushes", push=0.05), start, seed)
        for seed in (0, 0, 1)
    ]
    assert pushed[0] == pushed[1] != pushed[2]
    # Who does not look at the state is not disturbed by noise.
    noise = Disturbance("noise", noise=0.1)
    assert fly(world, lambda x, k: solution.controls[k], noise, start, 0) == episode
    assert fly(world, solution.policy(), noise, start, 0) != episode


def test_flights_have_every_horizon_and_disturbance(problem: ArmProblem) -> None:
    effort = replace(SHORT, horizons=(10, 500, 900), episodes=2)
    flights = list(measure_flights(problem, effort, seed=0))
    # A horizon is no longer than the maneuver.
    assert [flight.horizon for flight in flights] == 3 * [10, problem.horizon]
    plan_cost = BoxDDP(problem).solve().cost
    for flight in flights:
        assert flight.plan_cost == pytest.approx(plan_cost, rel=1e-6)
        assert 0.0 < flight.median_ms <= flight.percentile_99_ms
        assert len(flight.costs) == len(flight.policy_costs) == (1 if flight.disturbance == "none" else 2)
    assert flights[0].costs == pytest.approx(flights[0].open_loop_costs, rel=1e-5)


def test_masses_are_the_payloads_or_the_last_links() -> None:
    paper, payload = load_scene("paper"), load_scene("payload")
    lighter = with_masses(paper, 0.8)
    assert [link.mass for link in lighter.links] == pytest.approx([5.0, 10.0, 8.0])
    assert np.array(lighter.links[2].inertia) == pytest.approx(0.8 * np.array(paper.links[2].inertia))
    assert payload.payload is not None
    heavier = with_masses(payload, 1.2).payload
    assert heavier is not None
    assert heavier.mass == pytest.approx(1.2 * payload.payload.mass)
    assert np.array(heavier.inertia) == pytest.approx(1.2 * np.array(payload.payload.inertia))
    assert with_masses(paper, 1.0) is paper
    names = [disturbance.name for disturbance in disturbances(payload, other_masses=True)]
    assert names[-2:] == ["payload x 0.8", "payload x 1.2"]
    assert len(disturbances(paper, other_masses=False)) == 3
