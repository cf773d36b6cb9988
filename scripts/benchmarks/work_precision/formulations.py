"""Accelerations of one robot from different formulations, in two precisions: error against time per call.

The errors are relative to the paper's system (20) solved with 50 digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, ClassVar

import mpmath
import numpy as np

from dq_space_arm_env import Kernels, Scene, load_scene
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.kernels.bound import BoundKernel, KernelCall
from dq_space_arm_env.kernels.programs.paper_programs import PaperPrograms
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from experts.problems.shooting_problem import FloatArray
from experts.report.part_costs import moving_states
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim, note
from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer
from scripts.benchmarks.stability.references import Sample, errors, linear_system
from scripts.benchmarks.subjects import DYNAMICS, FLOAT32, FLOAT64, OURS, Case, Subject, Variant, time_cases
from scripts.benchmarks.work_precision.many_digits import evaluate

ARTICULATED, MINIMAL = "articulated body", "minimal coordinates"
SCHUR, REFINED = "Schur complement (21)-(22)", "Schur complement, refined"
DENSE = "whole system (20), LU"
PINOCCHIO = "articulated body, Pinocchio"
DIGITS = 50
LIMITS = {FLOAT64: 1e-12, FLOAT32: 1e-3}
"""Largest relative error of our accelerations; beyond it accuracy has regressed."""
_BATCH = 1024


def measure_formulations(effort: Effort) -> Iterator[Row]:
    """Compare accelerations of the paper's robot: a row and a claim for each formulation and precision."""
    scene = load_scene("paper")
    kernels = Variant(FLOAT64).compile(scene)
    x, u = _representable(*moving_states(kernels, effort.accuracy_states))
    many = _representable(*moving_states(kernels, _BATCH))
    right, agreement = _reference(kernels, x, u)
    yield note(
        f"Accelerations: {len(x)} states of scene {scene.name}; reference, (20) with {DIGITS} digits. The "
        f"articulated body with as many is {agreement:.0e} from it: constants are rounded."
    )
    judge = _Judge(kernels, x, u, right)
    for precision in (FLOAT64, FLOAT32):
        for name, kind in _KINDS.items():
            way = kind(_compiled(scene, precision, kind.formulation))
            values = way.accelerations(*way.arguments(x, u))
            counts = (1, _BATCH)
            runs = [way.runner(*way.arguments(*(array[:count] for array in many))) for count in counts]
            row = judge.row(name, precision, values, *_times(runs, counts, effort))
            yield row
            limit = LIMITS[precision]
            yield claim("formulations", name, precision, row["largest_error"], limit, note="of accelerations")
    try:
        peer = PinocchioPeer(kernels, KinematicTree.from_scene(scene))
    except ImportError:
        yield note("Pinocchio's articulated body is left out: it is not installed (pip install pin).")
        return
    timings = [timing["best_ns"] for timing in time_cases(peer.cases(*many), effort.step_timing)]
    yield judge.row(PINOCCHIO, FLOAT64, peer.accelerations(x, u), timings[0], (*timings, None)[1])


