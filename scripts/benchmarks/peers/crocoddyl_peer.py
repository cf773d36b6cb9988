"""Crocoddyl's box-constrained solvers on a scene's maneuver, with their own settings but for two.

The tolerance is that of our solver. The first regularization serves it well: from its own, 1e-9, it takes 49
iterations instead of 11 on scene `no-wrist`, and 37 instead of 43 on `paper` (Euler).

Crocoddyl 3.2.1 works with Pinocchio 4.0 and crashes with later ones: `pip install crocoddyl==3.2.1 pin==4.0.0
libpinocchio==4.0.0`, in a separate environment, because the tests want a newer Pinocchio.

`crocoddyl_maneuver` tells how its problem differs from ours. A solver is measured on its own problem:
`SolverRun.own_costs` are the costs that it minimizes, to which "within 0.1 % of the best" applies; `costs`
are those of the same controls in our problem.
"""

from __future__ import annotations

from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np

from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.crocoddyl_kernels import INITIAL_REGULARIZATION, TOLERANCE
from scripts.benchmarks.peers.crocoddyl_maneuver import CrocoddylManeuver
from scripts.benchmarks.solvers.runs import SolverRun, costs_of

METHODS = {"box_ddp": "SolverBoxDDP", "box_fddp": "SolverBoxFDDP"}
_REPETITIONS = 7


def is_available() -> bool:
    return find_spec("crocoddyl") is not None


def solve_with_crocoddyl(
    problem: ArmProblem,
    x0: FloatArray | None = None,
    u_init: FloatArray | None = None,
    *,
    method: str = "box_ddp",
    max_iterations: int = 300,
    exact_pose_cost: bool = False,
) -> SolverRun:
    """Solve a maneuver with Crocoddyl.

    The first trajectory is the rollout of the first controls; without gaps to close, both methods take the
    same steps from there. Callbacks and the replays in our problem do not count as its time. Of `parts`,
    derivatives and sweep are timed on the final trajectory, once per iteration; "rollout" is what remains of
    the median iteration: its rollouts, and repeated sweeps.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {', '.join(METHODS)}")
    import crocoddyl

    start = problem.initial_state if x0 is None else x0
    first = np.zeros((problem.horizon, problem.n_controls)) if u_init is None else u_init
    maneuver = CrocoddylManeuver(problem, exact_pose_cost=exact_pose_cost)
    maneuver.start_at(start)
    solver = getattr(crocoddyl, METHODS[method])(maneuver.shooting)
    inputs = maneuver.model_inputs(first)
    watch = _watch()
    solver.setCallbacks([watch])
    watch.begin()
    states = maneuver.shooting.rollout(inputs)
    converged = bool(solver.solve(states, inputs, max_iterations, True, INITIAL_REGULARIZATION))
    iterates = [first, *(maneuver.controls(us) for us in watch.inputs)]
    costs = costs_of(problem, start, iterates)
    seconds = np.array([0.0, *watch.seconds])
    return SolverRun(
        solver=f"Crocoddyl {METHODS[method]}",
        costs=costs,
        seconds=seconds,
        iterations=len(watch.seconds),
        converged=converged,
        stop_reason=_stop_reason(solver, converged, len(watch.seconds), max_iterations),
        controls=iterates[-1],
        replayed_cost=float(costs[-1]),
        parts=_parts(solver, float(np.median(np.diff(seconds)))) if watch.seconds else {},
        own_costs=np.array([maneuver.shooting.calc(states, inputs), *watch.costs]),
    )


def _stop_reason(solver: Any, converged: bool, iterations: int, max_iterations: int) -> str:
    if converged:
        return "a step promises no decrease beyond the tolerance"
    if iterations >= max_iterations:
        return "iterations used up"
    return f"no step accepted, regularization {solver.preg:.0e}"


def _watch() -> Any:
    """A callback that records time, cost and inputs of every iteration, without its own time."""
    import crocoddyl

    class Watch(crocoddyl.CallbackAbstract):
        """Notes of a solve."""

        def __init__(self) -> None:
            crocoddyl.CallbackAbstract.__init__(self)
            self.seconds: list[float] = []
            self.costs: list[float] = []
            self.inputs: list[FloatArray] = []
            self.begin()

        def begin(self) -> None:
            self._zero = perf_counter()

        def __call__(self, solver: Any) -> None:
            """Take notes; the tolerance follows the cost."""
            now = perf_counter()
            self.seconds.append(now - self._zero)
            self.costs.append(solver.cost)
            self.inputs.append(np.array(solver.us.tolist()))
            solver.th_stop = TOLERANCE * solver.cost
            self._zero += perf_counter() - now

    return Watch()


def _parts(solver: Any, iteration: float) -> dict[str, float]:
    """Median ms of derivatives and sweep on the final trajectory, and the rest of an iteration."""
    timings: dict[str, list[float]] = {"derivatives": [], "sweep": []}
    for _ in range(_REPETITIONS):
        for name, function in (("derivatives", solver.calcDiff), ("sweep", solver.backwardPass)):
            start = perf_counter()
            function()
            timings[name].append(1e3 * (perf_counter() - start))
    parts = {name: float(np.median(values)) for name, values in timings.items()}
    return {**parts, "rollout": max(1e3 * iteration - sum(parts.values()), 0.0)}
