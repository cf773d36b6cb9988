"""A scene's step as XLA compiles it, on each kind of device that JAX finds, beside the kernels on one core.

States lie on the device already. A step has to agree with the kernels', and so has the gradient, by the
inputs, of the sum of the next state. Compilation includes the first step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from time import perf_counter
from typing import Any

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.common.host_machine import processors
from dq_space_arm_env.common.tables import Column
from experts.report.part_costs import moving_states
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Row, Table, claim, note, one_by_one, time_column
from scripts.benchmarks.subjects import (
    GRADIENT,
    STEP,
    Case,
    Subject,
    compared_integrators,
    kernel_case,
    time_cases,
)
from scripts.benchmarks.throughput import rate

BATCHES = {"cpu": (1024,)}  # by platform; an accelerator fills with many states only
OF_ACCELERATORS = (1024, 16384, 262144)
_BOUND = 1e-14  # of the largest differences, relative to the largest entry


def measure(effort: Effort) -> Iterator[Row]:
    """Measure each scene on each device."""
    if find_spec("jax") is None:
        yield note("Devices are left out: JAX is not installed (pip install jax, or jax[cuda13] for a GPU).")
        return
    jax: Any = import_module("jax")
    jax.config.update("jax_enable_x64", True)  # `jax.enable_x64` does not reach the threads that call back
    # Beside an accelerator, the processor is none of `jax.devices()`.
    devices = dict.fromkeys([jax.devices("cpu")[0], jax.devices()[0]])
    for name in effort.scenes or ("paper",):
        scene = load_scene(name)
        for integrator in compared_integrators(scene):
            yield from one_by_one(
                f"scene {name}", _measure_step(jax, scene, integrator, list(devices), effort)
            )


def _measure_step(
    jax: Any, scene: Scene, integrator: str, devices: list[Any], effort: Effort
) -> Iterator[Row]:
    """Rows of a step and its gradient."""
    labels: Row = {"table": "devices", "scene": scene.name}
    kernels = compile_scene(scene)
    own = [kernel_case(scene, what, integrator, BATCHES["cpu"][0]) for what in (STEP, GRADIENT)]
    yield from ({**labels, **timing} for timing in time_cases(own, effort.kernel_timing))
    ours, theirs = (_functions(jax, scene, integrator, of_kernels) for of_kernels in (True, False))
    for what, device in ((what, device) for what in ours for device in devices):
        for batch in BATCHES.get(device.platform, OF_ACCELERATORS):
            x, u = moving_states(kernels, batch)
            arrays = [jax.device_put(each, device) for each in (x, u)]
            run = partial(_finished, jax, theirs[what], *arrays)
            begin = perf_counter()
            found = np.asarray(run())
            compilation = perf_counter() - begin
            expected = np.asarray(ours[what](x, u))
            error = float(np.abs(found - expected).max() / np.abs(expected).max())
            kind = device.device_kind
            yield claim(what, integrator, f"scene {scene.name}, {batch:,} on {kind}", error, _BOUND)
            cores = processors() if device.platform == "cpu" else 1  # XLA takes what it likes of them
            subject = Subject(
                what=what, engine="XLA", way=kind, integrator=integrator, batch=batch, threads=cores
            )
            (timing,) = time_cases([Case(subject, run)], effort.kernel_timing)
            yield {**labels, **timing, "compile_s": compilation, "error": error}


def _finished(jax: Any, function: Callable[..., Any], *arrays: Any) -> Any:
    """The result of a function, once it is there."""
    return jax.block_until_ready(function(*arrays))


def _functions(jax: Any, scene: Scene, integrator: str, of_kernels: bool) -> Mapping[str, Callable[..., Any]]:
    """The step, and the gradient, of states (B, n_x) and inputs (B, n_u)."""
    from dq_space_arm_env import jax_dynamics

    step = jax_dynamics(scene, integrator, kernels=of_kernels).step
    return {STEP: jax.jit(step), GRADIENT: jax.jit(jax.grad(lambda x, u: step(x, u).sum(), argnums=1))}


BENCHMARK = Benchmark(
    "devices",
    "Devices",
    "A step and its gradient, as XLA compiles them for each device, and the kernels on one core. Best of "
    "several samples, median beside it.",
    measure,
    tables=(
        Table(
            "devices",
            "Scene {scene}: XLA's step and the kernels', ns per state\nthe error is the largest difference "
            "from the kernels, relative to the largest entry",
            (
                "integrator",
                "what",
                "engine",
                Column("way", "on"),
                "batch",
                "threads",
                time_column("best_ns", "best"),
                time_column("median_ns", "median"),
                Column("states_per_second", "per s", rate),
                time_column("compile_s", "compiled in [s]"),
                Column("error", format=".1e", missing=""),
            ),
            by=("scene",),
        ),
    ),
    packages=("jax",),
)
