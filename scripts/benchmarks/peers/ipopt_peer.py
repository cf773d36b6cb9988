"""IPOPT, from CasADi's wheel, on the whole trajectory of a maneuver at once.

All states and controls are variables, every step is an equality constraint (direct multiple shooting), and
the limits are bounds: an interior-point method with exact second derivatives, which shares nothing with the
expert but the equations of motion, see `ipopt_transcription`.

Iterates satisfy the dynamics only once they converge, and until then their objective tells nothing.
`SolverRun.costs` are therefore those of an iterate's controls, clipped to the limits and rolled out in our
problem: the result of stopping there.
"""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any

import casadi
import numpy as np

from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.ipopt_transcription import Transcription, transcribe
from scripts.benchmarks.solvers.runs import SolverRun, costs_of, roll_out

_SETTINGS: dict[str, Any] = {
    "print_level": 0,
    "sb": "yes",  # no banner
    # The first state is fixed; its values stay variables, since the derivatives are those of all variables.
    "fixed_variable_treatment": "make_constraint",
}


def is_available() -> bool:
    return bool(casadi.has_nlpsol("ipopt"))


def solve_with_ipopt(
    problem: ArmProblem,
    x0: FloatArray | None = None,
    u_init: FloatArray | None = None,
    *,
    x_init: FloatArray | None = None,
    max_iterations: int = 500,
    max_seconds: float = 600.0,
    first_barrier: float = 0.1,
    tolerance: float = 1e-6,
) -> SolverRun:
    """Solve a maneuver with IPOPT.

    The time of building the program and of the replays in our problem does not count. Of `parts`, which are
    means, derivatives are the evaluations of them, "rollout" those of cost and gaps, and "sweep" is all else,
    mostly the linear solver.
    """
    start = problem.initial_state if x0 is None else x0
    controls = np.zeros((problem.horizon, problem.n_controls)) if u_init is None else u_init
    states = roll_out(problem, start, controls).states if x_init is None else x_init
    program = transcribe(problem.scene)
    watch = _Watch(program, states.size, controls.shape)
    settings = {
        **_SETTINGS,
        "max_iter": max_iterations,
        "max_wall_time": max_seconds,
        "mu_init": first_barrier,
        "tol": tolerance,
    }
    options = {"ipopt": settings, "print_time": False, "iteration_callback": watch, **program.derivatives}
    nlp = {"x": program.variables, "f": program.cost, "g": casadi.vertcat(program.gaps, program.rows)}
    solver = casadi.nlpsol("ipopt", "ipopt", nlp, options)
    lower, upper = (
        np.concatenate([np.full(states.size, sign * np.inf), np.tile(bound, problem.horizon)])
        for sign, bound in ((-1.0, problem.control_lower), (1.0, problem.control_upper))
    )
    lower[: start.size] = upper[: start.size] = start
    guess = np.concatenate([states.ravel(), controls.ravel()])
    row_lower, row_upper = (
        np.concatenate([np.zeros(program.gaps.numel()), bound]) for bound in program.row_bounds
    )
    watch.begin()
    result = solver(x0=guess, lbx=lower, ubx=upper, lbg=row_lower, ubg=row_upper)
    watch.controls[-1] = np.array(result["x"])[states.size :].reshape(controls.shape)
    plans = [np.clip(plan, problem.control_lower, problem.control_upper) for plan in watch.controls]
    costs = costs_of(problem, start, plans)
    stats = solver.stats()
    return SolverRun(
        solver="IPOPT",
        costs=costs,
        seconds=np.array(watch.seconds) - watch.seconds[0],
        iterations=len(costs) - 1,
        converged=bool(stats["success"]),
        stop_reason=str(stats["return_status"]),
        controls=plans[-1],
        replayed_cost=float(costs[-1]),
        parts=_parts(stats, watch.seconds[-1], max(len(costs) - 1, 1)),
    )


class _Watch(casadi.Callback):
    """A callback that records time and controls of every iterate, without its own time."""

    def __init__(self, program: Transcription, n_states: int, shape: tuple[int, ...]) -> None:
        casadi.Callback.__init__(self)
        self._sizes = {
            "x": program.variables.numel(),
            "f": 1,
            "g": program.gaps.numel() + program.rows.numel(),
        }
        self._sizes |= {"lam_x": self._sizes["x"], "lam_g": self._sizes["g"], "lam_p": 0}
        self._n_states, self._shape = n_states, shape
        self.seconds: list[float] = []
        self.controls: list[FloatArray] = []
        self.construct("watch", {})
        self.begin()

    def begin(self) -> None:
        self._zero = perf_counter()

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
        self.controls.append(np.array(results[0])[self._n_states :].reshape(self._shape))
        self._zero += perf_counter() - now
        return [0]


def _parts(stats: Mapping[str, Any], seconds: float, iterations: int) -> dict[str, float]:
    """Mean ms of an iteration in derivatives, in cost and gaps, and in the rest."""
    derivatives = sum(stats[f"t_wall_nlp_{name}"] for name in ("grad_f", "jac_g", "hess_l"))
    values = sum(stats[f"t_wall_nlp_{name}"] for name in ("f", "g"))
    times = {"derivatives": derivatives, "sweep": seconds - derivatives - values, "rollout": values}
    return {name: 1e3 * max(time, 0.0) / iterations for name, time in times.items()}
