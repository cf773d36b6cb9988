"""Other engines with a scene's robot; none of them is a dependency of this package.

Each is given what makes it fast: it runs in batches in C++ on one thread, without contacts, constraints and
gravity, and takes the inputs as generalized forces, so that it evaluates no actuators.
"""

from __future__ import annotations

from typing import Protocol

from dq_space_arm_env import Kernels
from dq_space_arm_env.dynamics.chain import Chain
from experts.problem import FloatArray
from experts.report.throughput.mujoco_peer import MujocoPeer
from experts.report.throughput.pinocchio_peer import PinocchioPeer
from experts.report.throughput.timing import Case


class Peer(Protocol):
    """Another engine with the robot of a scene."""

    name: str
    notes: list[str]
    """What of it is left out."""

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """What `Kernels.forward_dynamics` gives, from this engine."""

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """Joint angles, shape (B, n), rad, after steps without inputs; None if the engine takes no steps."""

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """What to time."""


def peers_of(kernels: Kernels) -> tuple[list[Peer], list[str]]:
    """Build a scene's robot in the engines that are installed.

    Args:
        kernels: Functions of the scene.

    Returns:
        The peers, and a sentence for each thing that is left out.
    """
    chain = Chain.from_scene(kernels.scene)
    if chain.tip_wrench is not None:
        return [], [
            f"Scene {kernels.scene.name}: no peers, for they have no wrench that turns with the wrist."
        ]
    peers: list[Peer] = []
    notes = []
    for title, package, kind in (("Pinocchio", "pin", PinocchioPeer), ("MuJoCo", "mujoco", MujocoPeer)):
        try:
            peers.append(kind(kernels, chain))
        except ImportError:
            notes.append(f"{title} is left out: it is not installed (pip install {package}).")
        else:
            notes += peers[-1].notes
    return peers, notes
