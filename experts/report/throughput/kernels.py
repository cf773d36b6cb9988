"""Kernels to be timed: forward dynamics, steps, and the whole step of an environment, called from Python."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from dq_space_arm_env import Kernels, Scene
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene.start import number_of_draws, start_from_draws
from experts.problem import FloatArray
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.throughput.timing import DYNAMICS, ENVIRONMENT, FLOAT64, OURS, STEP, Case, Subject
from experts.report.throughput.variants import PLAIN, VARIANTS, Variant

SCALAR, VECTOR = "scalar kernel", "vector kernel"
PROGRAMS = {DYNAMICS: "forward_dynamics", STEP: "step", ENVIRONMENT: "environment_step"}


def sample_states(kernels: Kernels, count: int) -> tuple[FloatArray, FloatArray]:
    """Draw moving states around the scene's start, and inputs within their limits, always the same.

    Args:
        kernels: Functions of the scene.
        count: How many.

    Returns:
        States, shape (count, n_x), and inputs, shape (count, n_u); an input without limit is within 1 unit.
    """
    rng = np.random.default_rng(0)
    layout, scene = kernels.layout, kernels.scene
    x = start_from_draws(scene, rng.uniform(-1.0, 1.0, (count, number_of_draws(scene)))).astype(FLOAT64)
    for part, size in ((layout.state.base_velocity, 0.2), (layout.state.joint_rates, 0.5)):
        x[:, part] += rng.uniform(-size, size, x[:, part].shape)
    return x, finite_limits(kernels) * rng.uniform(-1.0, 1.0, (count, kernels.n_u))


def finite_limits(kernels: Kernels) -> FloatArray:
    """Limits of the inputs, shape (n_u,), units of `layout.control`; 1 for an input without limit."""
    limit = kernels.layout.control_limit
    return np.where(np.isfinite(limit), limit, 1.0)


def kernel_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """Every kernel that is timed of a scene, for each batch size: scalar code, and vector code in each way.

    Args:
        scene: The scene.
        batch_sizes: States per call.

    Returns:
        The cases; of the environment's step, with the scene's integrator only.
    """
    chosen = scene.simulation.integrator
    programs = [(DYNAMICS, ""), *((STEP, name) for name in COMPARED_INTEGRATORS), (ENVIRONMENT, chosen)]
    cases = []
    for what, integrator in programs:
        for variant, way in ((PLAIN, SCALAR), *((variant, VECTOR) for variant in VARIANTS)):
            for batch in batch_sizes:
                cases.append(kernel_case(scene, what, integrator, batch, variant, way))
    return cases


def kernel_case(
    scene: Scene, what: str, integrator: str, batch: int, variant: Variant = PLAIN, way: str = VECTOR
) -> Case:
    """A kernel on arrays of its own.

    Args:
        scene: The scene.
        what: DYNAMICS, STEP or ENVIRONMENT.
        integrator: Name of the integrator; empty for dynamics.
        batch: States per call.
        variant: Precision and threads.
        way: SCALAR or VECTOR.

    Returns:
        The case.
    """
    kernels = variant.compile(scene)
    lanes = 1 if way == SCALAR else None
    kernel = kernels.kernel(PROGRAMS[what], integrator=integrator or None, lanes=lanes)
    x, u = sample_states(kernels, batch)
    inputs = {"x": x, "u": u, "action": u / finite_limits(kernels), "h": np.array([scene.simulation.dt])}
    if what == ENVIRONMENT:
        inputs |= _episodes(kernels, batch)
    arrays = {spec.name: np.ascontiguousarray(inputs[spec.name], spec.dtype) for spec in kernel.inputs}
    arrays |= {
        spec.name: np.zeros((spec.stride, batch) if spec.by_column else (batch, spec.stride), spec.dtype)
        for spec in kernel.outputs
    }
    subject = Subject(
        what=what,
        engine=OURS,
        way=way,
        integrator=integrator,
        batch=batch,
        precision=variant.precision,
        threads=variant.threads,
        operations=kernel.operation_count,
    )
    call = KernelCall(kernel, arrays)
    # One row is called as the single environment does it, many as the vector environment does.
    run = call.of_one_row() if batch == 1 else partial(call, batch, variant.threads)
    return Case(subject, run)


def _episodes(kernels: Kernels, count: int) -> dict[str, np.ndarray]:
    """What the environment's step reads besides state and action: that of episodes which have just begun."""
    start = kernels.kernel("environment_start")
    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (count, number_of_draws(kernels.scene)))
    begun = {spec.name: np.zeros((count, spec.stride), dtype=spec.dtype) for spec in start.outputs}
    KernelCall(start, {"draws": draws, **begun}).on_rows(np.arange(count))
    return begun
