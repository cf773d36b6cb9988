"""Forward dynamics with 50 digits, and by every formulation of the dynamics in working precision.

The mass matrix and the bias forces of the reference are those of Kane's equations: each body's Newton-Euler
equation projected on the Jacobian of its motion. It shares no recursion and no elimination with the code
under test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import mpmath
import numpy as np
from mpmath import mpf

from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.algebra.vectors import add, cross
from dq_space_arm_env.dynamics import kinematics, minimal, newton_euler
from dq_space_arm_env.dynamics.kinematic_tree import JointedLink, KinematicTree
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer

DIGITS = 50

Matrix = Any  # an mpmath matrix
Vector = Any  # an mpmath matrix with one column


class Motion(NamedTuple):
    """The parts of state and inputs that accelerations depend on."""

    joint_angles: FloatArray  # shape (n,), rad
    angular: FloatArray  # angular velocity of the base, base axes, shape (3,), rad/s
    linear: FloatArray  # velocity of the base, base axes, shape (3,), m/s
    joint_rates: FloatArray  # shape (n,), rad/s
    force: FloatArray  # on the base, base axes, shape (3,), N
    torque: FloatArray  # on the base, base axes, shape (3,), N m
    joint_torques: FloatArray  # of the motors, shape (n,), N m


class LinearSystem(NamedTuple):
    """M a = f for the accelerations a: base, angular and inertial linear, and joints; 50 digits."""

    mass_matrix: Matrix
    right: Vector
    sizes: Vector  # sums of the magnitudes of the terms of f


def column(values: Sequence[Any] | FloatArray) -> Vector:
    """A vector of exact numbers."""
    return mpmath.matrix([mpf(value) for value in values])


def _square(rows: Sequence[Sequence[Any]]) -> Matrix:
    return mpmath.matrix([[mpf(entry) for entry in row] for row in rows])


def skew(v: Vector) -> Matrix:
    """The matrix of the vector product with v."""
    return mpmath.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turn(axis: int, angle: Any) -> Matrix:
    """Rotation about a coordinate axis."""
    c, s = mpmath.cos(mpf(angle)), mpmath.sin(mpf(angle))
    matrix = mpmath.eye(3)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix[j, j], matrix[j, k], matrix[k, j], matrix[k, k] = c, -s, s, c
    return matrix


def _cross(a: Vector, b: Vector) -> Vector:
    return skew(a) * b


def _turned(link: JointedLink, angle: float) -> Matrix:
    return _square(link.joint.rotation) * turn(2, angle)


def linear_system(tree: KinematicTree, motion: Motion) -> LinearSystem:
    """Assemble Kane's equations, all vectors in base axes."""
    with mpmath.workdps(DIGITS):
        return _linear_system(tree, motion)


def _linear_system(tree: KinematicTree, motion: Motion) -> LinearSystem:
    n = len(tree.links)
    size = 6 + n
    omega, alpha, a = column(motion.angular), mpmath.zeros(3, 1), mpmath.zeros(3, 1)
    rotation, origin = mpmath.eye(3), mpmath.zeros(3, 1)
    reached = [(omega, alpha, a, rotation, origin)]
    axes: list[Vector] = []
    origins: list[Vector] = []
    mass_matrix, bias, sizes = mpmath.zeros(size), mpmath.zeros(size, 1), mpmath.zeros(size, 1)
    for index in range(n + 1):
        body = tree.bodies[index]
        if index:
            link = tree.links[index - 1]
            omega, alpha, a, rotation, origin = reached[link.parent]
            arm = rotation * column(link.joint.position)
            a = a + _cross(alpha, arm) + _cross(omega, _cross(omega, arm))
            origin = origin + arm
            rotation = rotation * _turned(link, motion.joint_angles[index - 1])
            axis = rotation[:, 2]
            rate = mpf(motion.joint_rates[index - 1])
            alpha = alpha + _cross(omega, axis) * rate
            omega = omega + axis * rate
            axes.append(axis)
            origins.append(origin)
            reached.append((omega, alpha, a, rotation, origin))
        lever = rotation * column(body.center_of_mass)
        center = origin + lever
        turning, moving = mpmath.zeros(3, size), mpmath.zeros(3, size)
        turning[:, 0:3], moving[:, 0:3], moving[:, 3:6] = mpmath.eye(3), -skew(center), mpmath.eye(3)
        for j in tree.path_to(index):
            turning[:, 6 + j], moving[:, 6 + j] = axes[j], _cross(axes[j], center - origins[j])
        mass = mpf(body.mass)
        inertia = rotation * _square(body.inertia) * rotation.T
        force = mass * (a + _cross(alpha, lever) + _cross(omega, _cross(omega, lever)))
        torque = inertia * alpha + _cross(omega, inertia * omega)
        spinning = _absolute(skew(omega))
        force_size = mass * (_absolute(a) + _absolute(skew(alpha)) * _absolute(lever))
        force_size += mass * (spinning * (spinning * _absolute(lever)))
        torque_size = _absolute(inertia) * _absolute(alpha)
        torque_size += spinning * (_absolute(inertia) * _absolute(omega))
        mass_matrix += mass * (moving.T * moving) + turning.T * inertia * turning
        bias += moving.T * force + turning.T * torque
        sizes += _absolute(moving.T) * force_size + _absolute(turning.T) * torque_size
    passive = [
        -mpf(link.stiffness) * (mpf(angle) - mpf(link.rest_angle)) - mpf(link.damping) * mpf(rate)
        for link, angle, rate in zip(tree.links, motion.joint_angles, motion.joint_rates, strict=True)
    ]
    motors = [mpf(value) + other for value, other in zip(motion.joint_torques, passive, strict=True)]
    applied = column([*motion.torque, *motion.force, *motors])
    return LinearSystem(mass_matrix, applied - bias, sizes + _absolute(applied))


