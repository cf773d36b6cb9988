"""Accelerations and reaction wrenches with 50 digits from a scene's own numbers: bodies cut free, one system.

Newton and Euler for each body in the base's axes at the instant, and for each joint the accelerations that it
forbids: one linear system for the accelerations of all bodies and the reactions of all joints. A payload is a
body of its own on a joint that lets nothing move. It shares no recursion, no elimination and no frames with
the code under test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mpmath
import numpy as np
from mpmath import mpf

from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.peers.robot import beyond_rigid_bodies
from scripts.benchmarks.stability.references import DIGITS, Matrix, Sample, Vector, column, skew, turn


class Solution(NamedTuple):
    """Motion and reactions of an instant."""

    accelerations: FloatArray  # as of `Kernels.forward_dynamics`, shape (6 + n,); (3 + n) for a planar base
    reactions: FloatArray  # force [N], torque [N m] of each joint on its link, joint axes, shape (n, 6)


@dataclass
class _Body:
    """A body cut free, all vectors in the base's axes."""

    mass: Any
    inertia: Matrix  # about the center of mass
    center: Vector  # of mass
    omega: Vector
    force: Vector  # from outside
    torque: Vector  # from outside, about the center of mass


@dataclass
class _Joint:
    """A joint between two bodies: its number is that of the other one, less 1."""

    before: int  # body that carries it
    axes: Matrix  # of the joint frame, column by column
    origin: Vector
    rate: Any  # about the z axis, rad/s; 0 where nothing moves
    torque: Any  # about the z axis, N m; None where nothing moves


def free_bodies(sample: Sample) -> Solution:
    """Solve for the accelerations of base and joints and for the reactions of the joints.

    Raises:
        ValueError: If the scene has what these do not know: Pinocchio is the reference of that.
    """
    if unknown := beyond_rigid_bodies(sample.scene):
        raise ValueError(f"scene {sample.scene.name!r} has {unknown[0]}, which these bodies do not know")
    with mpmath.workdps(DIGITS):
        bodies, joints = _cut_free(sample)
        return _solved(sample, bodies, joints)


def _rotation(quaternion: Sequence[float]) -> Matrix:
    """Rotation matrix w^2 E + v v' + 2 w [v] + [v]^2 of a quaternion (w, v), normalized."""
    q = column(quaternion)
    q /= mpmath.norm(q)
    v, across = q[1:4, 0], skew(q[1:4, 0])
    return q[0] ** 2 * mpmath.eye(3) + v * v.T + 2 * q[0] * across + across * across


def _body(given: Any, axes: Matrix, origin: Vector, omega: Vector) -> _Body:
    """Place the base, a link or the payload of a scene."""
    inertia = axes * mpmath.matrix(list(given.inertia)) * axes.T
    center = origin + axes * column(getattr(given, "center_of_mass", (0.0, 0.0, 0.0)))
    return _Body(mpf(given.mass), inertia, center, omega, mpmath.zeros(3, 1), mpmath.zeros(3, 1))


def _cut_free(sample: Sample) -> tuple[list[_Body], list[_Joint]]:
    scene, motion, layout = sample.scene, sample.motion, sample.kernels.layout
    planar, actuated = layout.planar, dict(zip(layout.actuated_joints, motion.joint_torques, strict=True))
    axes, origin = mpmath.eye(3), mpmath.zeros(3, 1)
    omega = column([0.0, 0.0, *motion.angular] if planar else motion.angular)
    bodies, joints = [_body(scene.base, axes, origin, omega)], list[_Joint]()
    for axis, value in zip((0, 1) if planar else (0, 1, 2), motion.force, strict=False):
        bodies[0].force[axis] = mpf(value)
    for axis, value in zip((2,) if planar else (0, 1, 2), motion.torque, strict=False):
        bodies[0].torque[axis] = mpf(value)
    placed = [(axes, origin, omega)]
    for index, (link, parent) in enumerate(zip(scene.links, scene.parent_bodies, strict=True)):
        angle, rate = mpf(motion.joint_angles[index]), mpf(motion.joint_rates[index])
        axes, origin, omega = placed[parent]
        origin = origin + axes * column(link.joint.position)
        axes = axes * _rotation(link.joint.rotation) * turn(2, angle)
        omega = omega + axes[:, 2] * rate
        torque = mpf(actuated.get(index, 0.0)) - mpf(link.damping) * rate
        torque -= mpf(link.stiffness) * (angle - mpf(link.rest_angle))
        joints.append(_Joint(parent, axes, origin, rate, torque))
        placed.append((axes, origin, omega))
        bodies.append(_body(link, axes, origin, omega))
    axes, origin, omega = placed[scene.tip_body]
    if scene.wrist is not None:
        psi, theta, phi = sample.state[layout.state.wrist_angles]
        origin = origin + axes * column(scene.wrist.frame.position)
        axes = axes * _rotation(scene.wrist.frame.rotation) * turn(2, psi) * turn(1, theta) * turn(0, phi)
    origin, axes = origin + axes * column(scene.tip.position), axes * _rotation(scene.tip.rotation)
    if scene.tip_wrench is not None:
        force = axes * column(scene.tip_wrench.force)
        body = bodies[scene.tip_body]
        body.force += force
        body.torque += axes * column(scene.tip_wrench.torque) + skew(origin - body.center) * force
    if scene.payload is not None:
        joints.append(_Joint(scene.tip_body, axes, origin, mpf(0), None))
        bodies.append(_body(scene.payload, axes, origin, omega))
    return bodies, joints


