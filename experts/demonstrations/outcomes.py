"""Outcomes of problems: solved, judged, and compared with their neighbors.

A solver finds a local minimum, and nearby starts may end in different ones, with a joint wound up or the arm
led the other way round. A neighbor's policy may know a better way: rolled out from this start,
at a hundredth of the cost of a solve, it ends in the neighbor's valley. Where such a rollout is cheaper than
the solution, or nearly as cheap but elsewhere, the problem is solved again from there, and the cheaper
solution is kept. Where the solver failed, the best neighbor is tried in any case. A neighbor with another
target is followed as it is, and moved along with the target.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dq_space_arm_env import Scene
from experts.ddp.rollout import Trajectory
from experts.ddp.solution import Solution, StopReason, uninterrupted
from experts.guesses.guided import RESERVE, GuidedDDP
from experts.guesses.policies import follow, policies
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray

MISSED_TARGET, REPLAY_DIFFERS = "missed_target", "replay_differs"
REASONS = (*(reason.value for reason in StopReason), MISSED_TARGET, REPLAY_DIFFERS)
"""Why a solve ended, or what else is wrong: the final errors exceed the tolerances, or the replay in the
environment costs something else than planned."""
NEIGHBOR = "neighbor"
GUESSES = ("policy", "screw motion", "zero controls", NEIGHBOR, "other side")
"""Initial guesses of a solve, see `experts.guesses.guided`; a neighbor is another problem of the shard."""
LEAST_GAIN = 1e-6
"""Share by which a second solution must be cheaper to replace the first."""
MOST_ITERATIONS = 25
"""Iterations after which a second solve is given up: from a good neighbor it takes a dozen."""
NEIGHBORS = 4
"""Policies that are rolled out from a start: those of the solved problems with the nearest starts."""
CHEAPER = 0.999
"""A rollout below this share of a solution's cost proves that there is a better minimum."""
NEARLY_AS_CHEAP = 1.2
"""Up to this share it may lie in a better valley: a policy followed from afar typically costs a fifth more
than the floor of its valley."""
ELSEWHERE = 2.0
"""Distance of joint angles, rad, beyond which two trajectories lie in different valleys."""


class Expert(NamedTuple):
    """A solver and its problem."""

    problem: ArmProblem
    solver: GuidedDDP  # its solutions depend on nothing but start and parameters


@dataclass(eq=False)
class Outcome:
    """A problem and its solution so far."""

    index: int
    seed: int
    start: FloatArray  # state at stage 0, shape (n_x,), units of the state
    parameters: FloatArray  # what varied in the scene, shape (n_p,)
    solution: Solution
    guess: str  # one of GUESSES
    reason: str  # one of REASONS

    @property
    def is_good(self) -> bool:
        """Whether it is a demonstration."""
        return self.reason == StopReason.CONVERGED.value


class Retry(NamedTuple):
    """A problem to be solved once more, starting with a neighbor's policy."""

    position: int  # in the shard
    neighbor: Solution


@lru_cache(maxsize=1)
def expert_of(scene: Scene) -> Expert:
    """Return the expert of this process, ready to solve: kernels compiled, the nominal maneuver solved."""
    problem = ArmProblem(scene)
    solver = GuidedDDP(problem, reserve=RESERVE)
    solver.prepare()
    return Expert(problem, solver)


def solve(expert: Expert, index: int, seed: int, start: FloatArray, parameters: FloatArray) -> Outcome:
    """Solve a problem: a start, (n_x,), and what varies in its scene, (n_p,)."""
    solution = uninterrupted(expert.solver.solve(start, parameters=parameters))
    name = solution.metadata["guess"]
    guess = GUESSES[0] if name.startswith(GUESSES[0]) else name
    return Outcome(index, seed, start, parameters, solution, guess, _judge(expert.problem, solution))


