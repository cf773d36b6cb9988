"""The source of a scene's kernels: this process, the disk cache, or the compiler, in this order.

A process that finds its kernels in the cache neither traces nor compiles, nor does it import CasADi.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.code_cache import cache_key, is_kept, keep_code, read_code
from dq_space_arm_env.common.first_use import announce, compiling
from dq_space_arm_env.common.host_machine import host_machine
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.compiler import native
from dq_space_arm_env.kernels.bound import BoundKernel, SingleRowCalls, rows_of
from dq_space_arm_env.scene.entries import ParameterEntries
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.phases import StagedNumbers
from dq_space_arm_env.scene.schema import Scene

if TYPE_CHECKING:
    from dq_space_arm_env.compiler.program import Program
    from dq_space_arm_env.kernels.programs.environment_programs import EnvironmentPrograms
    from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms


Array = NDArray[Any]


class KernelLibrary:
    """The compiled programs of a scene, by name."""

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        check_threads(threads)
        self.scene, self.threads, self.layout = scene, threads, StateLayout.of(scene)
        layout = self.layout
        self.n_x, self.n_t, self.n_u, self.n_p = layout.n_x, layout.n_t, layout.n_u, layout.n_p
        self.dtype = np.dtype(scene.simulation.precision)
        self._kernels: dict[tuple[str, str, int], BoundKernel] = {}
        self._paper_kernels: dict[tuple[str, int], BoundKernel] = {}
        self._single_row_calls: dict[tuple[str, str | None, bool, bool], SingleRowCalls] = {}

    @cached_property
    def staged(self) -> StagedNumbers:
        """What the scene's phases change: a search among scenes would hash this one, and steps need it."""
        return self.scene.staged

    @cached_property
    def values_of_phases(self) -> tuple[list[int], NDArray[Any]]:
        """Indices of the parameters that phases change, and their values, a row for each phase."""
        names = self.layout.parameters.names
        values = np.array([*self.staged.values.values()], self.dtype).T
        return [names.index(name) for name in self.staged.values], values

    @cached_property
    def _programs(self) -> ScenePrograms:
        from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

        return ScenePrograms(self.scene)

    @cached_property
    def _penalized_programs(self) -> ScenePrograms:
        from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms

        return ScenePrograms(self.scene, penalized=True)

    @cached_property
    def _environment_programs(self) -> EnvironmentPrograms:
        from dq_space_arm_env.kernels.programs.environment_programs import EnvironmentPrograms

        return EnvironmentPrograms(self.scene)

    @property
    def lanes(self) -> int:
        """Rows per vector: numbers of the scene's precision in a vector register."""
        return host_machine().lanes * 8 // self.dtype.itemsize

    def kernel(self, name: str, *, integrator: str | None = None, lanes: int | None = None) -> BoundKernel:
        """Compile a program of `ScenePrograms` or `EnvironmentPrograms`, or load it from the cache.

        With the prefix `PENALIZED` a program of `ScenePrograms` has the cost of `task.augmented_lagrangian`.
        `integrator` is that of programs that take a step, the scene's by default; `lanes` the rows the code
        works on at a time: 1, or the processor's vector width (default).
        """
        key = name, method, _ = self._variant(name, integrator, lanes)
        if key not in self._kernels:
            plain = name.removeprefix(PENALIZED)

            def trace() -> Program:
                if name.startswith("environment_"):
                    return self._environment_programs.build(name, method)
                if name == plain:
                    return self._programs.build(name, method)
                return replace(self._penalized_programs.build(plain, method), name=name)

            self._kernels[key] = self._load(*key, trace)
        return self._kernels[key]

    def is_ready(self, name: str, *, integrator: str | None = None, lanes: int | None = None) -> bool:
        """Tell whether a kernel is loaded or cached; the arguments are those of `kernel`."""
        variant = self._variant(name, integrator, lanes)
        return variant in self._kernels or is_kept(f"scene.{name}", self._cache_key(*variant))

    def _variant(self, name: str, integrator: str | None, lanes: int | None) -> tuple[str, str, int]:
        """Name of a kernel, its integrator, empty where it takes no step, and its lanes."""
        takes_steps = name.removeprefix(PENALIZED) in _STEPS
        method = (integrator or self.scene.simulation.integrator) if takes_steps else ""
        return name, method, self.lanes if lanes is None else lanes

    def _cache_key(self, name: str, variant: str, lanes: int) -> str:
        return cache_key(self.scene.content_hash(), source_hash(), name, variant, str(lanes))

    def paper_kernel(self, name: str, *, lanes: int | None = None) -> BoundKernel:
        """Compile a program of `PaperPrograms`, the redundant formulation, or load it from the cache."""
        width = self.lanes if lanes is None else lanes
        key = (name, width)
        if key not in self._paper_kernels:

            def trace() -> Program:
                from dq_space_arm_env.kernels.programs.paper_programs import PaperPrograms

                return PaperPrograms(self.scene).build(name)

            self._paper_kernels[key] = self._load(name, "paper", width, trace)
        return self._paper_kernels[key]

    def _load(self, name: str, variant: str, lanes: int, trace: Callable[[], Program]) -> BoundKernel:
        """Load a kernel from the cache; trace it if the scene is new, and compile it if its program is.

        The cache has the program's key by the scene's, and the code by the program's: scenes that differ in
        what a function does not depend on share its code.
        """
        of_scene, program = f"scene.{name}", cache(trace)

        def build() -> tuple[bytes, dict[str, Any]]:
            from dq_space_arm_env.compiler.build import build_program

            with self._compiling(name):
                return build_program(program(), lanes, self.scene.simulation.precision)

        scene_key = self._cache_key(name, variant, lanes)
        known = read_code(of_scene, scene_key)
        if known is None:
            with self._compiling(name):
                key = _program_key(program(), lanes, self.scene.simulation.precision)
        else:
            key = known.decode()
        kernel = native.load_or_build(name, key, build)
        if known is None:  # last: what another process finds there is ready
            keep_code(of_scene, scene_key, key.encode())
        return BoundKernel(kernel)

    @contextmanager
    def _compiling(self, name: str) -> Iterator[None]:
        """Say what a program is compiled for, while that lasts."""
        announce(f"scene {self.scene.name!r}")
        with compiling(lambda: f"{name} of scene {self.scene.name!r}"):
            yield

    def operation_count(self, name: str, *, integrator: str | None = None) -> int:
        """Arithmetic operations of a program per state, after folding and sharing subexpressions."""
        return self.kernel(name, integrator=integrator).operation_count

    @property
    def parameters(self) -> ParameterEntries:
        """Names, units and nominal values of the parameters p, the numbers that vary in the scene."""
        return self.layout.parameters

    @cached_property
    def _defaults(self) -> dict[str, Array]:
        """Inputs of kernels that a call may leave out: the time step and the nominal parameters."""
        inputs = {"h": [self.scene.simulation.dt], "parameters": self.parameters.nominal}
        return {name: np.array(values, self.dtype) for name, values in inputs.items()}

    def call(
        self, name: str, integrator: str | None = None, *, p: ArrayLike | None = None, **inputs: ArrayLike
    ) -> tuple[Array, ...]:
        """Run a program on one row or a batch; outputs take the form of the inputs.

        Parameters p, (n_p,) or (B, n_p), are nominal by default, and the time step h is the scene's.
        """
        key = name, integrator, "h" in inputs, p is None
        single = self._single_row_calls.get(key)
        # A kernel without parameters reads none, and would not see that they are wrong.
        if single is not None and (p is None or self.n_p or np.shape(p) == (0,)):
            results = single.results(inputs if p is None else {**inputs, "parameters": p})
            if results is not None:
                return results
        if p is not None:
            inputs = {**inputs, "p": self._checked_parameters(p)}
        rows, batched, arrays = rows_of(inputs, self.dtype)
        arrays = {**self._defaults, **arrays, "parameters": self.parameter_rows(arrays.get("p"), rows)}
        kernel = self.kernel(name, integrator=integrator, lanes=1 if rows == 1 else None)
        ordered = []
        for spec in kernel.inputs:
            array = arrays[spec.name]
            if array.shape[-1] != spec.stride:
                raise ValueError(
                    f"{name}: {spec.name} has {array.shape[-1]} entries per row, "
                    f"scene {self.scene.name!r} has {spec.stride}"
                )
            ordered.append(np.ascontiguousarray(array))
        outputs = [np.zeros((rows, spec.stride), self.dtype) for spec in kernel.outputs]
        kernel([*ordered, *outputs], rows, self.threads)
        if not batched:
            given = {"h": "h" in inputs, "parameters": p is not None}
            constant = {each: array for each, array in self._defaults.items() if not given[each]}
            self._single_row_calls.setdefault(key, SingleRowCalls(kernel, constant))
        return tuple(output if batched else output[0] for output in outputs)

    def parameter_rows(self, p: ArrayLike | None, rows: int) -> Array:
        """Parameters of so many rows, (rows, n_p), from p of shape (n_p,) or (rows, n_p); None for nominal.

        Raises ValueError for another shape.
        """
        given = self._defaults["parameters"] if p is None else self._checked_parameters(p, rows)
        return np.broadcast_to(given, (rows, self.n_p))

    def _checked_parameters(self, p: ArrayLike, rows: int | None = None) -> Array:
        """Parameters of shape (n_p,) or (rows, n_p), or of any number of rows; ValueError for another."""
        given = real_array("p", p, self.dtype)
        batch = (len(given) if rows is None and given.ndim == 2 else rows, self.n_p)
        if given.shape not in ((self.n_p,), batch):
            raise ValueError(
                f"p: shape {given.shape}, should be ({self.n_p},) or ({rows or 'B'}, {self.n_p}); the "
                f"parameters of scene {self.scene.name!r} are {', '.join(self.parameters.names) or 'none'}"
            )
        return given


