"""What becomes of problems: solved, judged, and compared with their neighbors."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from dq_space_arm_env import Scene
from experts.arm_problem import ArmProblem
from experts.demonstrations.neighbors import Candidate, NeighborCheck
from experts.guesses import GuidedDDP
from experts.problem import FloatArray
from experts.solution import Solution, StopReason

MISSED_TARGET, REPLAY_DIFFERS = "missed_target", "replay_differs"
REASONS = (*(reason.value for reason in StopReason), MISSED_TARGET, REPLAY_DIFFERS)
"""Why a solve ended, and what else may be wrong: its end is outside of the tolerances, or the environment
charges something else than what was planned."""
NEIGHBOR = "neighbor"
GUESSES = ("policy", "screw motion", "zero controls", NEIGHBOR)
"""What a solve began with, see `experts.guesses`; a neighbor is another problem of the shard."""
LEAST_GAIN = 1e-6
"""A second solution has to be cheaper by this share to take the place of the first."""

MOST_ITERATIONS = 25
"""Iterations after which a second solve is given up: from a good neighbor it takes a dozen."""


class Expert(NamedTuple):
    """A solver and its problem.

    Attributes:
        problem: The scene as a problem.
        solver: What solves it; its solutions depend on nothing but the start.
    """

    problem: ArmProblem
    solver: GuidedDDP


@dataclass(eq=False)
class Outcome:
    """A problem and what has become of it so far.

    Attributes:
        index: Number of the problem.
        seed: Seed of its start.
        start: State at stage 0, shape (n_x,), units of the state.
        solution: What was found.
        guess: One of `GUESSES`.
        reason: One of `REASONS`.
    """

    index: int
    seed: int
    start: FloatArray
    solution: Solution
    guess: str
    reason: str

    @property
    def is_good(self) -> bool:
        """Whether it is a demonstration."""
        return self.reason == StopReason.CONVERGED.value


class Retry(NamedTuple):
    """A problem to be solved once more.

    Attributes:
        position: Its place in the shard.
        neighbor: Solution whose policy it is to begin with.
    """

    position: int
    neighbor: Solution


@lru_cache(maxsize=1)
def expert_of(scene: Scene) -> Expert:
    """The expert of this process, ready to solve: kernels compiled or loaded, the nominal maneuver solved.

    Args:
        scene: The scene, in double precision.

    Returns:
        The expert.
    """
    problem = ArmProblem(scene)
    solver = GuidedDDP(problem, remember=0)
    _ = solver.library
    return Expert(problem, solver)


def solve(expert: Expert, index: int, seed: int, start: FloatArray) -> Outcome:
    """Solve a problem.

    Args:
        expert: Who solves it.
        index: Number of the problem.
        seed: Seed of its start.
        start: State at stage 0, shape (n_x,), units of the state.

    Returns:
        The outcome.

    Raises:
        KeyboardInterrupt: If the user interrupts it.
    """
    solution = expert.solver.solve(start)
    name = solution.metadata["guess"]
    guess = GUESSES[0] if name.startswith(GUESSES[0]) else name
    return Outcome(index, seed, start, solution, guess, _judge(expert.problem, solution))


def find_better_ways(expert: Expert, outcomes: list[Outcome]) -> list[Retry]:
    """Find out which problems are worth another solve.

    Args:
        expert: Who has solved them.
        outcomes: What became of all problems of a shard.

    Returns:
        What to solve again.
    """
    candidates = [Candidate(outcome.start, outcome.solution, outcome.is_good) for outcome in outcomes]
    check = NeighborCheck(expert.problem, candidates)
    ways = ((i, check.better_way(i)) for i in range(len(outcomes)))
    return [Retry(i, outcomes[neighbor].solution) for i, neighbor in ways if neighbor is not None]


def solve_again(expert: Expert, outcomes: list[Outcome], retries: list[Retry]) -> None:
    """Solve problems again, the way of a neighbor, and keep what is better.

    Args:
        expert: Who knows the problem.
        outcomes: What became of all problems of a shard; better outcomes take their places.
        retries: What to solve again.

    Raises:
        KeyboardInterrupt: If the user interrupts it.
    """
    for retry in retries:
        old = outcomes[retry.position]
        guide = GuidedDDP(
            expert.problem,
            library=[retry.neighbor],
            screw_motion=False,
            attempts=1,
            max_iterations=MOST_ITERATIONS,
        )
        solution = guide.solve(old.start)
        reason = _judge(expert.problem, solution)
        new = Outcome(old.index, old.seed, old.start, solution, NEIGHBOR, reason)
        cheaper = solution.cost < (1.0 - LEAST_GAIN) * old.solution.cost
        if new.is_good and (cheaper or not old.is_good):
            outcomes[retry.position] = new


def _judge(problem: ArmProblem, solution: Solution) -> str:
    """The reason why a solution is what it is: `CONVERGED` if it is a demonstration."""
    if solution.stop_reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    missed = solution.converged and not problem.is_success(solution.states[-1])
    return MISSED_TARGET if missed else solution.stop_reason.value
