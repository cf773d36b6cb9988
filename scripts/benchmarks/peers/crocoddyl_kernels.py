"""Crocoddyl's box-constrained solvers on a problem of one's own or a scene, with our solver's kernels.

Its actions are C++ (`crocoddyl_kernels.cpp`), compiled here in seconds, and call the same machine code for
step, costs and first derivatives as `BoxDDP`: both solve one problem, to the last bit, and neither runs any
Python in an iteration. Constraints of a scene are quadratic penalties there, with rows and slopes from the
kernels; rows of the end that are equalities come last. Needs Crocoddyl as in `crocoddyl_peer`, `pip install
cmeel-eigen==3.4.1` for the headers of the Eigen that it was built with, and a C++ compiler.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from experts.problems.arm_problem import ArmProblem
from experts.problems.casadi_problem import CasadiProblem
from experts.problems.shooting_problem import FloatArray, Kernel

TOLERANCE = 1e-7
"""Converged when a step promises less than this decrease, relative to the cost; that of `BoxDDP`."""
INITIAL_REGULARIZATION = 1e2
METHODS = ("SolverBoxDDP", "SolverBoxFDDP")
KERNELS = (
    "step_with_cost",
    "terminal_cost",
    "linearize",
    "cost_derivatives",
    "terminal_cost_derivatives",
)
MANIFOLD = ("difference", "retract")
CONSTRAINTS = (
    "constraints",
    "constraint_jacobian",
    "terminal_constraints",
    "terminal_constraint_jacobian",
)


class Problem(ctypes.Structure):
    """`Problem` of the C++ code."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in (*KERNELS, *MANIFOLD, *CONSTRAINTS)),
        *((name, ctypes.c_int64) for name in ("states", "tangent", "controls", "horizon", "mixed")),
        *((name, ctypes.c_int64) for name in ("parameters", "n_rows", "n_end")),
        *((name, ctypes.c_double) for name in ("time_step", "weight")),
        ("n_equal", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("p", "start", "lower", "upper")),
        *((name, ctypes.c_void_p) for name in ("emphasis", "margins", "end_margins")),
    )


def obstacle() -> str | None:
    """The sentence that tells why Crocoddyl cannot be measured; None if it can."""
    try:
        _library()
    except (LookupError, OSError) as error:
        return f"Crocoddyl is left out: {error} (see crocoddyl_kernels.py)."
    return None


@cache
def _library() -> Any:
    """The compiled C++ code."""
    spec, compiler = find_spec("crocoddyl"), shutil.which("c++")
    if spec is None or spec.origin is None:
        raise LookupError("it is not installed")
    if compiler is None:
        raise LookupError("there is no C++ compiler")
    prefix = Path(spec.origin).parents[4]
    options = [f"-I{prefix}/include", f"-I{prefix}/include/eigen3", f"-L{prefix}/lib", "-lcrocoddyl"]
    # The path in this library serves those that it needs, and those that they need.
    options += [f"-Wl,--disable-new-dtags,-rpath,{prefix}/lib"]
    source = str(Path(__file__).with_suffix(".cpp"))
    with TemporaryDirectory() as folder:
        library = f"{folder}/crocoddyl_kernels.so"
        command = [compiler, "-O3", "-std=c++17", "-shared", "-fPIC", source, *options, "-o", library]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise LookupError(f"its headers do not compile: {done.stderr.partition('error: ')[2][:80]!r}")
        return ctypes.CDLL(library)


def solve_with_crocoddyl(
    problem: CasadiProblem,
    controls: FloatArray,
    *,
    method: str,
    max_iterations: int,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Solve a problem with nominal parameters from controls, shape (N, n_u).

    Settings are those of `crocoddyl_peer`. `SolverBoxDDP` starts from the controls' rollout, `SolverBoxFDDP`
    from the initial state at every stage, which leaves gaps. Returns the controls found, the seconds since
    the start and the costs after each iteration, and whether it converged.
    """
    parameters = np.tile(problem.parameters.nominal, (problem.horizon + 1, 1))
    kernels = {name: problem.kernel(name) for name in KERNELS}
    given, kept = problem_of(problem, problem.initial_state, parameters, kernels)
    done = solve(given, controls, int(method == "SolverBoxDDP"), max_iterations)
    del kept
    return done


def problem_of(
    problem: CasadiProblem | ArmProblem, x0: FloatArray, parameters: FloatArray, kernels: Mapping[str, Kernel]
) -> tuple[Problem, list[FloatArray]]:
    """The problem of the C++ code, and the arrays that it reads."""
    if problem.control_lower.ndim != 1 or problem.control_upper.ndim != 1:
        raise ValueError("Crocoddyl's bounds are those of every stage: give bounds of shape (n_u,)")
    arrays = [parameters, x0, problem.control_lower, problem.control_upper]
    arrays += [np.ones(1), np.zeros(0), np.zeros(0)]
    n_equal = 0
    if constraints := getattr(problem, "constraints", None):
        arrays[5:] = [
            np.array([row.margin for row in rows]) for rows in (constraints.path, constraints.terminal)
        ]
        n_equal = sum(row.is_equality for row in constraints.terminal)
    kept = [np.ascontiguousarray(array, dtype=np.float64) for array in arrays]
    pointers = [array.ctypes.data if array.size else None for array in kept]
    if "difference" not in kernels:
        pointers[4] = None  # no emphasis
    addresses = [
        kernels[name].address if name in kernels else 0 for name in (*KERNELS, *MANIFOLD, *CONSTRAINTS)
    ]
    sizes = [problem.n_states, problem.n_tangent, problem.n_controls, problem.horizon]
    sizes += [int(problem.has_mixed_cost), parameters.shape[1], kept[5].size, kept[6].size]
    return Problem(*addresses, *sizes, problem.time_step, 0.0, n_equal, *pointers), kept


def solve(
    given: Problem, controls: FloatArray, feasible_start: int, max_iterations: int
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Controls found, seconds and costs after each iteration, and whether it converged."""
    found = np.array(controls, dtype=np.float64)
    seconds, costs = np.zeros(max_iterations + 1), np.zeros(max_iterations + 1)
    done = _library().solve(
        ctypes.byref(given),
        feasible_start,
        max_iterations,
        ctypes.c_double(INITIAL_REGULARIZATION),
        ctypes.c_double(TOLERANCE),
        *(ctypes.c_void_p(array.ctypes.data) for array in (found, seconds, costs)),
    )
    count = abs(done)
    return found, seconds[:count], costs[:count], done > 0
