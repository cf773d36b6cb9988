"""What compiled programs cost: operations, bytes, and the time until a program that was never used runs."""

from __future__ import annotations

import time
from dataclasses import dataclass

import llvmlite.binding as llvm

from dq_space_arm_env import Scene
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.native import NativeKernel
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.kernels.environment_programs import EnvironmentPrograms
from dq_space_arm_env.kernels.library import KernelLibrary
from dq_space_arm_env.kernels.programs import ScenePrograms


@dataclass(frozen=True)
class ProgramCost:
    """What a program costs, compiled for vectors.

    Attributes:
        name: Name of the program.
        operations: Arithmetic operations per state, a multiply-add counting as two.
        code_bytes: Machine code.
        memory_bytes: What a state occupies while it is worked on: its rows of inputs and outputs, and the
            intermediate results that one part of the program hands to the next.
        trace_seconds: From the scene to the expression graphs, s.
        compile_seconds: From the graphs to machine code that is ready to be called, s.
    """

    name: str
    operations: int
    code_bytes: int
    memory_bytes: int
    trace_seconds: float
    compile_seconds: float

    @property
    def seconds(self) -> float:
        """From the scene to machine code that is ready to be called, s."""
        return self.trace_seconds + self.compile_seconds


def trace_program(scene: Scene, name: str, integrator: str = "") -> Program:
    """Trace a program, as for its first use.

    Args:
        scene: The scene.
        name: Name of the program, of `ScenePrograms` or `EnvironmentPrograms`.
        integrator: Name of the integrator; empty for programs that take no step.

    Returns:
        The program.
    """
    of_environment = name.startswith("environment_")
    programs = EnvironmentPrograms(scene) if of_environment else ScenePrograms(scene)
    return programs.build(name, integrator)


def compile_cold(scene: Scene, name: str, integrator: str = "", repeats: int = 1) -> ProgramCost:
    """Trace, compile and load a program without any cache.

    Args:
        scene: The scene.
        name: Name of the program, of `ScenePrograms` or `EnvironmentPrograms`.
        integrator: Name of the integrator; empty for programs that take no step.
        repeats: How often; the fastest counts.

    Returns:
        What it costs.
    """
    library = KernelLibrary(scene)
    costs = []
    for _ in range(repeats):
        start = time.perf_counter()
        program = trace_program(scene, name, integrator)
        traced = time.perf_counter()
        code, metadata = build_program(program, library.lanes, scene.simulation.precision)
        NativeKernel(name, code, metadata)
        ready = time.perf_counter()
        costs.append(
            ProgramCost(
                name=name,
                operations=program.operation_count,
                code_bytes=_code_bytes(code),
                memory_bytes=library.dtype.itemsize * sum(program.scratch_sizes().values()),
                trace_seconds=traced - start,
                compile_seconds=ready - traced,
            )
        )
    return min(costs, key=lambda cost: cost.seconds)


def _code_bytes(object_code: bytes) -> int:
    """Size of an object file's sections of instructions."""
    sections = llvm.ObjectFileRef.from_data(object_code).sections()
    return sum(section.size() for section in sections if section.is_text())
