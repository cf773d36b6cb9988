"""Other engines and solvers with the robot of a scene; each is optional.

Each engine is given what makes it fast: it runs in batches in C++ on one thread, without contacts,
constraints and gravity, and takes the inputs as generalized forces instead of evaluating actuators.
"""

from __future__ import annotations

from typing import Protocol

from dq_space_arm_env import Kernels
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.subjects import Case


class Peer(Protocol):
    """Another engine with the robot of a scene."""

    name: str
    notes: list[str]  # parts that are left out

    def accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """The accelerations of `Kernels.forward_dynamics`, by this engine."""

    def end_angles(self, x: FloatArray, integrator: str, steps: int) -> FloatArray | None:
        """Joint angles, shape (B, n), rad, after steps without inputs; None if the engine takes no steps."""

    def cases(self, x: FloatArray, u: FloatArray) -> list[Case]:
        """Cases to time."""


def peers_of(kernels: Kernels) -> tuple[list[Peer], list[str]]:
    """Build a scene's robot in the engines that are installed; and a sentence for each that is left out."""
    from scripts.benchmarks.peers.mujoco_peer import MujocoPeer
    from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer
    from scripts.benchmarks.peers.robot import beyond_the_robot

    tree = KinematicTree.from_scene(kernels.scene)
    if tree.tip_wrench is not None:
        return [], [f"Scene {kernels.scene.name} has no peers: their wrenches do not turn with a wrist."]
    if more := beyond_the_robot(kernels.scene):
        return [], [f"Scene {kernels.scene.name} has no peers: they are not given {' or '.join(more)}."]
    peers: list[Peer] = []
    notes = []
    for title, package, kind in (("Pinocchio", "pin", PinocchioPeer), ("MuJoCo", "mujoco", MujocoPeer)):
        try:
            peers.append(kind(kernels, tree))
        except ImportError:
            notes.append(f"{title} is left out: it is not installed (pip install {package}).")
        else:
            notes += peers[-1].notes
    return peers, notes
