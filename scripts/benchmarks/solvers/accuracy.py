"""Time to accuracy: how soon each solver comes how close to the best known cost, from the same start.

Our solvers take part, and others where they are installed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from experts.ddp.second_order import SecondOrder
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import beyond_the_paper
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note
from scripts.benchmarks.peers import crocoddyl_peer, interior_point_peer
from scripts.benchmarks.peers.crocoddyl_maneuver import CrocoddylManeuver, obstacle
from scripts.benchmarks.peers.transcription import not_given
from scripts.benchmarks.solvers.runs import (
    GAPS,
    GUIDED,
    IPOPT,
    PAPERS_STATES,
    TITLES,
    Search,
    Solve,
    SolverRun,
    box_ddp,
    guided_ddp,
    median_run,
    papers_states,
    relative_gap,
    relative_gaps,
    time_to_gap,
)

NOMINAL_START = "nominal start"
GAP = 1e-4  # largest gap to the best known cost that each variant may leave from the nominal start


OURS, CROCODDYL = "ours", "Crocoddyl's"
"""The owners of the problems that solvers minimize: costs of different problems are not compared."""


@dataclass(frozen=True)
class Contender:
    """A solver, ready to solve from a state."""

    name: str
    solve: Solve
    formulation: str = OURS  # the problem it minimizes
    is_slow: bool = False  # solved once where others are repeated
    knows_nominal_start: bool = False  # has solved it beforehand: its time from there tells nothing
    # Solves from a state and given controls, to learn the best cost of a problem that is not ours.
    solve_from: Callable[[FloatArray | None, FloatArray], SolverRun] | None = None


Result = tuple[SolverRun, str]  # a solve, and the problem that it minimizes


def compare_solvers(
    problem: ArmProblem,
    contenders: Sequence[Contender],
    search: Search,
    start: str,
    x0: FloatArray | None,
    effort: Effort,
) -> Iterator[Row]:
    """Solve a maneuver from a start with each solver."""
    results = [
        (_solve(contender, x0, effort.repeats), contender.formulation)
        for contender in contenders
        if x0 is not None or not contender.knows_nominal_start
    ]
    candidates = [(solution.cost, solution.controls) for solution in search.solutions(x0)]
    candidates += [(run.replayed_cost, run.controls) for run, _ in results]
    _, controls = min(candidates, key=lambda candidate: candidate[0])
    references = [
        (contender.solve_from(x0, controls), contender.formulation)
        for contender in contenders
        if contender.solve_from is not None
    ]
    best = best_costs([*results, *references], min(cost for cost, _ in candidates))
    integrator = problem.scene.simulation.integrator
    labels = {"scene": problem.scene.name, "integrator": integrator, "start": start}
    for run, formulation in results:
        yield from _rows(labels, run, formulation, best)
    for name, cost in best.items():
        if name != OURS:
            yield note(
                f"{name} problem differs from ours: its times are to the gaps to its own best known cost, "
                f"{cost:.7g} ({', '.join(labels.values())}). J is the cost of its controls in our problem."
            )


def _rows(labels: Row, run: SolverRun, formulation: str, best: Mapping[str, float]) -> Iterator[Row]:
    """The solve, the cost after each of its iterations, and the claim of our solver's variants."""
    total = float(run.seconds[-1])
    above = relative_gap(run.replayed_cost, best[OURS])
    row = {"table": "comparisons", **labels, "solver": run.solver, "minimizes": formulation}
    row |= {"iterations": run.iterations, "converged": run.converged, "stop_reason": run.stop_reason}
    row |= {"cost": run.replayed_cost, "best_known": best[OURS], "above_best": above, "total_s": total}
    row |= {f"s_to_{gap:g}": time_to_gap(run, best[formulation], gap) for gap in GAPS}
    row["ms_per_iteration"] = 1e3 * total / run.iterations if run.iterations else None
    yield row | {f"{part}_ms": value for part, value in run.parts.items()}
    panel = ", ".join(labels.values())
    gaps = relative_gaps(run, best[formulation])
    for k, (seconds, cost, minimized) in enumerate(zip(run.seconds, run.costs, run.minimized, strict=True)):
        point = {
            "iteration": k,
            "seconds": float(seconds),
            "cost": float(cost),
            "minimized": float(minimized),
        }
        yield {"table": "histories", "panel": panel, "solver": run.solver, **point, "gap": float(gaps[k])}
    if labels["start"] == NOMINAL_START and run.solver in TITLES.values():
        # From random starts the variants may end in other minima.
        gap = run.replayed_cost / best[formulation] - 1.0
        subject = f"{run.solver}, {labels['integrator']}"
        yield claim("costs", labels["scene"], subject, gap, GAP, note="above the best known cost, relative")