def check_threads(threads: Any) -> None:
    """Raise ValueError unless work can be shared among so many threads."""
    if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or threads < 1:
        raise ValueError(f"threads: {threads!r}, should be a whole number of at least 1")


def compile_program(program: Program, lanes: int) -> BoundKernel:
    """Compile a program that belongs to no scene, in double precision, or load it from the cache."""

    def build() -> tuple[bytes, dict[str, Any]]:
        from dq_space_arm_env.compiler.build import build_program

        return build_program(program, lanes)

    return BoundKernel(native.load_or_build(program.name, _program_key(program, lanes, "float64"), build))


def _program_key(program: Program, lanes: int, precision: str) -> str:
    """Key of a program's code, which does not depend on what derivatives hold constant."""
    return cache_key(repr(replace(program, held=set())), source_hash(), str(lanes), precision)


def matrices(entries: Array, rows: int, columns: int) -> Array:
    """Give matrices, stored row by row, their shape."""
    return entries.reshape(*entries.shape[:-1], rows, columns)


@cache
def source_hash() -> str:
    """Hash of what traces kernels, source and CasADi: a changed model never meets an old kernel.

    Returns:
        A hexadecimal number.
    """
    package = Path(__file__).parent.parent
    digest = hashlib.sha256(version("casadi").encode())
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] in _MODEL_SOURCES:
            digest.update(path.read_bytes())
    return digest.hexdigest()


PENALIZED = "penalized_"
"""Prefix of programs whose cost has a penalty for each constraint."""

_MODEL_SOURCES = ("algebra", "compiler", "dynamics", "integrators", "kernels", "scene", "task", "validation")

_STEPS = (
    "step",
    "step_with_cost",
    "checked_step",
    "walk",
    "linearize",
    "linearize_parameters",
    "vjp",
    "step_with_cost_vjp",
    "lagrangian_hessian",
    "environment_step",
    "environment_step_float32_actions",
)
