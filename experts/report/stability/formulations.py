"""The accelerations of a state by every formulation of the dynamics that there is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.algebra.vectors import add, cross
from dq_space_arm_env.dynamics import kinematics, minimal, newton_euler
from dq_space_arm_env.dynamics.chain import Chain
from experts.problem import FloatArray
from experts.report.stability.references import Motion
from experts.report.throughput.pinocchio_peer import PinocchioPeer


@dataclass(frozen=True, eq=False)
class Sample:
    """A robot, a state, and inputs.

    Attributes:
        scene: Its scene, whose base is spatial and has actuators for force and torque.
        kernels: Its compiled functions.
        chain: Its constants.
        state: Shape (n_x,), units of `kernels.layout.state`.
        control: Shape (n_u,), units of `kernels.layout.control`.
    """

    scene: Scene
    kernels: Kernels
    chain: Chain
    state: FloatArray
    control: FloatArray

    @classmethod
    def of(cls, scene: Scene, state: FloatArray, control: FloatArray) -> Sample:
        """Collect what belongs to a scene."""
        return cls(scene, compile_scene(scene), Chain.from_scene(scene), state, control)

    @property
    def motion(self) -> Motion:
        """State and inputs by name."""
        where, inputs = self.kernels.layout.state, self.kernels.layout.control
        return Motion(
            joint_angles=self.state[where.joint_angles],
            angular=self.state[where.angular_velocity],
            linear=self.state[where.linear_velocity],
            joint_rates=self.state[where.joint_rates],
            force=self.control[inputs.base_force],
            torque=self.control[inputs.base_torque],
            joint_torques=self.control[inputs.joint_torque],
        )


def _compiled(sample: Sample, **simulation: str) -> FloatArray:
    changed = sample.scene.replace(simulation={**sample.scene.simulation.model_dump(), **simulation})
    found = compile_scene(changed).forward_dynamics(sample.state, sample.control)
    return np.asarray(found, dtype=np.float64)


def _system(sample: Sample) -> tuple[newton_euler.NewtonEulerSystem, newton_euler.JointFrames]:
    chain, motion = sample.chain, sample.motion
    angles, rates = motion.joint_angles.tolist(), motion.joint_rates.tolist()
    rotations = minimal.joint_rotations(chain, angles)
    twist = (*motion.angular.tolist(), *motion.linear.tolist())
    velocities = kinematics.body_velocities(chain, rotations, twist, rates)
    bodies = [chain.base, *(link.body for link in chain.links)]
    duals = [
        (0.0, *v.angular, 0.0, *add(v.linear, cross(v.angular, body.center_of_mass)))
        for body, v in zip(bodies, velocities, strict=True)
    ]
    passive = minimal.passive_torques(chain, angles, rates)
    torques = [a + b for a, b in zip(motion.joint_torques.tolist(), passive, strict=True)]
    wrench = (0.0, *motion.force.tolist(), 0.0, *motion.torque.tolist())
    frames = newton_euler.joint_frames(chain, angles, [0.0] * 3)
    return newton_euler.assemble(chain, frames, duals, wrench, torques), frames


def _from_duals(sample: Sample, frames: newton_euler.JointFrames, duals: FloatArray) -> FloatArray:
    bodies = [tuple(body) for body in duals.reshape(-1, 8).tolist()]
    joints = [newton_euler.joint_velocity(frames, j, bodies)[3] for j in range(len(sample.chain.links))]
    return np.array([*bodies[0][1:4], *bodies[0][5:8], *joints])


def _schur(sample: Sample, refinements: int = 0) -> FloatArray:
    system, frames = _system(sample)
    accelerations, _ = newton_euler.solve_schur(sample.chain, system, refinements)
    return _from_duals(sample, frames, np.array(accelerations))


def _dense(sample: Sample) -> FloatArray:
    system, frames = _system(sample)
    count, reactions = len(system.b1), len(system.b2)
    full = np.zeros((count + reactions, count + reactions))
    full[:count, :count], full[:count, count:], full[count:, :count] = system.s11, system.s12, system.s21
    solution = np.linalg.solve(full, np.array([*system.b1, *system.b2]))
    return _from_duals(sample, frames, solution[:count])


def _pinocchio(sample: Sample) -> FloatArray:
    peer = PinocchioPeer(sample.kernels, sample.chain)
    return np.asarray(peer.accelerations(sample.state[None], sample.control[None])[0])


ARTICULATED = "articulated body"
SINGLE = "articulated body, float32"
MINIMAL = "minimal coordinates"
MINIMAL_SINGLE = "minimal coordinates, float32"
SCHUR = "Schur complement (21)-(22)"
REFINED = "Schur complement, refined"
DENSE = "47x47 system (20)"
PINOCCHIO = "articulated body, Pinocchio"

FORMULATIONS: dict[str, Callable[[Sample], FloatArray]] = {
    ARTICULATED: partial(_compiled, formulation="articulated_body"),
    SINGLE: partial(_compiled, formulation="articulated_body", precision="float32"),
    MINIMAL: partial(_compiled, formulation="minimal_coordinates"),
    MINIMAL_SINGLE: partial(_compiled, formulation="minimal_coordinates", precision="float32"),
    SCHUR: _schur,
    REFINED: partial(_schur, refinements=1),
    DENSE: _dense,
}
"""Accelerations by each formulation: base angular [rad/s^2], linear [m/s^2], joints [rad/s^2], (6 + n,)."""

if find_spec("pinocchio") is not None:
    FORMULATIONS[PINOCCHIO] = _pinocchio
