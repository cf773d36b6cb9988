"""A solve of a maneuver in the same terms for every solver, and the project's own solvers in these terms.

Solvers are compared by the time until their cost is close to the best known one, or to the best of their own
problem where it differs from ours. The clock excludes the allocation of work arrays and the library of
maneuvers that `GuidedDDP` solves once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.rollout import Trajectory
from experts.ddp.second_order import SecondOrder
from experts.ddp.solution import IterationRecord, Solution, uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.guesses.initial_guesses import POLICY_REGULARIZATION
from experts.guesses.policies import follow
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import PaperProblem
from experts.problems.shooting_problem import FloatArray

GAPS = (1e-2, 1e-3, 1e-4)  # gaps to the best known cost, relative to it, whose times are reported

_SMALLEST_COST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class SolverRun:
    """One solve of a maneuver by any solver."""

    solver: str
    costs: FloatArray  # of our problem after 0, 1, .. iterations, shape (n + 1,); or only first and last
    seconds: FloatArray  # since the solve began, at which these costs were reached, same shape
    iterations: int
    converged: bool
    stop_reason: str
    controls: FloatArray  # final ones, within the limits, shape (N, n_u), units of the scene
    replayed_cost: float  # of the controls rolled out in our problem
    parts: Mapping[str, float]  # median ms of an iteration in "derivatives", "sweep" and "rollout"
    own_costs: FloatArray | None = None  # that the solver minimizes, if its problem is not quite ours

    @property
    def minimized(self) -> FloatArray:
        """Costs that the solver minimizes, shape (n + 1,)."""
        return self.costs if self.own_costs is None else self.own_costs


def relative_gap(cost: float, best: float) -> float:
    """Gap between a cost and the best one."""
    return (cost - best) / max(abs(best), _SMALLEST_COST)


def relative_gaps(run: SolverRun, best: float) -> FloatArray:
    """Gap between the lowest cost so far and the best one."""
    return np.array([relative_gap(float(cost), best) for cost in np.minimum.accumulate(run.minimized)])


def time_to_gap(run: SolverRun, best: float, gap: float) -> float | None:
    """Time until a solve has come close to the best known cost."""
    reached = np.flatnonzero(relative_gaps(run, best) <= gap)
    return float(run.seconds[reached[0]]) if len(reached) else None


def median_run(runs: Sequence[SolverRun]) -> SolverRun:
    """Combine repetitions of the same solve."""
    last = runs[-1]
    same = [run for run in runs if len(run.seconds) == len(last.seconds)]
    parts = {name: float(np.median([run.parts[name] for run in same])) for name in last.parts}
    return replace(last, seconds=np.median([run.seconds for run in same], axis=0), parts=parts)


def roll_out(problem: ArmProblem, x0: FloatArray, controls: FloatArray) -> Trajectory:
    """States and cost of controls from a start; the cost is inf if the rollout is not finite."""
    trajectory = Trajectory(problem)
    trajectory.states[0], trajectory.controls[:] = x0, controls
    trajectory.roll_out({name: problem.kernel(name) for name in ("step_with_cost", "terminal_cost")})
    return trajectory


def costs_of(problem: ArmProblem, x0: FloatArray, guesses: Iterable[FloatArray]) -> FloatArray:
    """Roll several controls out from a start."""
    return np.array([roll_out(problem, x0, controls).cost for controls in guesses])


TITLES = {
    SecondOrder.GAUSS_NEWTON: "Gauss-Newton",
    SecondOrder.EXACT: "exact",
    SecondOrder.HYBRID: "hybrid",
    SecondOrder.MIRRORED: "mirrored",
}
"""The variants of `BoxDDP` in tables."""
GUIDED = "GuidedDDP"
PAPERS_STATES = "paper's states"
IPOPT, FATROP = INTERIOR_POINT = ("IPOPT", "fatrop")

Solve = Callable[[FloatArray | None], SolverRun]
"""A solver, ready to solve from a state of our problem, shape (n_x,); from the initial state if None."""


def box_ddp(problem: ArmProblem, second_order: SecondOrder, max_iterations: int) -> Solve:
    """Prepare a variant of `BoxDDP`, which starts from zero controls."""
    solver = BoxDDP(problem, second_order=second_order, max_iterations=max_iterations)

    def solve(x0: FloatArray | None) -> SolverRun:
        return _timed_run(TITLES[second_order], problem, x0, partial(solver.solve, x0))

    return solve


def guided_ddp(problem: ArmProblem, solver: GuidedDDP) -> Solve:
    """Prepare `GuidedDDP`; its library is solved now."""
    library = solver.library

    def solve(x0: FloatArray | None) -> SolverRun:
        start = problem.initial_state if x0 is None else x0
        first_cost = min((follow(member, problem, start).cost for member in library), default=np.inf)
        return _timed_run(GUIDED, problem, x0, partial(solver.solve, x0), first_cost)

    return solve


def papers_states(problem: ArmProblem, max_iterations: int) -> Solve:
    """Prepare `BoxDDP` on the paper's own formulation, from zero controls; its integrator is always RK4."""
    redundant = PaperProblem(problem.scene)
    solver = BoxDDP(redundant, max_iterations=max_iterations)

    def solve(x0: FloatArray | None) -> SolverRun:
        start = None if x0 is None else redundant.from_minimal(x0)
        return _timed_run(PAPERS_STATES, problem, x0, partial(solver.solve, start))

    return solve


