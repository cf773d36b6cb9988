"""The solvers that are compared by their time to accuracy: ours, and others where they are installed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from experts.arm_problem import ArmProblem
from experts.guesses import GuidedDDP
from experts.models import SecondOrder
from experts.problem import FloatArray
from experts.report.solvers import crocoddyl_peer, ipopt_peer
from experts.report.solvers.crocoddyl_maneuver import CrocoddylManeuver, obstacle
from experts.report.solvers.effort import Effort
from experts.report.solvers.ours import (
    GUIDED,
    PAPERS_STATES,
    TITLES,
    Solve,
    box_ddp,
    guided_ddp,
    papers_states,
)
from experts.report.solvers.runs import SolverRun

OURS, CROCODDYL = "ours", "Crocoddyl's"
"""Whose problem a solver minimizes: costs of different problems are not compared."""


@dataclass(frozen=True)
class Contender:
    """A solver, ready to solve.

    Attributes:
        name: Its label.
        solve: Solves from a state.
        formulation: Whose problem it minimizes.
        is_slow: Whether one solve must do where others are repeated.
        knows_nominal_start: Whether it has solved the nominal start beforehand, so that its time from there
            says nothing.
        solve_from: Solves from a state and given controls, to learn the best cost of its own problem; None if
            its problem is ours.
    """

    name: str
    solve: Solve
    formulation: str = OURS
    is_slow: bool = False
    knows_nominal_start: bool = False
    solve_from: Callable[[FloatArray | None, FloatArray], SolverRun] | None = None


def contenders(
    problem: ArmProblem, guided: GuidedDDP | None, effort: Effort
) -> tuple[list[Contender], list[str]]:
    """Prepare the solvers.

    Args:
        problem: The maneuver.
        guided: `GuidedDDP` for it; None to do without.
        effort: Says which solvers take part.

    Returns:
        The solvers, and a sentence for each one that is left out.
    """
    limit = effort.max_iterations
    found = [Contender(TITLES[variant], box_ddp(problem, variant, limit)) for variant in SecondOrder]
    if guided is not None:
        found.append(Contender(GUIDED, guided_ddp(problem, guided), knows_nominal_start=True))
    notes = []
    if not effort.papers_states:
        notes.append("The paper's formulation is left out.")
    elif problem.scene.simulation.integrator != "rk4":
        notes.append("The paper's formulation is compared with RK4 only, which it is stepped by.")
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
            is_slow=True,
            solve_from=partial(solve, method),
        )
        for method, title in methods.items()
    ], notes


def _ipopt(problem: ArmProblem, effort: Effort) -> tuple[list[Contender], list[str]]:
    if not ipopt_peer.is_available():
        return [], ["IPOPT is left out: it is not installed."]
    if not effort.slow_peers:
        return [], ["IPOPT is left out: it takes minutes; --slow-peers or --full have it."]
    return [Contender("IPOPT", partial(ipopt_peer.solve_with_ipopt, problem), is_slow=True)], []
