"""Poor minima found out by their neighbors: the policies of nearby problems, followed from the same start.

A solver finds a local minimum, and starts that are close may end in different ones, with a joint wound up or
the arm led round the other way. A neighbor's policy knows another way, if there is one: its rollout from this
start ends up in the neighbor's valley. That costs a hundredth of a solve. Where such a rollout is cheaper
than the solution, or nearly so and yet somewhere else, the problem is solved again from there, and the
cheaper solution is kept. Where the solver has failed, the best neighbor is tried in any case.
"""

from typing import NamedTuple

import numpy as np

from experts.arm_problem import ArmProblem
from experts.problem import FloatArray
from experts.solution import Solution
from experts.trajectory import Trajectory

NEIGHBORS = 4
"""Solved problems whose policies are followed from a start: those with the nearest starts."""
CHEAPER = 0.999
"""Below this share of a solution's cost, a rollout shows that there is a better minimum."""
NEARLY_AS_CHEAP = 1.2
"""Up to this share, it may lie in a better valley: a policy followed from afar costs more than its valley's
floor, typically by a fifth."""
ELSEWHERE = 2.0
"""Joint angles of two trajectories that are ever further apart, rad, tell of different valleys."""


class Candidate(NamedTuple):
    """A problem and what the solver made of it.

    Attributes:
        start: State at stage 0, shape (n_x,), units of the state.
        solution: The result.
        is_good: Whether it is converged and a success.
    """

    start: FloatArray
    solution: Solution
    is_good: bool


class NeighborCheck:
    """Compares the solutions of a shard with what their neighbors' policies do."""

    def __init__(self, problem: ArmProblem, candidates: list[Candidate]) -> None:
        """Find out who is whose neighbor.

        Args:
            problem: The problem.
            candidates: One for each start.
        """
        self._problem, self._candidates = problem, candidates
        self._trial = Trajectory(problem)
        names = ("difference", "step_with_cost", "terminal_cost")
        self._kernels = {name: problem.kernel(name) for name in names}
        self._good = [i for i, candidate in enumerate(candidates) if candidate.is_good]
        starts = np.array([candidate.start for candidate in candidates])
        nominal = np.broadcast_to(problem.initial_state, starts.shape)
        tangents = problem.kernels.difference(nominal, starts)
        spread = tangents.std(axis=0)
        self._places = tangents / np.where(spread > 0.0, spread, 1.0)
        self._joints = problem.kernels.layout.tangent.joint_angles

    def better_way(self, i: int) -> int | None:
        """Look for a neighbor whose way is worth a solve.

        Args:
            i: Number of a candidate.

        Returns:
            Number of the neighbor whose policy does best from the start of i, of those that promise a
            solution where there is none, or a better one; None if none does.
        """
        candidate, ways = self._candidates[i], []
        for j in self._nearest(i):
            cost = self._follow(j, candidate.start)
            if np.isfinite(cost) and (not candidate.is_good or self._promises(cost, candidate.solution)):
                ways.append((cost, j))
        return min(ways)[1] if ways else None

    def _nearest(self, i: int) -> list[int]:
        others = np.array([j for j in self._good if j != i], dtype=np.int64)
        distances = np.linalg.norm(self._places[others] - self._places[i], axis=1)
        return [int(j) for j in others[np.argsort(distances, kind="stable")[:NEIGHBORS]]]

    def _follow(self, j: int, start: FloatArray) -> float:
        """Roll a policy out into the trial; its cost, inf if it is not finite."""
        solution = self._candidates[j].solution
        self._trial.states[0] = start
        reference = solution.states, solution.controls
        policy = np.zeros_like(solution.controls), solution.feedback_gains
        return self._trial.follow(self._kernels, reference, policy, alpha=0.0)

    def _promises(self, cost: float, solution: Solution) -> bool:
        """Whether the trial, of a given cost, points to a better minimum than a solution."""
        if cost > NEARLY_AS_CHEAP * solution.cost:
            return False
        if cost < CHEAPER * solution.cost:
            return True
        apart = self._problem.kernels.difference(solution.states, self._trial.states)
        return bool(np.linalg.norm(apart[:, self._joints], axis=1).max() > ELSEWHERE)
