"""Size and time of a scene: operations, bytes, compile time of its programs, and time of its kernels."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import llvmlite.binding as llvm
import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.compiler.build import build_program
from dq_space_arm_env.compiler.native import NativeKernel
from dq_space_arm_env.compiler.program import Program
from dq_space_arm_env.kernels.library import KernelLibrary
from dq_space_arm_env.kernels.programs.environment_programs import EnvironmentPrograms
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.layout import StateLayout
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row
from scripts.benchmarks.subjects import (
    COMPARED_INTEGRATORS,
    DYNAMICS,
    ENVIRONMENT,
    MAKE_VEC,
    OURS,
    PLAIN,
    STEP,
    Case,
    Subject,
    kernel_case,
    time_cases,
    vector_case,
)

BATCH = 1024
OUTPUTS: Mapping[str, str] = {
    "step": "the next state",
    "forward_dynamics": "accelerations",
    "reaction_wrenches": "reaction wrenches of the joints",
    "tip_pose": "pose of the tip",
    "frame_poses": "poses of all frames",
    "momentum": "momentum",
    "energy": "energy",
    "cost": "stage cost",
    "cost_derivatives": "first derivatives of the cost",
    "linearize": "first derivatives of the step",
    "lagrangian_hessian": "second derivatives of step and cost",
}
"""Programs that only their callers pay for, by output; the step first, to compare with."""
_SECOND = "lagrangian_hessian"


def program_row(scene: Scene, name: str, integrator: str = "", repeats: int = 1) -> Row:
    """Trace, compile and load a program for vectors without any cache; the fastest repetition counts.

    Memory is that of a state in the program: its rows of inputs and outputs, and intermediate results that
    one part of the program hands to the next.
    """
    library = KernelLibrary(scene)
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        program = trace_program(scene, name, integrator)
        traced = time.perf_counter()
        code, metadata = build_program(program, library.lanes, scene.simulation.precision)
        NativeKernel(name, code, metadata)
        ready = time.perf_counter()
        row = {
            "operations": program.operation_count,
            "code_bytes": _code_bytes(code),
            "memory_bytes": library.dtype.itemsize * sum(program.scratch_sizes().values()),
            "trace_s": traced - start,
            "compile_s": ready - traced,
            "cold_s": ready - start,
        }
        found.append(row)
    return min(found, key=lambda row: row["cold_s"])


def trace_program(scene: Scene, name: str, integrator: str = "") -> Program:
    """Trace a program of `ScenePrograms` or `EnvironmentPrograms`, as for its first use."""
    of_environment = name.startswith("environment_")
    programs = EnvironmentPrograms(scene) if of_environment else ScenePrograms(scene)
    return programs.build(name, integrator)


def _code_bytes(object_code: bytes) -> int:
    """Size of an object file's sections of instructions."""
    sections = llvm.ObjectFileRef.from_data(object_code).sections()
    return sum(section.size() for section in sections if section.is_text())


def size_row(scene: Scene, repeats: int = 1) -> Row:
    """Numbers of states, inputs and outputs; operations, whatever the machine; the compiled steps."""
    layout, integrator = StateLayout.of(scene), scene.simulation.integrator
    sizes = {buffer.name: buffer.size for buffer in trace_program(scene, "environment_observe").outputs}
    row: Row = {
        "states": layout.n_x,
        "tangent_states": layout.n_t,
        "inputs": layout.n_u,
        "observations": sizes["observation"],
        "state_bytes": layout.n_x * np.dtype(scene.simulation.precision).itemsize,
        "dynamics_operations": trace_program(scene, "forward_dynamics").operation_count,
    }
    for name in COMPARED_INTEGRATORS:
        takes = INTEGRATORS[name].takes(scene)
        row[f"{name}_operations"] = trace_program(scene, "step", name).operation_count if takes else None
    for name, prefix in (("step", "step"), ("environment_step", "environment")):
        program = program_row(scene, name, integrator, repeats)
        row |= {f"{prefix}_{key}": value for key, value in program.items()}
    return row


def scene_rows(table: str, scenes: Mapping[str, Scene], effort: Effort, *, vector: bool) -> Iterator[Row]:
    """Sizes of scenes by title, and times in float64 on one thread, with ratios to the first of them.

    Times are taken in turns, which makes them comparable.
    """
    rows: list[Row] = []
    cases = [_cases(scene, vector) for scene in scenes.values()]
    timings = iter(time_cases([case for own in cases for case in own], effort.cost_timing))
    for (title, scene), own in zip(scenes.items(), cases, strict=True):
        names = ("dynamics_ns", "step_ns", "environment_ns", "make_vec_ns", "whole_steps_ns")[: len(own)]
        row: Row = {"table": table, "title": title, "integrator": scene.simulation.integrator}
        row |= size_row(scene, effort.compilations)
        row |= {name: next(timings)["best_ns"] for name in names}
        first = rows[0] if rows else row
        for key in ("step_operations", "environment_operations", "step_ns", "environment_ns"):
            row[f"{key}_ratio"] = row[key] / first[key]
        if "whole_steps_ns" in row:
            row["of_whole_steps"] = row["make_vec_ns"] / row["whole_steps_ns"]
        rows.append(row)
        yield row


def _cases(scene: Scene, vector: bool) -> list[Case]:
    integrator = scene.simulation.integrator
    programs = ((DYNAMICS, ""), (STEP, integrator), (ENVIRONMENT, integrator))
    cases = [kernel_case(scene, what, name, BATCH) for what, name in programs]
    compared = [scene] if vector else []
    if vector and INTEGRATORS[integrator].is_embedded:
        compared.append(scene.replace(simulation={"tolerance": "off"}))
    for each in compared:
        subject = Subject(what=ENVIRONMENT, engine=OURS, way=MAKE_VEC, integrator=integrator, batch=BATCH)
        cases.append(vector_case(subject, PLAIN.make_vec(each, BATCH, integrator), scene.simulation.steps))
    return cases


def output_rows(scene: Scene, repeats: int) -> Iterator[Row]:
    """Cost of each output to those who ask for it; without second derivatives where there are none."""
    own = scene.simulation.integrator
    curvature = INTEGRATORS[own].curvature
    integrators = {"step": own, "linearize": own, _SECOND: curvature}
    step = 0
    for name, what in OUTPUTS.items():
        if name != _SECOND or curvature is not None:
            row = program_row(scene, name, integrators.get(name) or "", repeats)
            step = step or row["operations"]
            labels = {"table": "outputs", "scene": scene.name, "output": what, "program": name}
            yield {**labels, **row, "of_a_step": row["operations"] / step}
