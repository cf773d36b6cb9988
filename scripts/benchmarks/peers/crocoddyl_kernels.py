"""Crocoddyl's box-constrained solvers on a problem of one's own, with the kernels that our solver calls.

Its actions are C++ (`crocoddyl_kernels.cpp`), compiled here in seconds, and call the same machine code for
step, costs and first derivatives as `BoxDDP`: both solve one problem, to the last bit, and neither runs any
Python in an iteration. Needs Crocoddyl as in `crocoddyl_peer`, `pip install cmeel-eigen==3.4.1` for the
headers of the Eigen that it was built with, and a C++ compiler.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from experts.problems.casadi_problem import CasadiProblem
from experts.problems.shooting_problem import FloatArray

TOLERANCE = 1e-7
"""Converged when a step promises less than this decrease, relative to the cost; that of `BoxDDP`."""
INITIAL_REGULARIZATION = 1e2
METHODS = ("SolverBoxDDP", "SolverBoxFDDP")
_KERNELS = (
    "step_with_cost",
    "terminal_cost",
    "linearize",
    "cost_derivatives",
    "terminal_cost_derivatives",
)


class _Problem(ctypes.Structure):
    """`Problem` of the C++ code."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in _KERNELS),
        *((name, ctypes.c_int64) for name in ("states", "controls", "horizon", "mixed")),
        ("time_step", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("p", "start", "lower", "upper")),
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
    if problem.control_lower.ndim != 1 or problem.control_upper.ndim != 1:
        raise ValueError("Crocoddyl's action of every stage is the same: give bounds of shape (n_u,)")
    kernels = [problem.kernel(name) for name in _KERNELS]
    parameters = problem.parameters.nominal
    arrays = [problem.initial_state, problem.control_lower, problem.control_upper]
    start, lower, upper = (np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
    given = _Problem(
        *(kernel.address for kernel in kernels),
        *(problem.n_states, problem.n_controls, problem.horizon, problem.has_mixed_cost),
        problem.time_step,
        parameters.ctypes.data if parameters.size else None,
        *(array.ctypes.data for array in (start, lower, upper)),
    )
    found = np.array(controls, dtype=np.float64)
    seconds, costs = np.zeros(max_iterations + 1), np.zeros(max_iterations + 1)
    done = _library().solve(
        ctypes.byref(given),
        int(method == "SolverBoxDDP"),
        max_iterations,
        ctypes.c_double(INITIAL_REGULARIZATION),
        ctypes.c_double(TOLERANCE),
        *(ctypes.c_void_p(array.ctypes.data) for array in (found, seconds, costs)),
    )
    count = abs(done)
    return found, seconds[:count], costs[:count], done > 0