def _solve(contender: Contender, x0: FloatArray | None, repeats: int) -> SolverRun:
    """Solve once if that takes long; else once for warming up, then as often as asked for."""
    first = contender.solve(x0)
    return first if contender.is_slow else median_run([contender.solve(x0) for _ in range(repeats)])


def best_costs(results: Sequence[Result], known: float) -> dict[str, float]:
    """The lowest cost of each problem that is minimized; `known` is possible in ours."""
    best = {OURS: known}
    for run, formulation in results:
        best[formulation] = min(best.get(formulation, np.inf), float(np.min(run.minimized)))
    return best


def contenders(
    problem: ArmProblem, guided: GuidedDDP | None, effort: Effort
) -> tuple[list[Contender], list[str]]:
    limit = effort.max_iterations
    found = [Contender(TITLES[variant], box_ddp(problem, variant, limit)) for variant in SecondOrder]
    if guided is not None:
        found.append(Contender(GUIDED, guided_ddp(problem, guided), knows_nominal_start=True))
    notes = []
    if not effort.papers_states:
        notes.append("The paper's formulation is left out.")
    elif problem.scene.simulation.integrator != "rk4":
        notes.append("The paper's formulation is compared with RK4 only, which steps it.")
    elif more := beyond_the_paper(problem.scene):
        notes.append(f"The paper's formulation is left out: it has no {' or '.join(more)}.")
    else:
        found.append(Contender(PAPERS_STATES, papers_states(problem, limit)))
    if not effort.peers:
        return found, [*notes, "Other solvers are left out."]
    for peer in (_crocoddyl, _ipopt):
        theirs, note = peer(problem, effort)
        found += theirs
        notes += note
    return found, notes


def _crocoddyl(problem: ArmProblem, effort: Effort) -> tuple[list[Contender], list[str]]:
    if not crocoddyl_peer.is_available():
        return [], ["Crocoddyl is left out: it is not installed (see crocoddyl_peer.py)."]
    sentence = obstacle(problem)
    if sentence is not None:
        return [], [sentence]
    try:
        CrocoddylManeuver(problem)
    except ValueError as error:
        return [], [f"Crocoddyl is left out: {error}"]

    def solve(method: str, x0: FloatArray | None, controls: FloatArray | None = None) -> SolverRun:
        return crocoddyl_peer.solve_with_crocoddyl(problem, x0, controls, method=method)

    methods = dict(crocoddyl_peer.METHODS)
    notes = []
    if not effort.slow_peers:
        notes.append(
            f"Crocoddyl's {methods.pop('box_fddp')} is left out: from a rollout it is {methods['box_ddp']}."
        )
    return [
        Contender(
            f"Crocoddyl {title}",
            partial(solve, method),
            formulation=CROCODDYL,
            solve_from=partial(solve, method),
        )
        for method, title in methods.items()
    ], notes


def _ipopt(problem: ArmProblem, effort: Effort) -> tuple[list[Contender], list[str]]:
    if not interior_point_peer.is_available():
        return [], ["IPOPT is left out: it is not installed."]
    if not effort.slow_peers:
        return [], ["IPOPT is left out: it takes minutes; --set slow_peers=true or --full have it."]
    if more := not_given(problem.scene):
        return [], [f"IPOPT is left out: it is not given {more}."]
    ipopt = interior_point_peer.InteriorPoint(problem)
    return [Contender(IPOPT, ipopt.solve, is_slow=True)], []