def _solved(sample: Sample, bodies: list[_Body], joints: list[_Joint]) -> Solution:
    """Assemble and solve: six equations and unknowns per body, as many per joint as it transmits."""
    sizes = [6 if joint.torque is None else 5 for joint in joints]
    starts = [6 * len(bodies) + sum(sizes[:i]) for i in range(len(joints) + 1)]
    matrix, right = mpmath.zeros(starts[-1]), mpmath.zeros(starts[-1], 1)
    for i, body in enumerate(bodies):
        # m a = f, J alpha = tau - omega x J omega, about the center of mass.
        _add(matrix, 6 * i, 6 * i, body.mass * mpmath.eye(3))
        _add(matrix, 6 * i + 3, 6 * i + 3, body.inertia)
        _add(right, 6 * i, 0, body.force)
        _add(right, 6 * i + 3, 0, body.torque - skew(body.omega) * (body.inertia * body.omega))
    for i, joint in enumerate(joints):
        rows = starts[i]
        for j, sign in ((joint.before, -1), (i + 1, 1)):
            body, lever = bodies[j], joint.origin - bodies[j].center
            # Forces at the joint's origin and torques, about its axes; the last torque is the motor's.
            wrenches = mpmath.zeros(6)
            _add(wrenches, 0, 0, joint.axes)
            _add(wrenches, 3, 0, skew(lever) * joint.axes)
            _add(wrenches, 3, 3, joint.axes)
            _add(matrix, 6 * j, rows, -sign * wrenches[:, : sizes[i]])
            # Along what a joint transmits, the body before it and the one after it accelerate alike.
            _add(matrix, rows, 6 * j, sign * wrenches[:, : sizes[i]].T)
            _add(right, rows, 0, -sign * joint.axes.T * (skew(body.omega) * (skew(body.omega) * lever)))
            if joint.torque is not None:
                _add(right, 6 * j, 0, sign * joint.torque * wrenches[:, 5])
        turning = joint.axes.T * (skew(bodies[joint.before].omega) * (joint.axes[:, 2] * joint.rate))
        _add(right, rows + 3, 0, turning[: sizes[i] - 3, 0])
    solution = mpmath.lu_solve(matrix, right)
    return _named(sample, bodies, joints, solution, starts)


def _add(matrix: Matrix, row: int, at: int, block: Matrix) -> None:
    for i in range(block.rows):
        for j in range(block.cols):
            matrix[row + i, at + j] += block[i, j]


def _named(
    sample: Sample, bodies: list[_Body], joints: list[_Joint], solution: Vector, starts: list[int]
) -> Solution:
    planar, linear = sample.kernels.layout.planar, sample.motion.linear
    turning = skew(bodies[0].omega) * column([*linear, 0.0] if planar else linear)
    base = [*solution[3:6, 0], *(solution[:3, 0] - turning)]
    found, reactions = [base[i] for i in ((2, 3, 4) if planar else range(6))], []
    for i, joint in enumerate(joints):
        if joint.torque is None:
            continue
        z = joint.axes[:, 2]
        j, k = joint.before, i + 1
        relative = solution[6 * k + 3 : 6 * k + 6, 0] - solution[6 * j + 3 : 6 * j + 6, 0]
        found.append((z.T * (relative - skew(bodies[j].omega) * (z * joint.rate)))[0])
        reactions.append([*solution[starts[i] : starts[i] + 5, 0], joint.torque])
    as_floats = [[float(entry) for entry in row] for row in reactions]
    return Solution(np.array([float(entry) for entry in found]), np.array(as_floats).reshape(-1, 6))
