"""Where an episode starts: the scene's nominal state, or one drawn from its spread."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.algebra.quaternion import multiply
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
    return start_from_draws(scene, rng.uniform(-1.0, 1.0, number_of_draws(scene)))


def number_of_draws(scene: Scene) -> int:
    """Tell how many random numbers a start takes.

    Args:
        scene: A validated scene.

    Returns:
        The number; the same whatever the spread.
    """
    turning, moving = free_axes(scene)
    start = scene.initial_state
    base = len(turning) + len(moving)
    return 2 * base + 2 * len(start.joint_angles) + len(start.wrist_angles)


def start_from_draws(scene: Scene, draws: Array) -> Array:
    """Turn random numbers into starts.

    Args:
        scene: A validated scene.
        draws: Numbers in [-1, 1] in the order of `draw_initial_state`, shape (number_of_draws,) or
            (B, number_of_draws).

    Returns:
        States, shape (n_x,) or (B, n_x), units of the state.
    """
    start, spread = scene.initial_state, scene.spread
    turning, moving = free_axes(scene)
    columns = iter(np.atleast_2d(draws).T)

    def spread_out(nominal: Sequence[float], half_width: float, components: Sequence[int]) -> list[Any]:
        values: list[Any] = list(nominal)
        for index in components:
            values[index] = values[index] + half_width * next(columns)
        return values

    joints, angles = range(len(start.joint_angles)), range(len(start.wrist_angles))
    rotation_vector = spread_out((0.0, 0.0, 0.0), spread.base_rotation, turning)
    rotation = multiply(start.base_pose.rotation, rotations.exponential(rotation_vector))
    x, y, z = spread_out(start.base_pose.position, spread.base_position, moving)
    joint_angles = spread_out(start.joint_angles, spread.joint_angles, joints)
    wrist_angles = spread_out(start.wrist_angles, spread.wrist_angles, angles)
    angular = spread_out(start.base_velocity[:3], spread.base_angular_velocity, turning)
    linear = spread_out(start.base_velocity[3:], spread.base_linear_velocity, moving)
    joint_rates = spread_out(start.joint_rates, spread.joint_rates, joints)
    states = _assemble(scene, rotation, (x, y, z), joint_angles, wrist_angles, angular + linear, joint_rates)
    return states if np.ndim(draws) == 2 else states[0]


def _assemble(
    scene: Scene,
    rotation: Sequence[Any],
    position: Sequence[Any],
    joint_angles: Sequence[Any],
    wrist_angles: Sequence[Any],
    base_velocity: Sequence[Any],
    joint_rates: Sequence[Any],
) -> Array:
    """Put states together and apply the sign rule; components are numbers or arrays (B,).

    q and -q are one pose, but the cost |q_{G/I} - q_{D/I}|^2 sees two: the base quaternion gets the sign for
    which the real part of q_{G/I} has a non-negative product with that of q_{D/I}.
    """
    tip = multiply(rotation, _tip_rotation(scene, joint_angles, wrist_angles))
    alignment = sum(a * b for a, b in zip(tip, scene.target.pose.rotation, strict=True))
    sign = np.where(np.less(alignment, 0.0), -1.0, 1.0)
    pose = [sign * entry for entry in poses.from_rotation_and_position(rotation, position)]
    if is_planar(scene):
        pose = [pose[index] for index in PLANAR_POSE]
        base_velocity = [base_velocity[index] for index in PLANAR_TWIST]
    entries = [*pose, *joint_angles, *wrist_angles, *base_velocity, *joint_rates]
    return np.stack(np.broadcast_arrays(*(np.asarray(entry, dtype=np.float64) for entry in entries)), axis=-1)


def _tip_rotation(scene: Scene, joint_angles: Sequence[Any], wrist_angles: Sequence[Any]) -> Sequence[Any]:
    """Rotation of q_{G/e0}: the real parts of (27), without the base."""
    q: Sequence[Any] = (1.0, 0.0, 0.0, 0.0)
    for link, angle in zip(scene.links, joint_angles, strict=True):
        q = multiply(multiply(q, link.joint.rotation), rotations.from_axis_angle(_Z, angle))
    if scene.wrist:
        psi, theta, phi = wrist_angles
        q = multiply(multiply(q, scene.wrist.frame.rotation), rotations.from_euler_321(psi, theta, phi))
    return multiply(q, scene.tip.rotation)
