"""IPOPT and fatrop, from CasADi's wheel, on the whole trajectory of a maneuver at once.

All states and controls are variables, every step is an equality constraint (direct multiple shooting), and
the limits are bounds: interior-point methods with exact second derivatives, which share nothing with the
expert but the equations of motion, see `transcription`. IPOPT factors the whole matrix, fatrop works through
the stages.

Iterates satisfy the dynamics only once they converge, and until then their objective tells nothing.
`SolverRun.costs` are therefore those of an iterate's controls, clipped to the limits and rolled out in our
problem: the result of stopping there. fatrop tells none but the last.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import casadi
import numpy as np

from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.transcription import Transcription, transcribe
from scripts.benchmarks.solvers.runs import IPOPT, SolverRun, costs_of, roll_out

_IPOPT_SETTINGS: dict[str, Any] = {
    "print_level": 0,
    "sb": "yes",  # no banner
    # The first state is fixed; its values stay variables, since the derivatives are those of all variables.
    "fixed_variable_treatment": "make_constraint",
}


def is_available(solver: str = IPOPT) -> bool:
    return bool(casadi.has_nlpsol(solver.lower()))


class InteriorPoint:
    """An interior-point method, ready to solve a maneuver from any start."""

    def __init__(
        self,
        problem: ArmProblem,
        solver: str = IPOPT,
        *,
        max_iterations: int = 500,
        max_seconds: float = 600.0,
        first_barrier: float = 0.1,
        tolerance: float = 1e-6,
    ) -> None:
        """Build the program; `max_seconds` is IPOPT's only."""
        self._problem, self._solver_name = problem, solver
        self._program = transcribe(problem)
        settings = {"max_iter": max_iterations, "mu_init": first_barrier, "tol": tolerance}
        self._watch = _Watch(self._program) if solver == IPOPT else None
        if self._watch is not None:
            settings |= _IPOPT_SETTINGS | {"max_wall_time": max_seconds}
            self._solver = _ipopt(self._program, settings, self._watch)
        else:
            self._solver = _fatrop(self._program, settings | {"print_level": 0})

    def solve(
        self,
        x0: FloatArray | None = None,
        u_init: FloatArray | None = None,
        *,
        x_init: FloatArray | None = None,
    ) -> SolverRun:
        """Solve from a start, with a guess: by default zero controls, and the states to which they lead.

        The time of the replays in our problem does not count. Of `parts`, which are means, derivatives are
        the evaluations of them, "rollout" those of cost and gaps, and "sweep" is all else, mostly the linear
        solver.
        """
        problem, program, watch = self._problem, self._program, self._watch
        start = problem.initial_state if x0 is None else x0
        controls = np.zeros((problem.horizon, problem.n_controls)) if u_init is None else u_init
        states = roll_out(problem, start, controls).states if x_init is None else x_init
        lower, upper = (
            program.join(np.full_like(states, infinite), np.broadcast_to(bound, controls.shape))
            for infinite, bound in ((-np.inf, problem.control_lower), (np.inf, problem.control_upper))
        )
        lower[: start.size] = upper[: start.size] = start
        row_lower, row_upper = program.row_bounds
        guess, began = program.join(states, controls), perf_counter()
        if watch is not None:
            watch.begin()
        result = self._solver(x0=guess, lbx=lower, ubx=upper, lbg=row_lower, ubg=row_upper)
        elapsed = perf_counter() - began
        _, final = program.split(result["x"])
        seconds, plans = ([0.0, elapsed], [controls, final]) if watch is None else watch.history(final)
        plans = [np.clip(plan, problem.control_lower, problem.control_upper) for plan in plans]
        costs, stats = costs_of(problem, start, plans), self._solver.stats()
        return SolverRun(
            solver=self._solver_name,
            costs=costs,
            seconds=np.array([0.0, *seconds[1:]]),  # the guess is there from the call on
            iterations=int(stats["iter_count"]),
            converged=bool(stats["success"]),
            stop_reason=str(stats["return_status"]),
            controls=plans[-1],
            replayed_cost=float(costs[-1]),
            parts=_parts(stats, seconds[-1], max(int(stats["iter_count"]), 1)),
        )


def _ipopt(program: Transcription, settings: Mapping[str, Any], watch: _Watch) -> Any:
    """Build IPOPT: it takes derivatives as options, of the Hessian the upper triangle."""
    arguments = program.hessian.mx_in()
    upper = casadi.Function("hess_lag", arguments, [casadi.triu(program.hessian(*arguments))])
    options = {"ipopt": settings, "print_time": False, "iteration_callback": watch}
    options |= {"jac_g": program.jacobian, "hess_lag": upper}
    nlp = {"x": program.variables, "f": program.cost, "g": program.rows}
    return casadi.nlpsol("ipopt", "ipopt", nlp, options)


def _fatrop(program: Transcription, settings: Mapping[str, Any]) -> Any:
    """Build fatrop, which knows the stages; its plugin takes no derivatives, CasADi finds them."""
    n, at_end = program.steps, program.rows.numel() - program.steps * (program.n_x + program.n_path)
    structure = {"N": n, "nx": [program.n_x] * (n + 1), "nu": [program.n_u] * n + [0]}
    structure |= {"ng": [program.n_path] * n + [at_end], "structure_detection": "manual"}
    nlp = {"x": program.variables, "f": program.cost, "g": program.rows}
    return casadi.nlpsol("fatrop", "fatrop", nlp, {"fatrop": settings, "print_time": False, **structure})


class _Watch(casadi.Callback):
    """A callback that records time and controls of every iterate, without its own time."""

    def __init__(self, program: Transcription) -> None:
        casadi.Callback.__init__(self)
        self._program = program
        self._sizes = {"x": program.variables.numel(), "f": 1, "g": program.rows.numel()}
        self._sizes |= {"lam_x": self._sizes["x"], "lam_g": self._sizes["g"], "lam_p": 0}
        self.construct("watch", {})
        self.begin()

    def begin(self) -> None:
        """Begin a solve."""
        self.seconds: list[float] = []
        self.controls: list[FloatArray] = []
        self._zero = perf_counter()

    def history(self, controls: FloatArray) -> tuple[list[float], list[FloatArray]]:
        """Times and controls of all iterates, of which the last one is the result."""
        return self.seconds, [*self.controls[:-1], controls]

    def get_n_in(self) -> int:
        return int(casadi.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        """Shapes of the results: columns."""
        return casadi.Sparsity.dense(self._sizes[casadi.nlpsol_out(i)], 1)

    def eval(self, results: Any) -> list[int]:
        now = perf_counter()
        self.seconds.append(now - self._zero)
        self.controls.append(self._program.split(results[0])[1])
        self._zero += perf_counter() - now
        return [0]


def _parts(stats: Mapping[str, Any], seconds: float, iterations: int) -> dict[str, float]:
    """Mean ms of an iteration in derivatives, in cost and gaps, and in the rest."""
    derivatives = sum(stats[f"t_wall_nlp_{name}"] for name in ("grad_f", "jac_g", "hess_l"))
    values = sum(stats[f"t_wall_nlp_{name}"] for name in ("f", "g"))
    times = {"derivatives": derivatives, "sweep": seconds - derivatives - values, "rollout": values}
    return {name: 1e3 * max(time, 0.0) / iterations for name, time in times.items()}