def _absolute(matrix: Matrix) -> Matrix:
    return matrix.apply(abs)


def accelerations(system: LinearSystem, motion: Motion) -> FloatArray:
    """Dual acceleration of the base and joint accelerations, solved with 50 digits, shape (6 + n,)."""
    with mpmath.workdps(DIGITS):
        solution = mpmath.lu_solve(system.mass_matrix, system.right)
        turning = _cross(column(motion.angular), column(motion.linear))
        for axis in range(3):
            solution[3 + axis] -= turning[axis]
        return np.array([float(value) for value in solution])


class Errors(NamedTuple):
    """Errors of accelerations."""

    backward: float  # |M a - f| / (|M| |a| + |f|), infinity norms, dimensionless
    by_row: float  # largest by row of |M a - f| / (|M| |a| + |f|) in magnitudes of terms (Oettli & Prager)
    forward: float  # largest error of an acceleration, relative to the largest acceleration, dimensionless


def errors(system: LinearSystem, motion: Motion, found: FloatArray) -> Errors:
    """Errors of a dual acceleration of the base and joint accelerations, shape (6 + n,)."""
    exact = accelerations(system, motion)
    with mpmath.workdps(DIGITS):
        matrix, size = system.mass_matrix, len(found)
        a = column(found)
        turning = _cross(column(motion.angular), column(motion.linear))
        for axis in range(3):
            a[3 + axis] += turning[axis]
        residual = matrix * a - system.right
        scale = mpmath.mnorm(matrix, mpmath.inf) * mpmath.norm(a, mpmath.inf)
        scale += mpmath.norm(system.right, mpmath.inf)
        terms = _absolute(a)
        for axis in range(3):
            terms[3 + axis] = abs(mpf(found[3 + axis])) + abs(turning[axis])
        sizes = _absolute(matrix) * terms + system.sizes
        backward = float(mpmath.norm(residual, mpmath.inf) / scale) if scale else 0.0
        by_row = np.max([float(abs(residual[i]) / sizes[i]) if sizes[i] else 0.0 for i in range(size)])
    largest = float(np.abs(exact).max())
    forward = float(np.abs(found - exact).max()) / largest if largest else 0.0
    return Errors(backward, by_row, forward)


@dataclass(frozen=True, eq=False)
class Sample:
    """A robot, a state, and inputs."""

    scene: Scene
    kernels: Kernels
    tree: KinematicTree
    state: FloatArray
    control: FloatArray

    @classmethod
    def of(cls, scene: Scene, state: FloatArray, control: FloatArray) -> Sample:
        """Collect what belongs to a scene."""
        return cls(scene, compile_scene(scene), KinematicTree.from_scene(scene), state, control)

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
    changed = sample.scene.replace(simulation=simulation)
    found = compile_scene(changed).forward_dynamics(sample.state, sample.control)
    return np.asarray(found, dtype=np.float64)


def _system(sample: Sample) -> tuple[newton_euler.NewtonEulerSystem, newton_euler.JointFrames]:
    tree, motion = sample.tree, sample.motion
    angles, rates = motion.joint_angles.tolist(), motion.joint_rates.tolist()
    link_frames = minimal.link_frames(tree, angles)
    twist = (*motion.angular.tolist(), *motion.linear.tolist())
    velocities = kinematics.body_velocities(tree, link_frames, twist, rates)
    bodies = tree.bodies
    duals = [
        (0.0, *v.angular, 0.0, *add(v.linear, cross(v.angular, body.center_of_mass)))
        for body, v in zip(bodies, velocities, strict=True)
    ]
    passive = minimal.passive_torques(tree, angles, rates)
    torques = [a + b for a, b in zip(motion.joint_torques.tolist(), passive, strict=True)]
    wrench = (0.0, *motion.force.tolist(), 0.0, *motion.torque.tolist())
    frames = newton_euler.joint_frames(tree, angles, [0.0] * 3)
    return newton_euler.assemble(tree, frames, duals, wrench, torques), frames


def _from_duals(sample: Sample, frames: newton_euler.JointFrames, duals: FloatArray) -> FloatArray:
    bodies = [tuple(body) for body in duals.reshape(-1, 8).tolist()]
    joints = newton_euler.along_joints(sample.tree, frames, bodies)
    return np.array([*bodies[0][1:4], *bodies[0][5:8], *joints])


def _schur(sample: Sample, refinements: int = 0) -> FloatArray:
    system, frames = _system(sample)
    accelerations, _ = newton_euler.solve_schur(sample.tree, system, refinements)
    return _from_duals(sample, frames, np.array(accelerations))


def _dense(sample: Sample) -> FloatArray:
    system, frames = _system(sample)
    count, reactions = len(system.b1), len(system.b2)
    full = np.zeros((count + reactions, count + reactions))
    full[:count, :count], full[:count, count:], full[count:, :count] = system.s11, system.s12, system.s21
    solution = np.linalg.solve(full, np.array([*system.b1, *system.b2]))
    return _from_duals(sample, frames, solution[:count])


def _pinocchio(sample: Sample) -> FloatArray:
    peer = PinocchioPeer(sample.kernels, sample.tree)
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