def find_better_ways(expert: Expert, outcomes: list[Outcome]) -> list[Retry]:
    """Find the problems of a shard that are worth a second solve."""
    check = _NeighborCheck(expert.problem, outcomes)
    ways = ((i, check.better_way(i)) for i in range(len(outcomes)))
    return [Retry(i, outcomes[neighbor].solution) for i, neighbor in ways if neighbor is not None]


def solve_again(expert: Expert, outcomes: list[Outcome], retries: list[Retry]) -> None:
    """Solve problems again, starting with a neighbor's policy; better outcomes replace the old ones."""
    for retry in retries:
        old = outcomes[retry.position]
        guide = GuidedDDP(
            expert.problem,
            library=[retry.neighbor],
            screw_motion=False,
            reserve=RESERVE,
            attempts=1,
            coarsening=1,  # the rollout that promises more was in the problem's own steps
            second_order=expert.solver.second_order,
            max_iterations=MOST_ITERATIONS,
        )
        solution = uninterrupted(guide.solve(old.start, parameters=old.parameters))
        reason = _judge(expert.problem, solution)
        new = replace(old, solution=solution, guess=NEIGHBOR, reason=reason)
        cheaper = solution.cost < (1.0 - LEAST_GAIN) * old.solution.cost
        if new.is_good and (cheaper or not old.is_good):
            outcomes[retry.position] = new


def _judge(problem: ArmProblem, solution: Solution) -> str:
    """Return the reason of an outcome: `CONVERGED` for a demonstration."""
    missed = solution.converged and not problem.is_success(solution.states, solution.controls)
    return MISSED_TARGET if missed else solution.stop_reason.value


class _NeighborCheck:
    """Compares the solutions of a shard with rollouts of their neighbors' policies."""

    def __init__(self, problem: ArmProblem, outcomes: list[Outcome]) -> None:
        self._problem, self._outcomes = problem, outcomes
        self._good = [i for i, outcome in enumerate(outcomes) if outcome.is_good]
        starts = np.array([outcome.start for outcome in outcomes])
        nominal = np.broadcast_to(problem.initial_state, starts.shape)
        tangents = problem.kernels.difference(nominal, starts)
        self._places = _in_units_of_spread(tangents)
        if problem.parameters.inputs:
            drawn = np.array([outcome.parameters for outcome in outcomes])
            self._places = np.hstack([self._places, _in_units_of_spread(drawn)])
        self._joints = problem.kernels.layout.tangent.joint_angles

    def better_way(self, i: int) -> int | None:
        """Find the neighbor whose policy does best from start i, if that makes a second solve worthwhile."""
        outcome, ways = self._outcomes[i], []
        self._problem.parameters.set(outcome.parameters)
        for j in self._nearest(i):
            for policy in policies(self._outcomes[j].solution, self._problem).values():
                trial = follow(policy, self._problem, outcome.start)
                if np.isfinite(trial.cost) and (
                    not outcome.is_good or self._is_better(trial, outcome.solution)
                ):
                    ways.append((trial.cost, j))
        return min(ways)[1] if ways else None

    def _nearest(self, i: int) -> list[int]:
        others = np.array([j for j in self._good if j != i], dtype=np.int64)
        distances = np.linalg.norm(self._places[others] - self._places[i], axis=1)
        return [int(j) for j in others[np.argsort(distances, kind="stable")[:NEIGHBORS]]]

    def _is_better(self, trial: Trajectory, solution: Solution) -> bool:
        """Whether a rollout points to a better minimum than a solution."""
        if trial.cost > NEARLY_AS_CHEAP * solution.cost:
            return False
        if trial.cost < CHEAPER * solution.cost:
            return True
        apart = self._problem.kernels.difference(solution.states, trial.states)
        return bool(np.linalg.norm(apart[:, self._joints], axis=1).max() > ELSEWHERE)


def _in_units_of_spread(rows: FloatArray) -> FloatArray:
    """Divide columns by their standard deviation, those that do not vary aside."""
    spread = rows.std(axis=0)
    return np.asarray(rows / np.where(spread > 0.0, spread, 1.0))
