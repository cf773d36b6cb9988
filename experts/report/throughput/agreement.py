"""How far results are apart: engines from each other, scalar from vector code, float32 from float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env import Kernels, Scene
from experts.problem import FloatArray
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.throughput.kernels import SCALAR, VECTOR, sample_states
from experts.report.throughput.peers import Peer
from experts.report.throughput.timing import FLOAT32, FLOAT64, OURS
from experts.report.throughput.variants import PLAIN, Variant

STATES, STEPS = 64, 64
ACCELERATIONS, ANGLES = "accelerations", f"joint angles, {STEPS} steps"
_SUBSTEPS = 16


@dataclass(frozen=True)
class Agreement:
    """How far an engine's results are off.

    Attributes:
        quantity: What is compared.
        engine: Whose results.
        reference: What they are compared with.
        integrator: Name of the integrator; empty for dynamics.
        error: Largest error over the compared states.
        unit: Its unit; "1" for relative errors.
    """

    quantity: str
    engine: str
    reference: str
    integrator: str
    error: float
    unit: str


def agreements(scene: Scene, peers: Sequence[Peer]) -> list[Agreement]:
    """Compare accelerations with each peer's, and every engine's joint angles with a finer integration.

    Args:
        scene: The scene.
        peers: Other engines with its robot.

    Returns:
        The errors; of joint angles after some steps without inputs.
    """
    kernels = PLAIN.compile(scene)
    x, u = sample_states(kernels, STATES)
    return [
        *_accelerations(kernels, peers, x, u),
        *_joint_angles(kernels, peers, x),
        *_single_precision(kernels, x, u),
    ]


def _accelerations(kernels: Kernels, peers: Sequence[Peer], x: FloatArray, u: FloatArray) -> list[Agreement]:
    ours = kernels.forward_dynamics(x, u)
    one_by_one = np.array([kernels.forward_dynamics(*row) for row in zip(x, u, strict=True)])
    found = [Agreement(ACCELERATIONS, VECTOR, SCALAR, "", _relative(ours, one_by_one), "1")]
    for peer in peers:
        error = _relative(ours, peer.accelerations(x, u))
        found.append(Agreement(ACCELERATIONS, OURS, peer.name, "", error, "1"))
    return found


def _joint_angles(kernels: Kernels, peers: Sequence[Peer], x: FloatArray) -> list[Agreement]:
    dt = kernels.scene.simulation.dt
    reference = _end_angles(kernels, x, "rk4", STEPS * _SUBSTEPS, dt / _SUBSTEPS)
    finer = f"RK4, dt/{_SUBSTEPS}"
    found = []
    for integrator in COMPARED_INTEGRATORS:
        angles: list[tuple[str, FloatArray | None]] = [(OURS, _end_angles(kernels, x, integrator, STEPS, dt))]
        angles += [(peer.name, peer.end_angles(x, integrator, STEPS)) for peer in peers]
        for engine, values in angles:
            if values is not None:
                error = _largest(values - reference)
                found.append(Agreement(ANGLES, engine, finer, integrator, error, "rad"))
    return found


def _single_precision(kernels: Kernels, x: FloatArray, u: FloatArray) -> list[Agreement]:
    """What float32 loses, its rounding of the states included."""
    single = Variant(FLOAT32).compile(kernels.scene)
    engine, reference = f"{OURS}, {FLOAT32}", f"{OURS}, {FLOAT64}"
    error = _relative(single.forward_dynamics(x, u).astype(FLOAT64), kernels.forward_dynamics(x, u))
    found = [Agreement(ACCELERATIONS, engine, reference, "", error, "1")]
    dt = kernels.scene.simulation.dt
    for integrator in COMPARED_INTEGRATORS:
        angles = [_end_angles(each, x, integrator, STEPS, dt) for each in (single, kernels)]
        found.append(Agreement(ANGLES, engine, reference, integrator, _largest(angles[0] - angles[1]), "rad"))
    return found


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
