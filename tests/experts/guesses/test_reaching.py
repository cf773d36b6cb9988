"""Final errors within the tolerances, at the least cost that takes: they become constraints where needed."""

import re
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import load_scene
from experts import BoxDDP, GuidedDDP, StopReason
from experts.ddp.augmented_lagrangian import PATIENCE, AugmentedLagrangian
from experts.ddp.end_response import EndResponse, end_response
from experts.guesses.attempts import GuessSolver
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.solvers.runs import roll_out

MISSING = 4
"""Seed of a start of `paper` whose cheapest maneuver ends some 14 cm from the target."""
KNOWN = {5001: 312.737, 5002: 567.502, 5004: 706.981, 5006: 539.598, 5007: 977.688}
"""Least costs of reaching the target from starts of `no-wrist` whose cheapest maneuver misses it."""


def start_of(scene, seed):
    env = gymnasium.make("DQSpaceArm-v0", scene=scene)
    env.reset(seed=seed)
    return env.unwrapped.state


@pytest.fixture(scope="module")
def paper():
    return GuidedDDP("paper")


@pytest.fixture(scope="module")
def start():
    return start_of("paper", MISSING)


@pytest.fixture(scope="module")
def cheapest(paper, start):
    """The cheapest maneuver, which misses the target."""
    return GuidedDDP("paper", library=paper.library, reach_target=False, attempts=1).solve(start)


@pytest.fixture(scope="module")
def solution(paper, start):
    return paper.solve(start)


def test_a_maneuver_whose_minimum_misses_the_target_reaches_it_for_a_little_more(
    paper, start, cheapest, solution
):
    problem = paper.problem
    assert cheapest.converged
    assert not problem.is_success(cheapest.states, cheapest.controls)
    assert solution.converged
    assert problem.is_success(solution.states, solution.controls)
    assert 0.998 < problem.misses(solution.states[-1]) < 1.0
    assert cheapest.cost < solution.cost < 1.001 * cheapest.cost
    assert [attempt["constrained"] for attempt in solution.metadata["attempts"]] == [True]
    assert roll_out(problem, start, solution.controls).cost == pytest.approx(solution.cost, rel=1e-9)
    assert solution.constraints.violation <= 1e-6
    assert solution.constraints.complementarity <= 1e-7
    assert "success: position error" in solution.message


def test_multipliers_are_the_price_of_the_tolerances(start, solution):
    """The cost of a minimum changes with what a row keeps free by its multiplier."""
    problem, h = ArmProblem("paper"), 1e-3

    def cost(reserve):
        solver = BoxDDP(problem.constrained(reserve), initial_regularization=0.0)
        found = solver.solve(start, solution.controls, multipliers=solution.multipliers)
        assert found.converged
        return found.cost

    tolerances = [row.tolerance for row in problem.constrained().constraints.terminal]
    price = solution.multipliers[-1] @ tolerances
    assert (cost(2.0 * h) - cost(0.0)) / (2.0 * h) == pytest.approx(price, rel=0.01)
    assert cost(0.0) == pytest.approx(solution.cost, rel=1e-9)


