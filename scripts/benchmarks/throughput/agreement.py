"""Differences of results: between engines, scalar and vector code, float32 and float64."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dq_space_arm_env import Kernels, Scene
from experts.problems.shooting_problem import FloatArray
from experts.report.part_costs import moving_states
from scripts.benchmarks.harness import Row, claim
from scripts.benchmarks.peers import Peer
from scripts.benchmarks.subjects import (
    FLOAT32,
    FLOAT64,
    OURS,
    PLAIN,
    SCALAR,
    VECTOR,
    Variant,
    compared_integrators,
)

STATES, STEPS = 64, 64
ACCELERATIONS, ANGLES = "accelerations", f"joint angles, {STEPS} steps"
_SUBSTEPS = 16
AGREEMENT = 1e-10
"""Largest relative difference of accelerations in double precision from those of other engines."""


def agreements(scene: Scene, peers: Sequence[Peer]) -> Iterator[Row]:
    """Compare accelerations with each peer's, and every engine's joint angles with a finer integration.

    Accelerations in double precision are claims; what float32 loses includes its rounding of the states.
    """
    kernels, single = PLAIN.compile(scene), Variant(FLOAT32).compile(scene)
    x, u = moving_states(kernels, STATES)
    ours = kernels.forward_dynamics(x, u)
    one_by_one = np.array([kernels.forward_dynamics(*row) for row in zip(x, u, strict=True)])
    found = [(VECTOR, SCALAR, one_by_one), *((OURS, peer.name, peer.accelerations(x, u)) for peer in peers)]
    for engine, reference, values in found:
        error = _relative(ours, values)
        yield _agreement(scene, ACCELERATIONS, engine, reference, error)
        yield claim(ACCELERATIONS, f"scene {scene.name}", f"{engine} and {reference}", error, AGREEMENT)
    dt, finer = scene.simulation.dt, f"RK4, dt/{_SUBSTEPS}"
    exact = _end_angles(kernels, x, "rk4", STEPS * _SUBSTEPS, dt / _SUBSTEPS)
    float32, float64 = f"{OURS}, {FLOAT32}", f"{OURS}, {FLOAT64}"
    error = _relative(single.forward_dynamics(x, u).astype(FLOAT64), ours)
    yield _agreement(scene, ACCELERATIONS, float32, float64, error)
    for integrator in compared_integrators(scene):
        own = _end_angles(kernels, x, integrator, STEPS, dt)
        rounded = _end_angles(single, x, integrator, STEPS, dt)
        for peer in (None, *peers):
            angles = own if peer is None else peer.end_angles(x, integrator, STEPS)
            if angles is not None:
                name = OURS if peer is None else peer.name
                yield _agreement(scene, ANGLES, name, finer, _largest(angles - exact), integrator)
        yield _agreement(scene, ANGLES, float32, float64, _largest(rounded - own), integrator)


def _agreement(
    scene: Scene, quantity: str, engine: str, reference: str, error: float, integrator: str = ""
) -> Row:
    labels = {"scene": scene.name, "quantity": quantity, "engine": engine, "reference": reference}
    unit = "relative" if quantity == ACCELERATIONS else "rad"
    return {"table": "agreements", **labels, "integrator": integrator, "error": error, "unit": unit}


def _relative(actual: FloatArray, expected: FloatArray) -> float:
    """Largest relative error of a row."""
    error = np.linalg.norm(actual - expected, axis=1) / np.linalg.norm(expected, axis=1)
    return float(error.max())


def _largest(difference: FloatArray) -> float:
    return float(np.abs(difference).max(initial=0.0))


def _end_angles(kernels: Kernels, x: FloatArray, integrator: str, steps: int, dt: float) -> FloatArray:
    """Joint angles after steps without inputs."""
    u = np.zeros((len(x), kernels.n_u))
    for _ in range(steps):
        x = kernels.step(x, u, dt, integrator)
    return x[:, kernels.layout.state.joint_angles].astype(FLOAT64)
