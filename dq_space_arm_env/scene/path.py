"""Path of the target's body through an episode: pose q_{T/I} and velocity in body axes, stage by stage.

The target moves without us: its path is data, no state. A target on a screw or tumbling is advanced from
stage to stage by the same equations everywhere (`advanced`); waypoints are interpolated once (`given_path`).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, rotations, screw
from dq_space_arm_env.algebra.vectors import (
    add,
    cross,
    matrix_vector,
    scale,
    subtract,
    transposed_matrix_vector,
)
from dq_space_arm_env.scene.motion import ScrewMotion, Tumbling, Waypoints
from dq_space_arm_env.scene.pose import Matrix3

Scene = Any  # `schema.Scene`, whose parameters are found by this file
Scalar = Any
Scalars = Sequence[Scalar]
Array = NDArray[np.float64]

PATH = 14
"""Numbers of pose and velocity."""


def first_velocity(scene: Scene) -> tuple[float, ...]:
    """Velocity of the body at the start in its own axes, angular then linear, rad/s and m/s."""
    target, motion = scene.target, scene.target.motion
    if isinstance(motion, Waypoints):
        return tuple(given_path(scene, 0)[0, 8:].tolist())
    if isinstance(motion, Tumbling):
        linear = transposed_matrix_vector(rotations.to_matrix(target.pose.rotation), motion.linear_velocity)
        return (*motion.angular_velocity, *linear)
    if isinstance(motion, ScrewMotion):
        return (*motion.angular_velocity, *motion.linear_velocity)
    return (0.0,) * 6


def advanced(
    motion: ScrewMotion | Tumbling, pose: Scalars, velocity: Scalars, h: Scalar
) -> tuple[Scalars, Scalars]:
    """Pose and velocity of the body after h seconds, from those before; over plain scalars."""
    if isinstance(motion, ScrewMotion):
        return dq.multiply(pose, screw.exponential(dual_vectors.scale(h, velocity))), velocity
    vector, angular = _turned(motion.inertia, velocity[:3], h)
    turn = rotations.exponential(vector)
    # First it moves, in its present axes, then it turns.
    moved = dq.multiply(pose, (1.0, 0.0, 0.0, 0.0, 0.0, *scale(0.5 * h, velocity[3:])))
    linear = transposed_matrix_vector(rotations.to_matrix(turn), velocity[3:])
    return dq.multiply(moved, (*turn, 0.0, 0.0, 0.0, 0.0)), (*angular, *linear)


def _turned(inertia: Matrix3, angular: Scalars, h: Scalar) -> tuple[Scalars, Scalars]:
    """Rotation vector and angular velocity of a free rigid body after h seconds, to fourth order.

    Runge and Kutta's method for Euler's equations, J w' = J w x w; Magnus' expansion by Hermite's rule,
    phi = h (w_0 + w_1) / 2 + h^2 (w_0' - w_1' + w_0 x w_1) / 12.
    """
    inverse = np.linalg.inv(np.array(inertia)).tolist()

    def rate(w: Scalars) -> Scalars:
        return matrix_vector(inverse, cross(matrix_vector(inertia, w), w))

    slopes = [rate(angular)]
    for share in (0.5, 0.5, 1.0):
        slopes.append(rate(add(angular, scale(share * h, slopes[-1]))))
    first, second, third, fourth = slopes
    rise = add(add(first, fourth), scale(2.0, add(second, third)))
    after = add(angular, scale(h / 6.0, rise))
    bend = add(subtract(first, rate(after)), cross(angular, after))
    return add(scale(0.5 * h, add(angular, after)), scale(h * h / 12.0, bend)), after


def shown_target(scene: Scene) -> tuple[Array, Array | None]:
    """Poses of a scene's target for pictures, without compiled code, equal to the machine code's to rounding.

    Returns q_{D/I}, and the pose of the target's body where that differs: shape (8,), or (steps + 1, 8) where
    it moves or phases move it.
    """
    target, motion = scene.target, scene.target.motion
    body = np.array(target.pose.dual_quaternion) if motion is None else _body_path(scene)
    if scene.phases and (motion is not None or len(set(scene.staged.resting)) > 1):
        body = np.array(np.broadcast_to(body, (scene.simulation.steps + 1, 8)))
        starts, resting = scene.staged.starts, scene.staged.resting
        for begin, end, pose in zip(starts, (*starts[1:], None), resting, strict=True):
            if pose is not None:
                body[begin:end] = pose
    if target.grasp.dual_quaternion == dq.IDENTITY:
        return body, None
    return np.stack(dq.multiply(tuple(body.T), target.grasp.dual_quaternion), axis=-1), body


def _body_path(scene: Scene) -> Array:
    """Poses of the body at all stages, shape (steps + 1, 8)."""
    steps, dt, motion = scene.simulation.steps, scene.simulation.dt, scene.target.motion
    pose: Scalars = scene.target.pose.dual_quaternion
    if isinstance(motion, Waypoints):
        return np.stack(dq.multiply(pose, tuple(given_path(scene, steps)[:, :8].T)), axis=1)
    velocity: Scalars = first_velocity(scene)
    if isinstance(motion, ScrewMotion):
        return np.stack(advanced(motion, pose, velocity, dt * np.arange(steps + 1))[0], axis=1)
    path = [pose]
    for _ in range(steps):
        pose, velocity = advanced(motion, pose, velocity, dt)
        path.append(pose)
    return np.array(path)


def given_path(scene: Scene, steps: int) -> Array:
    """Pose relative to that at the start, and velocity, of a body that passes waypoints.

    Between two waypoints the twist is constant (ScLERP), before the first and after the last it is zero. The
    sign of the quaternion is carried along by continuity.

    Returns numbers at the stages 0 to `steps`, shape (steps + 1, 14).
    """
    points = scene.target.motion.points
    known = np.array([point.time for point in points])
    pose = np.array([point.pose.dual_quaternion for point in points]).T
    if len(points) > 1:
        overlaps = np.sum(pose[:4, 1:] * pose[:4, :-1], axis=0)
        pose[:, 1:] *= np.cumprod(np.where(overlaps < 0.0, -1.0, 1.0))
    durations = np.diff(known, append=known[-1] + 1.0)
    following = np.concatenate([pose[:, 1:], pose[:, -1:]], axis=1)
    ways = np.array(screw.logarithm(dq.multiply(dq.conjugate(tuple(pose)), tuple(following)))) / durations
    times = scene.simulation.dt * np.arange(steps + 1)
    near = 1e-9 * scene.simulation.dt  # the last pose is passed, not rested at
    index = np.clip(np.searchsorted(known, times + near, side="right") - 1, 0, max(len(points) - 2, 0))
    inside = (times > known[0] - near) & (times < known[-1] + near)
    velocity = np.where(inside, ways[:, index], 0.0)
    elapsed = np.clip(times, known[0], known[-1]) - known[index]
    moved = screw.exponential(dual_vectors.scale(elapsed, tuple(ways[:, index])))
    path = dq.multiply(tuple(pose[:, index]), tuple(np.broadcast_to(each, times.shape) for each in moved))
    path = dq.multiply(dq.conjugate([each[0] for each in path]), path)
    return np.concatenate([np.stack(path), velocity]).T