def _representable(x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States and inputs that single precision holds without error."""
    single = [array.astype(FLOAT32).astype(FLOAT64) for array in (x, u)]
    return single[0], single[1]


def _times(runs: Sequence[Callable[[], object]], counts: Sequence[int], effort: Effort) -> list[float]:
    subjects = [Subject(what=DYNAMICS, engine=OURS, way="", batch=count) for count in counts]
    cases = [Case(subject, run) for subject, run in zip(subjects, runs, strict=True)]
    return [timing["best_ns"] for timing in time_cases(cases, effort.step_timing)]


def _compiled(scene: Scene, precision: str, formulation: str) -> Kernels:
    return Variant(precision).compile(scene.replace(simulation={"formulation": formulation}))


class _Judge:
    """The accelerations of some states with 50 digits, by which those of all formulations are judged."""

    def __init__(self, kernels: Kernels, x: FloatArray, u: FloatArray, right: FloatArray) -> None:
        tree = KinematicTree.from_scene(kernels.scene)
        samples = [Sample(kernels.scene, kernels, tree, *row) for row in zip(x, u, strict=True)]
        self._right, self._motions = right, [sample.motion for sample in samples]
        self._systems = [linear_system(tree, motion) for motion in self._motions]

    def row(
        self, name: str, precision: str, values: FloatArray, single_ns: float, batch_ns: float | None
    ) -> Row:
        """A formulation with its errors, relative to the norm of the accelerations, and ns per state."""
        values = values.astype(FLOAT64)
        error = np.linalg.norm(values - self._right, axis=1) / np.linalg.norm(self._right, axis=1)
        backward = max(
            errors(system, motion, row).backward
            for system, motion, row in zip(self._systems, self._motions, values, strict=True)
        )
        return {
            "table": "formulations",
            "formulation": name,
            "precision": precision,
            "largest_error": float(error.max()),
            "median_error": float(np.median(error)),
            "backward_error": backward,
            "single_ns": single_ns,
            "batch_ns": batch_ns,
        }


class _Articulated:
    """The articulated-body algorithm, the default."""

    formulation: ClassVar[str] = "articulated_body"

    def __init__(self, kernels: Kernels) -> None:
        self.kernels, self.dtype = kernels, kernels.dtype

    def arguments(self, x: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """States as the formulation has them, and inputs, in its precision."""
        return x.astype(self.dtype), u.astype(self.dtype)

    def kernel(self, lanes: int | None) -> BoundKernel:
        """The kernel that is timed."""
        return self.kernels.kernel("forward_dynamics", lanes=lanes)

    def accelerations(self, x: Any, u: Any) -> Any:
        """Accelerations of base and joints, a row for each state."""
        return _outputs(self.kernel(1), x, u)[0]

    def runner(self, x: Any, u: Any) -> Callable[[], object]:
        """Computes them for rows that stay: a single one or a batch."""
        kernel = self.kernel(1 if len(x) == 1 else None)
        results = [np.zeros((len(x), spec.stride), self.dtype) for spec in kernel.outputs]
        names = [spec.name for spec in (*kernel.inputs, *kernel.outputs)]
        call = KernelCall(kernel, dict(zip(names, (x, u, *results), strict=True)))
        return call.of_one_row() if len(x) == 1 else partial(call, len(x))


class _Minimal(_Articulated):
    """The mass matrix in minimal coordinates."""

    formulation = "minimal_coordinates"


class _Schur(_Articulated):
    """The reaction wrenches first (21), then the dual accelerations (22)."""

    def arguments(self, x: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        y = _outputs(self.kernels.paper_kernel("from_minimal", lanes=1), x.astype(self.dtype))[0]
        return y, u.astype(self.dtype)

    def kernel(self, lanes: int | None) -> BoundKernel:
        return self.kernels.paper_kernel("accelerations", lanes=lanes)


class _Refined(_Schur):
    """The same, solved once more for the residual."""

    def kernel(self, lanes: int | None) -> BoundKernel:
        return self.kernels.paper_kernel("refined_accelerations", lanes=lanes)


class _Dense(_Schur):
    """The whole system (20), assembled by a kernel and solved by LAPACK."""

    def kernel(self, lanes: int | None) -> BoundKernel:
        return self.kernels.paper_kernel("system", lanes=1)

    def accelerations(self, x: Any, u: Any) -> Any:
        free = self.kernels.paper_kernel("free_accelerations", lanes=1)
        solution = _solved(*_outputs(self.kernel(1), x, u))
        return _outputs(free, x, solution[:, : free.inputs[1].stride])[0]

    def runner(self, x: Any, u: Any) -> Callable[[], object]:
        kernel = self.kernel(1)
        return lambda: _solved(*_outputs(kernel, x, u))


_KINDS: dict[str, type[_Articulated]] = {
    ARTICULATED: _Articulated,
    MINIMAL: _Minimal,
    SCHUR: _Schur,
    REFINED: _Refined,
    DENSE: _Dense,
}


def _outputs(kernel: BoundKernel, *inputs: Any) -> list[Any]:
    """A kernel applied to rows."""
    ordered = [np.ascontiguousarray(array) for array in inputs]
    results = [np.zeros((len(ordered[0]), spec.stride), ordered[0].dtype) for spec in kernel.outputs]
    kernel([*ordered, *results], len(ordered[0]))
    return results


def _solved(matrix: Any, right: Any) -> Any:
    n = right.shape[1]
    return np.linalg.solve(matrix.reshape(-1, n, n), right[..., None])[..., 0]


def _reference(kernels: Kernels, x: FloatArray, u: FloatArray) -> tuple[FloatArray, float]:
    """Accelerations from (20) with 50 digits, and how far the articulated body is from them with as many."""
    paper = PaperPrograms(kernels.scene)
    names = ("from_minimal", "system", "free_accelerations")
    redundant, system, free = (paper.build(name).calls[0].graph for name in names)
    articulated = ScenePrograms(kernels.scene).build("forward_dynamics").calls[0].graph
    right, differences = [], []
    with mpmath.workdps(DIGITS):
        for state, inputs in zip(x.tolist(), u.tolist(), strict=True):
            (y,) = evaluate(redundant, state)
            matrix, wrenches = evaluate(system, y, inputs)
            n = len(wrenches)
            rows = mpmath.matrix([matrix[n * row : n * row + n] for row in range(n)])
            solution = list(mpmath.lu_solve(rows, mpmath.matrix(wrenches)))
            (values,) = evaluate(free, y, solution[: dict(free.inputs)["ydot"]])
            (others,) = evaluate(articulated, state, inputs)
            gap = mpmath.norm([a - b for a, b in zip(values, others, strict=True)]) / mpmath.norm(values)
            right.append([float(entry) for entry in values])
            differences.append(float(gap))
    return np.array(right), max(differences)
