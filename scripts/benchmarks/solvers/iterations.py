"""Time of an iteration of `BoxDDP`: in solves from zero controls, and piece by piece.

Iterations of a solve differ: some sweep several times, some try many step lengths. The pieces are therefore
also timed one by one along the best trajectory found, which compares a Gauss-Newton iteration and an exact
one at equal conditions: one sweep and one rollout each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import perf_counter

import numpy as np

from experts.ddp.backward_pass import PASS_COMPLETED
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.second_order import EXACT_MU, SecondOrder
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import Solution, uninterrupted
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row
from scripts.benchmarks.solvers.runs import TITLES, median_ms


def measure_iterations(problem: ArmProblem, effort: Effort) -> Iterator[Row]:
    """Solve a maneuver with each variant of the solver, and time the pieces of an iteration."""
    best = None
    for second_order in SecondOrder:
        solver = BoxDDP(problem, second_order=second_order, max_iterations=effort.max_iterations)
        solutions = list(_solve_again_and_again(solver, effort.repeats))
        yield variant_row(problem, second_order, solutions)
        if best is None or solutions[0][0].cost < best.cost:
            best = solutions[0][0]
    assert best is not None
    yield from time_pieces(problem, best.controls, effort.piece_repeats)


def _solve_again_and_again(solver: BoxDDP, repeats: int) -> Iterator[tuple[Solution, float]]:
    """Solve once for warming up, then with a clock."""
    uninterrupted(solver.solve())
    for _ in range(repeats):
        started = perf_counter()
        solution = uninterrupted(solver.solve())
        yield solution, perf_counter() - started


def variant_row(
    problem: ArmProblem, second_order: SecondOrder, solutions: list[tuple[Solution, float]]
) -> Row:
    """Repeated solves, which differ in their times only; times of an iteration are medians, 0 without any."""
    first = solutions[0][0]
    history = np.concatenate([solution.history for solution, _ in solutions])
    times = {name: history[f"{name}_seconds"] for name in ("derivative", "sweep", "rollout")}
    rest = history["seconds"] - sum(times.values())
    return {
        "table": "iterations",
        "scene": problem.scene.name,
        "integrator": problem.scene.simulation.integrator,
        "variant": TITLES[second_order],
        "iterations": first.iterations,
        "cost": first.cost,
        "converged": first.converged,
        "stop_reason": first.stop_reason.value,
        "best_s": min(seconds for _, seconds in solutions),
        "median_s": float(np.median([seconds for _, seconds in solutions])),
        "iteration_ms": median_ms(history["seconds"]),
        "derivatives_ms": median_ms(times["derivative"]),
        "sweep_ms": median_ms(times["sweep"]),
        "rollout_ms": median_ms(times["rollout"]),
        "rest_ms": median_ms(rest),
    }


def time_pieces(problem: ArmProblem, controls: FloatArray, repeats: int) -> Iterator[Row]:
    """Time the pieces of an iteration along a trajectory, in turns: the best samples, and the medians, ms."""
    work = ShootingWorkspace(problem, second_order=True)
    work.start(problem.initial_state, controls)
    work.differentiate()
    work.differentiate_twice()
    damping = _damping_with_minimum(work)
    pieces: dict[str, Callable[[], object]] = {
        "first_derivatives": work.differentiate,
        "second_derivatives": work.differentiate_twice,  # once after each `differentiate`
        "gauss_newton_sweep": lambda: work.backward_pass(0.0),
        "rollout": lambda: work.try_step(1.0),
    }
    if damping is not None:
        pieces["exact_sweep"] = lambda: work.backward_pass(damping, exact=True)
    samples: dict[str, list[float]] = {name: [] for name in pieces}
    for _ in range(repeats + 1):
        for name, run in pieces.items():
            started = perf_counter()
            run()
            samples[name].append(perf_counter() - started)
    simulation = problem.scene.simulation
    labels = {"table": "pieces", "scene": problem.scene.name, "integrator": simulation.integrator}
    for name, summary in (("best", min), ("median", np.median)):
        # The first sample of each has warmed up.
        times = {piece: 1e3 * float(summary(seconds[1:])) for piece, seconds in samples.items()}
        yield {**labels, "samples": name, **with_totals(times)}


def with_totals(times: Row) -> Row:
    """Pieces, ms, and what they make: a Gauss-Newton iteration, an exact one, and their ratio.

    Without an exact sweep, where the exact model has no minimum, there is no exact iteration.
    """
    gauss_newton = times["first_derivatives"] + times["gauss_newton_sweep"] + times["rollout"]
    exact = None
    if times.get("exact_sweep") is not None:
        exact = (
            gauss_newton - times["gauss_newton_sweep"] + times["second_derivatives"] + times["exact_sweep"]
        )
    ratio = None if exact is None else exact / gauss_newton
    return {**times, "gauss_newton_iteration": gauss_newton, "exact_iteration": exact, "ratio": ratio}


def _damping_with_minimum(work: ShootingWorkspace) -> float | None:
    """Smallest damping with which the exact model has a minimum; None if none is strong enough."""
    for damping in (0.0, *EXACT_MU):
        if work.backward_pass(damping, exact=True).status == PASS_COMPLETED:
            return damping
    return None
