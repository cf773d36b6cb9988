"""Where an episode starts: the scene's nominal state, or one drawn from its spread."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.algebra.quaternion import multiply
from dq_space_arm_env.scene._fields import Three
from dq_space_arm_env.scene.pose import Quaternion
from dq_space_arm_env.scene.schema import Scene

Array = NDArray[np.float64]

# What a planar base keeps of its pose (q_r0, q_r3, q_d1, q_d2) and of its velocity (omega_z, v_x, v_y).
PLANAR_POSE = (0, 3, 5, 6)
PLANAR_TWIST = (2, 3, 4)

_Z = (0.0, 0.0, 1.0)


def is_planar(scene: Scene) -> bool:
    """Tell whether the base moves in its x-y plane only.

    Args:
        scene: A validated scene.

    Returns:
        True for a planar base.
    """
    return scene.base.motion == "planar"


def free_axes(scene: Scene) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Tell about which axes the base turns and along which it moves.

    Args:
        scene: A validated scene.

    Returns:
        Indices of the axes of rotation, and of those of translation: (0, 1, 2) twice, or (2,) and (0, 1).
    """
    return ((2,), (0, 1)) if is_planar(scene) else ((0, 1, 2), (0, 1, 2))


def initial_state(scene: Scene) -> Array:
    """Give the scene's nominal start, the sign of the base quaternion such that q_{G/I} starts near q_{D/I}.

    Args:
        scene: A validated scene.

    Returns:
        State, shape (n_x,), units of the state.
    """
    start = scene.initial_state
    pose = start.base_pose
    return _assemble(
        scene,
        pose.rotation,
        pose.position,
        start.joint_angles,
        start.wrist_angles,
        start.base_velocity,
        start.joint_rates,
    )


def draw_initial_state(scene: Scene, rng: np.random.Generator) -> Array:
    """Draw a start: every component uniform around the nominal one, within the scene's spread.

    The draws come in this order, components in the order of the state, also where the spread is zero: base
    rotation vector (in base axes: q_{e0/I} = nominal * exp), base position (in inertial axes), joint angles,
    wrist angles, angular and linear velocity of the base, joint rates. A planar base draws its rotation about
    z and its motion in x and y only.

    Args:
        scene: A validated scene.
        rng: Source of random numbers.

    Returns:
        State, shape (n_x,), units of the state; the same sign rule as in `initial_state`.
    """
    start, spread = scene.initial_state, scene.spread
    turning, moving = free_axes(scene)

    def draw(nominal: Sequence[float], half_width: float, components: Sequence[int]) -> list[float]:
        values = list(nominal)
        for index, offset in zip(components, rng.uniform(-1.0, 1.0, len(components)).tolist(), strict=True):
            values[index] += half_width * offset
        return values

    joints, angles = range(len(start.joint_angles)), range(len(start.wrist_angles))
    rotation_vector = draw((0.0, 0.0, 0.0), spread.base_rotation, turning)
    rotation = multiply(start.base_pose.rotation, rotations.exponential(rotation_vector))
    x, y, z = draw(start.base_pose.position, spread.base_position, moving)
    joint_angles = draw(start.joint_angles, spread.joint_angles, joints)
    wrist_angles = draw(start.wrist_angles, spread.wrist_angles, angles)
    angular = draw(start.base_velocity[:3], spread.base_angular_velocity, turning)
    linear = draw(start.base_velocity[3:], spread.base_linear_velocity, moving)
    joint_rates = draw(start.joint_rates, spread.joint_rates, joints)
    return _assemble(scene, rotation, (x, y, z), joint_angles, wrist_angles, angular + linear, joint_rates)


def _assemble(
    scene: Scene,
    rotation: Quaternion,
    position: Three,
    joint_angles: Sequence[float],
    wrist_angles: Sequence[float],
    base_velocity: Sequence[float],
    joint_rates: Sequence[float],
) -> Array:
    """Put a state together and apply the sign rule.

    q and -q are one pose, but the cost |q_{G/I} - q_{D/I}|^2 sees two: the base quaternion gets the sign for
    which the real part of q_{G/I} has a non-negative product with that of q_{D/I}.
    """
    tip = multiply(rotation, _tip_rotation(scene, joint_angles, wrist_angles))
    if sum(a * b for a, b in zip(tip, scene.target.pose.rotation, strict=True)) < 0:
        w, x, y, z = rotation
        rotation = (-w, -x, -y, -z)
    pose: Sequence[float] = poses.from_rotation_and_position(rotation, position)
    if is_planar(scene):
        pose = [pose[index] for index in PLANAR_POSE]
        base_velocity = [base_velocity[index] for index in PLANAR_TWIST]
    return np.array([*pose, *joint_angles, *wrist_angles, *base_velocity, *joint_rates], dtype=np.float64)


def _tip_rotation(scene: Scene, joint_angles: Sequence[float], wrist_angles: Sequence[float]) -> Quaternion:
    """Rotation of q_{G/e0}: the real parts of (27), without the base."""
    q: Quaternion = (1.0, 0.0, 0.0, 0.0)
    for link, angle in zip(scene.links, joint_angles, strict=True):
        q = multiply(multiply(q, link.joint.rotation), rotations.from_axis_angle(_Z, angle))
    if scene.wrist:
        psi, theta, phi = wrist_angles
        q = multiply(multiply(q, scene.wrist.frame.rotation), rotations.from_euler_321(psi, theta, phi))
    return multiply(q, scene.tip.rotation)