def _timed_run(
    name: str,
    problem: ArmProblem,
    x0: FloatArray | None,
    solve: Callable[..., Solution],
    first_cost: float | None = None,
) -> SolverRun:
    """Solve with a clock; where several guesses are solved, the costs are the lowest so far.

    The first cost is that of zero controls by default. It stands through the iterations in long steps, which
    take time but are of another problem.
    """
    if first_cost is None:
        first_cost = _cost(problem, np.zeros((problem.horizon, problem.n_controls)), x0)
    stamps: list[float] = [0.0]
    records: list[IterationRecord] = []
    started = perf_counter()

    def look_at_clock(record: IterationRecord) -> None:
        stamps.append(perf_counter() - started)
        records.append(record)

    solution = uninterrupted(solve(callback=look_at_clock))
    attempts = solution.metadata.get("attempts")  # in the problem's own steps, which come last
    own = len(records) if attempts is None else sum(attempt["iterations"] for attempt in attempts)
    in_long_steps = len(records) - own
    costs = [first_cost] * (in_long_steps + 1) + [record.cost for record in records[in_long_steps:]]
    fields = {"derivatives": "derivative_seconds", "sweep": "sweep_seconds", "rollout": "rollout_seconds"}
    parts = {part: median_ms([getattr(record, name) for record in records]) for part, name in fields.items()}
    return SolverRun(
        solver=name,
        costs=np.minimum.accumulate(costs),
        seconds=np.array(stamps),
        iterations=len(records),
        converged=solution.converged,
        stop_reason=solution.stop_reason.value,
        controls=solution.controls,
        replayed_cost=_cost(problem, solution.controls, x0),
        parts=parts if records else {},
    )


def median_ms(seconds: Sequence[float] | FloatArray) -> float:
    """The median, ms; 0 without any."""
    return 1e3 * float(np.median(seconds)) if len(seconds) else 0.0


def _cost(problem: ArmProblem, controls: FloatArray, x0: FloatArray | None) -> float:
    return roll_out(problem, problem.initial_state if x0 is None else x0, controls).cost


FIRST_DAMPINGS = (1e2, 1e4, 1e5)
"""First dampings of solves from zero controls, besides the default; they lead to different minima."""


class Search:
    """Search for low costs from a start, with guesses and dampings that the compared solvers do not use."""

    def __init__(self, problem: ArmProblem, library: Sequence[Solution], max_iterations: int) -> None:
        self._problem, self._library = problem, tuple(library)
        self._hybrid = BoxDDP(problem, max_iterations=max_iterations)
        self._gauss_newton = BoxDDP(
            problem,
            max_iterations=max_iterations,
            second_order=SecondOrder.GAUSS_NEWTON,
            initial_regularization=POLICY_REGULARIZATION,
        )

    def solutions(self, x0: FloatArray | None) -> Iterable[Solution]:
        """Solve from a start again and again."""
        for damping in FIRST_DAMPINGS:
            self._hybrid.initial_regularization = damping
            yield uninterrupted(self._hybrid.solve(x0))
        start = self._problem.initial_state if x0 is None else x0
        for member in self._library[:1]:
            guess = follow(member, self._problem, start).controls
            yield uninterrupted(self._gauss_newton.solve(x0, guess))
