"""What an episode starts from: the scene's nominal state, target and masses, or draws from its spread."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.algebra.quaternion import multiply
from dq_space_arm_env.algebra.scalars import select
from dq_space_arm_env.scene.bodies import Base, Link, Payload
from dq_space_arm_env.scene.schema import Scene

Array = NDArray[np.float64]

# What a planar base keeps of its pose (q_r0, q_r3, q_d1, q_d2) and of its velocity (omega_z, v_x, v_y).
PLANAR_POSE = (0, 3, 5, 6)
PLANAR_TWIST = (2, 3, 4)

_Z = (0.0, 0.0, 1.0)

Scalar = Any


@dataclass(frozen=True)
class MassFactors:
    """What masses and inertias of the bodies are multiplied by; the inertias are those about centers of mass.

    Attributes:
        base_mass: Of the base.
        base_inertia: Of the base.
        link_masses: Of the links, base to tip.
        link_inertias: Of the links, base to tip.
        payload_mass: Of the payload; 1 without one.
        payload_inertia: Of the payload; 1 without one.
    """

    base_mass: Scalar
    base_inertia: Scalar
    link_masses: tuple[Scalar, ...]
    link_inertias: tuple[Scalar, ...]
    payload_mass: Scalar = 1.0
    payload_inertia: Scalar = 1.0


@dataclass(frozen=True)
class EpisodeStart:
    """What is drawn for an episode, over plain scalars: numbers, arrays, or symbols.

    Attributes:
        state: Initial state, n_x entries, units of the state.
        target: Pose q_{D/I} of the target, 8 numbers.
        masses: Factors of masses and inertias.
    """

    state: list[Scalar]
    target: tuple[Scalar, ...]
    masses: MassFactors


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
    return start_from_draws(scene, np.zeros(number_of_draws(scene)))


def draw_initial_state(scene: Scene, rng: np.random.Generator) -> Array:
    """Draw a start: every component uniform around the nominal one, within the scene's spread.

    Args:
        scene: A validated scene.
        rng: Source of random numbers.

    Returns:
        State, shape (n_x,), units of the state; the same sign rule as in `initial_state`.
    """
    return start_from_draws(scene, rng.uniform(-1.0, 1.0, number_of_draws(scene)))


def number_of_draws(scene: Scene) -> int:
    """Tell how many random numbers an episode's start takes.

    Args:
        scene: A validated scene.

    Returns:
        The number. It does not depend on how wide the spread of states is; of target, masses and inertias
        only what has a spread takes any.
    """
    turning, moving = free_axes(scene)
    start, spread = scene.initial_state, scene.spread
    base = len(turning) + len(moving)
    states = 2 * base + 2 * len(start.joint_angles) + len(start.wrist_angles)
    bodies = (spread.base_mass, spread.base_inertia, spread.payload_mass, spread.payload_inertia)
    links = (spread.link_masses, spread.link_inertias)
    masses = sum(width > 0 for width in bodies) + len(scene.links) * sum(width > 0 for width in links)
    return states + (base if has_target_spread(scene) else 0) + masses


def has_target_spread(scene: Scene) -> bool:
    """Tell whether the target is drawn for each episode.

    Args:
        scene: A validated scene.

    Returns:
        True if it has a spread.
    """
    return bool(scene.spread.target_rotation or scene.spread.target_position)


def target_entries(scene: Scene) -> tuple[int, ...]:
    """Tell which of the target's eight numbers may differ from episode to episode.

    Args:
        scene: A validated scene.

    Returns:
        Their indices: none without a spread of the target, otherwise all that are not zero for every pose.
    """
    if not has_target_spread(scene):
        return ()
    return PLANAR_POSE if is_planar(scene) else tuple(range(8))


def start_from_draws(scene: Scene, draws: Array) -> Array:
    """Turn random numbers into initial states.

    Args:
        scene: A validated scene.
        draws: Numbers in [-1, 1] in the order of `episode_start`, shape (number_of_draws,) or
            (B, number_of_draws).

    Returns:
        States, shape (n_x,) or (B, n_x), units of the state.
    """
    # Columns of a batch are arrays, single draws plain floats.
    columns = list(np.transpose(draws)) if np.ndim(draws) == 2 else np.asarray(draws).tolist()
    entries = (np.asarray(entry, dtype=np.float64) for entry in episode_start(scene, columns).state)
    return np.stack(np.broadcast_arrays(*entries), axis=-1)


def episode_start(scene: Scene, draws: Sequence[Scalar]) -> EpisodeStart:
    """Turn random numbers into what an episode starts from.

    The draws come in this order, components in the order of the state, also where the spread is zero: base
    rotation vector (in base axes: q_{e0/I} = nominal * exp), base position (in inertial axes), joint angles,
    wrist angles, angular and linear velocity of the base, joint rates; then, where there is a spread:
    rotation vector of the target (in its axes) and its position (in inertial axes), mass and inertia of the
    base, masses of the links, inertias of the links, mass and inertia of the payload. A planar base, and its
    target, turn about z and move in x and y only.

    Args:
        scene: A validated scene.
        draws: Numbers in [-1, 1], number_of_draws scalars.

    Returns:
        State, target and masses.
    """
    start, spread = scene.initial_state, scene.spread
    turning, moving = free_axes(scene)
    columns = iter(draws)

    def spread_out(nominal: Sequence[float], half_width: float, components: Sequence[int]) -> list[Scalar]:
        values: list[Scalar] = list(nominal)
        for index in components:
            values[index] = values[index] + half_width * next(columns)
        return values

    joints, angles = range(len(start.joint_angles)), range(len(start.wrist_angles))
    rotation_vector = spread_out((0.0, 0.0, 0.0), spread.base_rotation, turning)
    rotation = multiply(start.base_pose.rotation, rotations.exponential(rotation_vector))
    position = spread_out(start.base_pose.position, spread.base_position, moving)
    joint_angles = spread_out(start.joint_angles, spread.joint_angles, joints)
    wrist_angles = spread_out(start.wrist_angles, spread.wrist_angles, angles)
    angular = spread_out(start.base_velocity[:3], spread.base_angular_velocity, turning)
    linear = spread_out(start.base_velocity[3:], spread.base_linear_velocity, moving)
    joint_rates = spread_out(start.joint_rates, spread.joint_rates, joints)
    target = scene.target.pose.dual_quaternion
    if has_target_spread(scene):
        turned = rotations.exponential(spread_out((0.0, 0.0, 0.0), spread.target_rotation, turning))
        moved = spread_out(scene.target.pose.position, spread.target_position, moving)
        target_rotation = multiply(scene.target.pose.rotation, turned)
        target = tuple(poses.from_rotation_and_position(target_rotation, moved))
    # q and -q are one pose, but the cost |q_{G/I} - q_{D/I}|^2 sees two: the base quaternion gets the sign
    # for which the real part of q_{G/I} has a non-negative product with that of q_{D/I}.
    tip = multiply(rotation, _tip_rotation(scene, joint_angles, wrist_angles))
    alignment = sum(a * b for a, b in zip(tip, target[:4], strict=True))
    sign = select(alignment < 0.0, -1.0, 1.0)
    pose = [sign * entry for entry in poses.from_rotation_and_position(rotation, position)]
    velocity = angular + linear
    if is_planar(scene):
        pose = [pose[index] for index in PLANAR_POSE]
        velocity = [velocity[index] for index in PLANAR_TWIST]
    state = [*pose, *joint_angles, *wrist_angles, *velocity, *joint_rates]
    return EpisodeStart(state, target, _drawn_masses(scene, columns))


def _drawn_masses(scene: Scene, draws: Iterator[Scalar]) -> MassFactors:
    spread = scene.spread

    def factor(half_width: float) -> Scalar:
        return 1.0 + half_width * next(draws) if half_width else 1.0

    return MassFactors(
        base_mass=factor(spread.base_mass),
        base_inertia=factor(spread.base_inertia),
        link_masses=tuple(factor(spread.link_masses) for _ in scene.links),
        link_inertias=tuple(factor(spread.link_inertias) for _ in scene.links),
        payload_mass=factor(spread.payload_mass),
        payload_inertia=factor(spread.payload_inertia),
    )


def episode_scene(scene: Scene, draws: Sequence[float], target: Sequence[float] | None = None) -> Scene:
    """Write what an episode starts from as a scene of its own, in which nothing is left to chance.

    Args:
        scene: A validated scene.
        draws: Numbers in [-1, 1] in the order of `episode_start`, number_of_draws of them.
        target: Pose q_{D/I} in place of the drawn one, 8 numbers.

    Returns:
        The scene with the drawn target, masses and inertias, and without a spread. Its initial state stays
        the nominal one: the drawn state is what `start_from_draws` gives.
    """
    start = episode_start(scene, list(draws))
    masses = start.masses
    changes: dict[str, Any] = {
        "spread": {},
        "base": _scaled(scene.base, masses.base_mass, masses.base_inertia),
        "links": [
            _scaled(link, mass, inertia)
            for link, mass, inertia in zip(scene.links, masses.link_masses, masses.link_inertias, strict=True)
        ],
    }
    if scene.payload is not None:
        changes["payload"] = _scaled(scene.payload, masses.payload_mass, masses.payload_inertia)
    if has_target_spread(scene):
        pose = {"dual_quaternion": start.target if target is None else target}
        changes["target"] = {"pose": pose, "base_velocity": scene.target.base_velocity}
    return scene.replace(**changes)


def _scaled(body: Base | Link | Payload, mass: float, inertia: float) -> dict[str, Any]:
    """Fields of a body with mass and inertia multiplied."""
    rows = tuple(tuple(inertia * entry for entry in row) for row in body.inertia)
    return {**body.model_dump(), "mass": mass * body.mass, "inertia": rows}


def _tip_rotation(scene: Scene, joint_angles: Sequence[Any], wrist_angles: Sequence[Any]) -> Sequence[Any]:
    """Rotation of q_{G/e0}: the real parts of (27), without the base."""
    q: Sequence[Any] = (1.0, 0.0, 0.0, 0.0)
    for link, angle in zip(scene.links, joint_angles, strict=True):
        q = multiply(multiply(q, link.joint.rotation), rotations.from_axis_angle(_Z, angle))
    if scene.wrist:
        psi, theta, phi = wrist_angles
        q = multiply(multiply(q, scene.wrist.frame.rotation), rotations.from_euler_321(psi, theta, phi))
    return multiply(q, scene.tip.rotation)
