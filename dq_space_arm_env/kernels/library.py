"""Where a scene's kernels come from: the process, the disk cache, or the compiler, in this order.

A process that finds what it needs in the cache neither traces nor compiles, nor does it import CasADi.
"""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from dq_space_arm_env.compiler import native
from dq_space_arm_env.kernels.bound import BoundKernel
from dq_space_arm_env.scene.schema import Scene

if TYPE_CHECKING:
    from dq_space_arm_env.compiler.program import Program
    from dq_space_arm_env.kernels.environment_programs import EnvironmentPrograms
    from dq_space_arm_env.kernels.programs import ScenePrograms


class KernelLibrary:
    """The compiled programs of a scene, by name.

    Attributes:
        scene: The scene.
        dtype: Type of the numbers that they compute with.
    """

    def __init__(self, scene: Scene) -> None:
        """Prepare; nothing is compiled yet.

        Args:
            scene: A validated scene.
        """
        self.scene = scene
        self.dtype = np.dtype(scene.simulation.precision)
        self._kernels: dict[tuple[str, str, int], BoundKernel] = {}
        self._paper_kernels: dict[tuple[str, int], BoundKernel] = {}
        self._announced = False

    @cached_property
    def _programs(self) -> ScenePrograms:
        from dq_space_arm_env.kernels.programs import ScenePrograms

        return ScenePrograms(self.scene)

    @cached_property
    def _environment_programs(self) -> EnvironmentPrograms:
        from dq_space_arm_env.kernels.environment_programs import EnvironmentPrograms

        return EnvironmentPrograms(self.scene)

    @property
    def lanes(self) -> int:
        """Rows that vector code works on at a time: numbers of the scene's precision in a vector register."""
        return native.host_machine().lanes * 8 // self.dtype.itemsize

    def kernel(self, name: str, *, integrator: str | None = None, lanes: int | None = None) -> BoundKernel:
        """Compile a program, or load it from the cache.

        Args:
            name: Name of the program (`ScenePrograms` or `EnvironmentPrograms`, both in `kernels`).
            integrator: Integrator of programs that take a step; the scene's by default.
            lanes: Rows that the code works on at a time: 1, or the processor's vector width (default).

        Returns:
            The kernel.

        Raises:
            ValueError: If there is no integrator of that name.
        """
        method = (integrator or self.scene.simulation.integrator) if name in _STEPS else ""
        key = (name, method, self.lanes if lanes is None else lanes)
        if key not in self._kernels:

            def trace() -> Program:
                of_environment = name.startswith("environment_")
                programs = self._environment_programs if of_environment else self._programs
                return programs.build(name, method)

            self._kernels[key] = self._load(*key, trace)
        return self._kernels[key]

    def paper_kernel(self, name: str, *, lanes: int | None = None) -> BoundKernel:
        """Compile a program of the paper's redundant formulation, or load it from the cache.

        Args:
            name: Name of the program (`kernels.paper_programs.PaperPrograms`).
            lanes: Rows that the code works on at a time: 1, or the processor's vector width (default).

        Returns:
            The kernel.
        """
        width = self.lanes if lanes is None else lanes
        key = (name, width)
        if key not in self._paper_kernels:

            def trace() -> Program:
                from dq_space_arm_env.kernels.paper_programs import PaperPrograms

                return PaperPrograms(self.scene).build(name)

            self._paper_kernels[key] = self._load(name, "paper", width, trace)
        return self._paper_kernels[key]

    def _load(self, name: str, variant: str, lanes: int, trace: Callable[[], Program]) -> BoundKernel:
        """Load a kernel from the cache; trace and compile it if it is not there."""
        parts = (self.scene.content_hash(), _source_hash(), name, variant, str(lanes))

        def build() -> tuple[bytes, dict[str, Any]]:
            from dq_space_arm_env.compiler.build import build_program

            self._announce()
            return build_program(trace(), lanes, self.scene.simulation.precision)

        return BoundKernel(native.load_or_build(name, native.cache_key(*parts), build))

    def operation_count(self, name: str, *, integrator: str | None = None) -> int:
        """Arithmetic operations of a program per state.

        Args:
            name: Name of the program.
            integrator: Integrator of programs that take a step; the scene's by default.

        Returns:
            The count after folding constants and sharing subexpressions.
        """
        return self.kernel(name, integrator=integrator).operation_count

    def _announce(self) -> None:
        """Tell the user, once, why the first use of a scene takes a moment."""
        if not self._announced:
            self._announced = True
            _logger().info(
                "compiling scene %r for its first use, which takes seconds; the result is kept in %s",
                self.scene.name,
                native.cache_directory(),
            )


class _StandardError(logging.StreamHandler[TextIO]):
    """Writes to whatever is the standard error now, not when the logger was made."""

    @property
    def stream(self) -> TextIO:
        """The present standard error."""
        return sys.stderr

    @stream.setter
    def stream(self, value: TextIO) -> None:
        """Nothing is kept."""


@cache
def _logger() -> logging.Logger:
    """The package's logger; its messages are shown unless its level is raised."""
    logger = logging.getLogger("dq_space_arm_env")
    if not logger.handlers:
        handler = _StandardError()
        handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
        logger.addHandler(handler)
        logger.propagate = False
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.INFO)
    return logger


@cache
def _source_hash() -> str:
    """Hash of the source that kernels are made from, so that a changed model never meets an old kernel."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] in _MODEL_SOURCES:
            digest.update(path.read_bytes())
    return digest.hexdigest()


_MODEL_SOURCES = ("algebra", "compiler", "cost.py", "dynamics", "integrators", "kernels", "scene")

_STEPS = (
    "step",
    "step_with_cost",
    "walk",
    "linearize",
    "lagrangian_hessian",
    "environment_step",
    "environment_step_float32_actions",
)
