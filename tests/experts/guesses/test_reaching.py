"""Final errors within the tolerances, at the least cost that takes."""

from contextlib import contextmanager

import gymnasium
import numpy as np
import pytest

from experts import BoxDDP, GuidedDDP
from experts.ddp.solution import Solution, StopReason
from experts.guesses.reaching import LARGEST_EMPHASIS, MOST_SOLVES, SMALLEST_RISE, Reached, reach
from experts.problems.arm_problem import ArmProblem
from scripts.benchmarks.solvers.runs import roll_out

MISSING = 4
"""Seed of a start of `paper` whose cheapest maneuver ends some 14 cm from the target."""


class Spring:
    """One number x; minimizes 10 (x - 1)^2 + emphasis g x^2, from 1 to 0 as the emphasis grows."""

    def __init__(self, g, tolerance):
        self.g, self.tolerance, self.emphasis = g, tolerance, 1.0

    @contextmanager
    def emphasized(self, emphasis):
        self.emphasis = emphasis
        yield
        self.emphasis = 1.0

    def misses(self, state):
        return abs(state[0]) / self.tolerance

    def end_cost(self, state):
        return self.emphasis * self.g * state[0] ** 2

    def solve(self, reason=StopReason.CONVERGED):
        x = 10.0 / (10.0 + self.emphasis * self.g)
        cost = 10.0 * (x - 1.0) ** 2 + self.emphasis * self.g * x**2
        return Solution(
            states=np.array([[x]]),
            controls=np.zeros((1, 1)),
            feedback_gains=np.zeros((1, 1, 1)),
            cost=cost,
            stop_reason=reason,
            message="solved",
            optimality=0.0,
            iterations=1,
            history=np.zeros(0),
            parameters=np.zeros((2, 0)),
        )


@pytest.mark.parametrize("g", [0.01, 0.1, 3.0])
@pytest.mark.parametrize("tolerance", [0.5, 0.1, 0.02])
def test_the_emphasis_is_hardly_larger_than_it_must_be(g, tolerance):
    """The error is 10 / (10 + emphasis g): the response is learnt from the first solve, whatever it is."""
    spring = Spring(g, tolerance)
    plain = spring.solve()
    if spring.misses(plain.states[-1]) <= 1.0:
        pytest.skip("within the tolerance without any emphasis")
    steps = list(reach(spring, Reached(1.0, plain), lambda controls: spring.solve()))
    least = (10.0 / tolerance - 10.0) / g
    if least > LARGEST_EMPHASIS:
        assert steps[-1].emphasis == LARGEST_EMPHASIS
        return
    assert spring.misses(steps[-1].solution.states[-1]) <= 1.0
    first = 1.0 + 50.0 * (spring.misses(plain.states[-1]) / 0.95 - 1.0)
    assert steps[-1].emphasis <= max(1.15 * least, SMALLEST_RISE * first)
    assert len(steps) <= MOST_SOLVES


def test_costs_are_the_problems_own():
    spring = Spring(1.0, 0.1)
    for step in reach(spring, Reached(1.0, spring.solve()), lambda controls: spring.solve()):
        x = step.solution.states[-1, 0]
        assert step.solution.cost == pytest.approx(10.0 * (x - 1.0) ** 2 + x**2, rel=1e-12)
        assert f"{step.emphasis:.3g} times its weight" in step.solution.message


def test_it_ends_where_a_solve_does_not_converge():
    spring = Spring(1.0, 1e-3)
    steps = list(
        reach(spring, Reached(1.0, spring.solve()), lambda controls: spring.solve(StopReason.PLATEAU))
    )
    assert len(steps) == 1


@pytest.fixture(scope="module")
def paper():
    return GuidedDDP("paper")


@pytest.fixture(scope="module")
def start():
    env = gymnasium.make("DQSpaceArm-v0", scene="paper")
    env.reset(seed=MISSING)
    return env.unwrapped.state


def test_a_maneuver_whose_minimum_misses_the_target_reaches_it_for_a_little_more(paper, start):
    problem = paper.problem
    cheapest = GuidedDDP("paper", library=paper.library, reach_target=False, attempts=1).solve(start)
    solution = paper.solve(start)
    assert cheapest.converged
    assert not problem.is_success(cheapest.states[-1])
    assert solution.converged
    assert problem.is_success(solution.states[-1])
    assert solution.metadata["emphasis"] > 1.0
    assert cheapest.cost < solution.cost < 1.001 * cheapest.cost
    assert len(solution.metadata["attempts"]) == 1  # the emphasis is found in long steps
    assert problem.terminal_inputs[0][0] == 1.0
    assert roll_out(problem, start, solution.controls).cost == pytest.approx(solution.cost, rel=1e-9)


def test_it_is_the_cheapest_maneuver_that_ends_as_near(paper, start):
    """Everett: what ends nearer costs more, and nothing that ends as near costs less."""
    solution = paper.solve(start)
    problem, emphasis = paper.problem, solution.metadata["emphasis"]
    solver = BoxDDP(problem, initial_regularization=0.0)

    def pose_cost(state):
        with problem.emphasized(2.0):
            twice = problem.end_cost(state)
        return twice - problem.end_cost(state)

    def found(factor):
        with problem.emphasized(factor):
            result = solver.solve(start, solution.controls)
        g = pose_cost(result.states[-1])
        return g, result.cost - (factor - 1.0) * g

    (far, cheap), (here, cost), (near, dear) = (found(f * emphasis) for f in (0.5, 1.0, 2.0))
    assert near < here < far
    assert cheap < cost < dear
    assert cost == pytest.approx(solution.cost, rel=1e-9)


@pytest.mark.parametrize("emphasis", [1.0, 30.0])
def test_derivatives_of_the_emphasized_terminal_cost(emphasis):
    problem = ArmProblem("paper")
    kernels, x = problem.kernels, problem.initial_state
    solver = BoxDDP(problem)
    work = solver._work
    work.start(x, np.zeros((problem.horizon, problem.n_controls)))
    state, h, eye = work.current.states[-1].copy(), 1e-4, np.eye(problem.n_tangent)
    with problem.emphasized(emphasis):
        work.differentiate()
        work.differentiate_twice()

        def cost(z):
            return problem.end_cost(kernels.retract(state, z))

        slopes = [(cost(h * e) - cost(-h * e)) / (2.0 * h) for e in eye]
        curvatures = [(cost(h * e) - 2.0 * cost(0.0 * e) + cost(-h * e)) / h**2 for e in eye]
    scale = emphasis * 150.0
    np.testing.assert_allclose(work.derivatives.terminal_lx[0], slopes, rtol=1e-6, atol=1e-6 * scale)
    exact = np.diagonal(work._exact.terminal_xx[0])
    np.testing.assert_allclose(exact, curvatures, rtol=1e-5, atol=1e-5 * scale)
