"""What an iteration of `BoxDDP` costs: solves from zero controls, and the pieces of an iteration.

In a solve, iterations differ: some sweep several times, some try many step lengths. The pieces are therefore
also timed on one trajectory, the best one found, each by itself: a Gauss-Newton iteration and an exact one
are then compared at equal conditions, one sweep and one rollout each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from experts.arm_problem import ArmProblem
from experts.backward_sweep import SWEEP_DONE
from experts.box_ddp import BoxDDP
from experts.models import EXACT_DAMPING, SecondOrder
from experts.problem import FloatArray
from experts.report.solvers.effort import Effort
from experts.report.solvers.ours import uninterrupted
from experts.shooting import ShootingWorkspace
from experts.solution import Solution


@dataclass(frozen=True)
class VariantCost:
    """Solves of a scene's nominal maneuver from zero controls with one variant of the solver.

    Attributes:
        scene: Name of the scene.
        integrator: Name of the integrator.
        second_order: The variant.
        iterations: Number of iterations.
        cost: Final cost J.
        converged: Whether the solve converged.
        stop_reason: Why it ended.
        best_seconds: Wall-clock time of the fastest solve, s.
        median_seconds: Median over the solves, s.
        iteration_ms: Wall-clock time of an iteration, median over all of them, ms.
        derivatives_ms: Part of it that goes into derivatives, median, ms.
        sweep_ms: Part of it that goes into sweeps, median, ms.
        rollout_ms: Part of it that goes into rollouts, median, ms.
        rest_ms: What is left of it, median, ms.
    """

    scene: str
    integrator: str
    second_order: str
    iterations: int
    cost: float
    converged: bool
    stop_reason: str
    best_seconds: float
    median_seconds: float
    iteration_ms: float
    derivatives_ms: float
    sweep_ms: float
    rollout_ms: float
    rest_ms: float


@dataclass(frozen=True)
class Pieces:
    """Pieces of an iteration, each timed by itself along the best trajectory found, ms.

    Attributes:
        first_derivatives: Derivatives that Gauss-Newton needs.
        second_derivatives: What exact second derivatives need besides.
        gauss_newton_sweep: Backward sweep with Gauss-Newton's model.
        exact_sweep: Backward sweep with the exact model; None if it has no minimum there.
        rollout: One rollout of an update.
    """

    first_derivatives: float
    second_derivatives: float
    gauss_newton_sweep: float
    exact_sweep: float | None
    rollout: float

    @property
    def gauss_newton_iteration(self) -> float:
        """First derivatives, a sweep and a rollout, ms."""
        return self.first_derivatives + self.gauss_newton_sweep + self.rollout

    @property
    def exact_iteration(self) -> float | None:
        """All derivatives, a sweep with the exact model and a rollout, ms."""
        if self.exact_sweep is None:
            return None
        return self.first_derivatives + self.second_derivatives + self.exact_sweep + self.rollout

    @property
    def ratio(self) -> float | None:
        """Time of an exact iteration over that of a Gauss-Newton iteration."""
        exact = self.exact_iteration
        return None if exact is None else exact / self.gauss_newton_iteration


@dataclass(frozen=True)
class IterationCosts:
    """What iterations cost with one scene and integrator.

    Attributes:
        variants: Solves with each variant.
        best: Pieces of an iteration, the shortest samples.
        median: The same, medians.
    """

    variants: tuple[VariantCost, ...]
    best: Pieces
    median: Pieces


def measure_iterations(problem: ArmProblem, effort: Effort) -> IterationCosts:
    """Solve a maneuver with each variant of the solver, and time the pieces of an iteration.

    Args:
        problem: The maneuver.
        effort: How much to measure.

    Returns:
        The times.

    Raises:
        KeyboardInterrupt: If the user interrupts.
    """
    variants, best = [], None
    for second_order in SecondOrder:
        solver = BoxDDP(problem, second_order=second_order, max_iterations=effort.max_iterations)
        solutions = list(_solve_again_and_again(solver, effort.repeats))
        variants.append(variant_cost(problem, second_order, solutions))
        if best is None or solutions[0][0].cost < best.cost:
            best = solutions[0][0]
    assert best is not None
    return IterationCosts(tuple(variants), *time_pieces(problem, best.controls, effort.piece_repeats))


def _solve_again_and_again(solver: BoxDDP, repeats: int) -> Iterator[tuple[Solution, float]]:
    """Solve once for warming up, then with a clock."""
    uninterrupted(solver.solve())
    for _ in range(repeats):
        started = perf_counter()
        solution = uninterrupted(solver.solve())
        yield solution, perf_counter() - started


def variant_cost(
    problem: ArmProblem, second_order: SecondOrder, solutions: list[tuple[Solution, float]]
) -> VariantCost:
    """Summarize repeated solves.

    Args:
        problem: The maneuver.
        second_order: The variant.
        solutions: Solves and their durations, s; they do not differ but in their times.

    Returns:
        The summary; times of an iteration are 0 if there was none.
    """
    first = solutions[0][0]
    history = np.concatenate([solution.history for solution, _ in solutions])
    times = {name: history[f"{name}_seconds"] for name in ("derivative", "sweep", "rollout")} | {
        "iteration": history["seconds"]
    }
    rest = times["iteration"] - times["derivative"] - times["sweep"] - times["rollout"]
    return VariantCost(
        scene=problem.scene.name,
        integrator=problem.scene.simulation.integrator,
        second_order=second_order.value,
        iterations=first.iterations,
        cost=first.cost,
        converged=first.converged,
        stop_reason=first.stop_reason.value,
        best_seconds=min(seconds for _, seconds in solutions),
        median_seconds=float(np.median([seconds for _, seconds in solutions])),
        iteration_ms=_median_ms(times["iteration"]),
        derivatives_ms=_median_ms(times["derivative"]),
        sweep_ms=_median_ms(times["sweep"]),
        rollout_ms=_median_ms(times["rollout"]),
        rest_ms=_median_ms(rest),
    )


def _median_ms(seconds: FloatArray) -> float:
    return 1e3 * float(np.median(seconds)) if len(seconds) else 0.0


def time_pieces(problem: ArmProblem, controls: FloatArray, repeats: int) -> tuple[Pieces, Pieces]:
    """Time the pieces of an iteration along a trajectory, in turns.

    Args:
        problem: The maneuver.
        controls: Controls of the trajectory from the problem's initial state, shape (N, n_u), units of the
            scene.
        repeats: Samples of each piece.

    Returns:
        Shortest samples, and medians.
    """
    work = ShootingWorkspace(problem, second_order=True)
    work.start(problem.initial_state, controls)
    work.differentiate()
    work.differentiate_twice()
    damping = _damping_with_minimum(work)
    pieces: dict[str, Callable[[], object]] = {
        "first_derivatives": work.differentiate,
        "second_derivatives": work.differentiate_twice,  # once after each `differentiate`
        "gauss_newton_sweep": lambda: work.sweep(0.0),
        "rollout": lambda: work.try_step(1.0),
    }
    if damping is not None:
        pieces["exact_sweep"] = lambda: work.sweep(damping, exact=True)
    samples: dict[str, list[float]] = {name: [] for name in pieces}
    for _ in range(repeats + 1):
        for name, run in pieces.items():
            started = perf_counter()
            run()
            samples[name].append(perf_counter() - started)
    return _pieces(samples, min), _pieces(samples, lambda times: float(np.median(times)))


def _pieces(samples: dict[str, list[float]], summary: Callable[[list[float]], float]) -> Pieces:
    """Summarize samples in s; the first of each has warmed up."""
    times = {name: 1e3 * summary(seconds[1:]) for name, seconds in samples.items()}
    return Pieces(
        first_derivatives=times["first_derivatives"],
        second_derivatives=times["second_derivatives"],
        gauss_newton_sweep=times["gauss_newton_sweep"],
        exact_sweep=times.get("exact_sweep"),
        rollout=times["rollout"],
    )


def _damping_with_minimum(work: ShootingWorkspace) -> float | None:
    """Smallest damping with which the exact model has a minimum; None if none is strong enough."""
    for damping in (0.0, *EXACT_DAMPING):
        if work.sweep(damping, exact=True).status == SWEEP_DONE:
            return damping
    return None