def test_the_response_of_the_end_is_that_of_minima_with_other_multipliers(start, solution):
    problem = ArmProblem("paper").constrained()
    solver = BoxDDP(problem, initial_regularization=0.0)
    work, rows = solver._work, problem.constraints

    def minimum(multipliers):
        """Residuals where the Lagrangian with given multipliers is least."""
        AugmentedLagrangian(rows).begin_with(multipliers)
        work.start(start, solution.controls)
        for _ in range(6):
            found = end_response(work, rows, exact=True)
            work.backward_pass(0.0, exact=True)
            work.try_step(1.0)
            work.accept()
        return rows.find(work.current.states, work.current.controls)[-1], found

    held = solution.multipliers.copy()
    held[-1] += 0.5
    residuals, response = minimum(held)
    np.testing.assert_allclose(response.residuals, residuals, rtol=0, atol=1e-9)
    for j, h in enumerate((0.1, 0.1)):
        change = np.zeros_like(held)
        change[-1, j] = h
        slope = (minimum(held + change)[0] - minimum(held - change)[0]) / (2.0 * h)
        np.testing.assert_allclose(response.slopes[:, j], slope, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("residuals", "expected"),
    [
        ([1.0, -1.0], [1.0, 0.0]),  # the second row is met by itself
        ([1.0, 1.0], [4.0 / 6.0, 4.0 / 6.0]),  # both bind: 1.5 l = 1
        ([1.0, 0.1], [1.0, 0.0]),  # the second is met once the first one is
    ],
)
def test_a_newton_step_drops_rows_that_others_meet(residuals, expected):
    problem = ArmProblem("planar").constrained()
    lagrangian = AugmentedLagrangian(problem.constraints)
    lagrangian.begin_with(np.zeros_like(lagrangian.constraints.multipliers))
    states = np.broadcast_to(problem.initial_state, (problem.horizon + 1, problem.n_states))
    slopes = np.array([[-1.0, -0.5], [-0.5, -1.0]])
    response = EndResponse(np.array(residuals), slopes)
    lagrangian.update_by_response(states, np.zeros((problem.horizon, problem.n_controls)), response)
    np.testing.assert_allclose(problem.constraints.multipliers[-1], expected, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_it_takes_few_iterations_and_no_more_than_it_must():
    solver, cheapest = GuidedDDP("no-wrist"), GuidedDDP("no-wrist", reach_target=False)
    direct = BoxDDP(solver.problem.constrained(), initial_regularization=0.0)
    for seed, cost in KNOWN.items():
        x = start_of("no-wrist", seed)
        for found in (direct.solve(x, cheapest.solve(x).controls), solver.solve(x)):
            assert found.converged
            assert found.iterations <= 25
            assert found.cost == pytest.approx(cost, rel=2e-6)


def test_where_the_cheapest_maneuver_ends_within_the_tolerances_no_constraint_is_made(paper, monkeypatch):
    monkeypatch.setattr(ArmProblem, "constrained", None)
    solution = paper.solve()
    assert solution.cost == pytest.approx(1422.18992, rel=1e-8)
    assert solution.constraints is None
    assert solution.multipliers.size == 0


def test_updates_without_progress_end_as_infeasible():
    problem = ArmProblem("planar").constrained()
    lagrangian = AugmentedLagrangian(problem.constraints)
    lagrangian.begin_with(np.zeros_like(lagrangian.constraints.multipliers))
    states = np.broadcast_to(problem.initial_state, (problem.horizon + 1, problem.n_states))
    controls = np.zeros((problem.horizon, problem.n_controls))
    residuals = problem.constraints.find(states, controls)[-1]
    assert residuals.max() > 0.0
    for _ in range(PATIENCE + 1):
        assert not lagrangian.is_infeasible
        lagrangian.update_by_response(states, controls, EndResponse(residuals, -np.eye(len(residuals))))
    assert lagrangian.is_infeasible


def test_a_violation_of_success_is_told_as_the_excess_over_the_tolerance():
    scene = load_scene("planar")
    problem = ArmProblem(scene).constrained()
    states = np.broadcast_to(problem.initial_state, (problem.horizon + 1, problem.n_states))
    lagrangian = AugmentedLagrangian(problem.constraints)
    report = lagrangian.report(states, np.zeros((problem.horizon, problem.n_controls)), 1.0, 0.01)
    error = problem.kernels.tip_errors(states[-1])[0]
    excess = np.radians(error - scene.success.attitude_error_deg)
    assert report.violation > 5.0 * excess  # the square's
    told = re.fullmatch(
        r"the largest violation is (\S+) rad, of success: attitude error", lagrangian.worst(report)
    )
    assert float(told.group(1)) == pytest.approx(excess, rel=0.05)
    violated = lagrangian.violated(states, np.zeros((problem.horizon, problem.n_controls)), 0.01)
    assert f"success: attitude error is {np.radians(error):.3g} rad" in violated


def test_a_reserve_is_a_share_of_the_tolerances(paper, start):
    solution = replace(GuidedDDP("paper", library=paper.library, reserve=0.1).solve(start), problem=None)
    assert paper.problem.misses(solution.states[-1]) == pytest.approx(0.89, abs=0.01)
    with pytest.raises(ValueError, match=r"reserve is 0\.5; it must be less than 0\.5"):
        GuidedDDP("paper", reserve=0.5)


def test_an_interrupt_while_constraints_are_compiled_leaves_the_maneuver_that_misses(
    paper, start, cheapest, monkeypatch
):
    def compiling(solver):
        raise KeyboardInterrupt

    monkeypatch.setattr(GuessSolver, "_constrained", property(compiling))
    found = GuidedDDP("paper", library=paper.library).solve(start)
    assert found.stop_reason is StopReason.INTERRUPTED
    assert found.message.startswith("interrupted by the user")
    assert found.cost == pytest.approx(cheapest.cost, rel=1e-3)  # in long steps, flown in the problem's
