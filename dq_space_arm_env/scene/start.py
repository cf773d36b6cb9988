"""Start of an episode: nominal state, target and masses of the scene, or draws from its spread."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.algebra.quaternion import multiply
from dq_space_arm_env.algebra.scalars import select
from dq_space_arm_env.algebra.vectors import dot, matrix_vector, transposed_matrix_vector
from dq_space_arm_env.scene.actuator_chains import chains
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import previous_controls
from dq_space_arm_env.scene.maneuver import Spread
from dq_space_arm_env.scene.motion import ScrewMotion, Tumbling
from dq_space_arm_env.scene.parameters import (
    CATCH,
    Number,
    drawn_factors,
    grasp_numbers,
    has_grasp,
    has_grasp_spread,
    has_target_spread,
    has_velocity_spread,
    inertia_paths,
    is_part,
    parameters,
    target_entries,
    target_numbers,
    velocity_entries,
    velocity_numbers,
    wheel_names,
)
from dq_space_arm_env.scene.path import first_velocity
from dq_space_arm_env.scene.phases import phase_scene
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST, Pose
from dq_space_arm_env.scene.schema import Scene

Array = NDArray[np.float64]

_Z = (0.0, 0.0, 1.0)

Scalar = Any


@dataclass(frozen=True)
class EpisodeStart:
    """Draws of an episode, over plain scalars: numbers, arrays, or symbols."""

    state: list[Scalar]
    drawn: dict[str, Scalar]  # parameters by name


def is_planar(scene: Scene) -> bool:
    """Tell whether the base only moves in its x-y plane."""
    return scene.base.motion == "planar"


def free_axes(scene: Scene) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Axes about which the base turns, and along which it moves."""
    return ((2,), (0, 1)) if is_planar(scene) else ((0, 1, 2), (0, 1, 2))


def unit_quaternions(scene: Scene) -> list[slice]:
    """Find where the quaternions of spherical joints are.

    Args:
        scene: A scene.

    Returns:
        Slices of its state, of 4 numbers each.
    """
    start, found = (len(PLANAR_POSE) if is_planar(scene) else 8), list[slice]()
    for link in scene.links:
        if link.is_spherical:
            found.append(slice(start, start + 4))
        start += len(link.coordinates)
    return found


def initial_state(scene: Scene) -> Array:
    """Nominal state, shape (n_x,); the sign of the base quaternion puts q_{G/I} near q_{D/I}."""
    return start_from_draws(scene, np.zeros(number_of_draws(scene)))


def draw_initial_state(scene: Scene, rng: np.random.Generator) -> Array:
    """Draw a state, shape (n_x,), uniformly around the nominal one, within the scene's spread."""
    return start_from_draws(scene, rng.uniform(-1.0, 1.0, number_of_draws(scene)))


def number_of_draws(scene: Scene) -> int:
    """Count the random numbers that a start takes: all of the state, and whatever else has a spread."""
    turning, moving = free_axes(scene)
    start = scene.initial_state
    base = len(turning) + len(moving)
    states = 2 * base + 2 * len(start.joint_angles) + len(start.wrist_angles)
    drawn = [has_target_spread(scene), has_velocity_spread(scene), has_grasp_spread(scene)]
    wheels = len(wheel_names(scene)) if scene.spread.wheel_speeds else 0
    return states + base * sum(drawn) + sum(1 for _ in drawn_factors(scene)) + wheels


def start_from_draws(scene: Scene, draws: Array) -> Array:
    """Turn draws, (number_of_draws,) or (B, number_of_draws), into states, (n_x,) or (B, n_x)."""
    # Columns of a batch are arrays, single draws plain floats.
    columns = list(np.transpose(draws)) if np.ndim(draws) == 2 else np.asarray(draws).tolist()
    entries = (np.asarray(entry, dtype=np.float64) for entry in episode_start(scene, columns).state)
    return np.stack(np.broadcast_arrays(*entries), axis=-1)


def episode_start(scene: Scene, draws: Sequence[Scalar]) -> EpisodeStart:
    """Turn draws in [-1, 1] into state and drawn parameters.

    The draws come in this order, components in the order of the state, also where the spread is zero: base
    rotation vector (in base axes: q_{e0/I} = nominal * exp), base position (in inertial axes), joint angles
    (of spherical joints rotation vectors in the link's axes, likewise), wrist angles, angular and linear
    velocity of the base, joint rates; then, where there is a spread: rotation vector of the target (in its
    axes) and its position (in inertial axes), mass and inertia of the base, masses of the links, inertias of
    the links, mass and inertia of the payload, angular and linear velocity of the target, rotation vector and
    position of the grasp frame, speeds of the wheels. A planar base, and its target, turn about z and move in
    x and y only.
    """
    start, spread, around = scene.initial_state, scene.spread, _Draws(scene, draws)
    turning, moving = around.axes
    joints, angles = range(len(start.joint_angles)), range(len(start.wrist_angles))
    rotation, position = around.pose(start.base_pose, spread.base_rotation, spread.base_position)
    turns = around([0.0] * len(joints), spread.joint_angles, joints)
    joint_angles = _coordinates(scene, start.joint_angles, turns)
    wrist_angles = around(start.wrist_angles, spread.wrist_angles, angles)
    angular = around(start.base_velocity[:3], spread.base_angular_velocity, turning)
    linear = around(start.base_velocity[3:], spread.base_linear_velocity, moving)
    joint_rates: Sequence[Scalar] = around(start.joint_rates, spread.joint_rates, joints)
    grasp, drawn = _drawn_goal(scene, around)
    # q and -q are one pose, but the cost |q_{G/I} - q_{D/I}|^2 sees two: the base quaternion gets the sign
    # for which the real part of q_{G/I} has a non-negative product with that of q_{D/I}.
    tip = multiply(rotation, _tip_rotation(scene, joint_angles, wrist_angles))
    alignment = sum(a * b for a, b in zip(tip, grasp, strict=True))
    sign = select(alignment < 0.0, -1.0, 1.0)
    pose = [sign * entry for entry in poses.from_rotation_and_position(rotation, position)]
    velocity = angular + linear
    if is_planar(scene):
        pose = [pose[index] for index in PLANAR_POSE]
        velocity = [velocity[index] for index in PLANAR_TWIST]
    wheels, speeds = scene.actuators.wheels or (), list(start.wheel_speeds or [0.0] * len(wheel_names(scene)))
    if spread.wheel_speeds:
        speeds = around(speeds, spread.wheel_speeds, range(len(wheels)))
    momenta = [
        w.inertia * (speed + dot(w.unit_axis, angular)) for w, speed in zip(wheels, speeds, strict=True)
    ]
    previous = start.previous_controls or (0.0,) * len(previous_controls(scene))
    # Elastic gears start unstrained: their motors stand and move as the joints do.
    turned = [scene.links[index] for index, _ in freedoms(scene.links)]
    as_joints = [angle for angle, link in zip(joint_angles, scene.links, strict=True) if link.is_elastic]
    motors = [angle for (angle,) in as_joints]
    motors += [rate for rate, link in zip(joint_rates, turned, strict=True) if link.is_elastic]
    on_the_way = [0.0 for chain in chains(scene) for _ in chain.names]
    propellant = [] if scene.actuators.tank is None else [scene.actuators.tank.propellant]
    rates = [*velocity, *joint_rates, *motors, *momenta, *propellant]
    coordinates = [entry for joint in joint_angles for entry in joint]
    state = [*pose, *coordinates, *wrist_angles, *rates, *previous, *on_the_way]
    return EpisodeStart(state, drawn)


class _Draws:
    """Numbers in [-1, 1], spread out around nominal values one after another."""

    def __init__(self, scene: Scene, draws: Sequence[Scalar]) -> None:
        self.axes = free_axes(scene)
        self._left = iter(draws)

    def __call__(
        self, nominal: Sequence[float], half_width: float, components: Sequence[int]
    ) -> list[Scalar]:
        """Values of which some components are spread out."""
        values: list[Scalar] = list(nominal)
        for index in components:
            values[index] = values[index] + half_width * next(self._left)
        return values

    def pose(
        self, nominal: Pose, half_angle: float, half_width: float
    ) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """Rotation and position: turned by a rotation vector, and moved."""
        turning, moving = self.axes
        turned = rotations.exponential(self((0.0, 0.0, 0.0), half_angle, turning))
        position = self(nominal.position, half_width, moving)
        return multiply(nominal.rotation, turned), position


def _drawn_goal(scene: Scene, around: _Draws) -> tuple[Sequence[Scalar], dict[str, Scalar]]:
    """Rotation of q_{D/I}, and drawn parameters by name: target, masses, velocity of the target, grasp."""
    spread = scene.spread
    target: Sequence[Scalar] = scene.target.pose.dual_quaternion
    drawn: dict[str, Scalar] = {}

    def around_pose(nominal: Pose, half_angle: float, half_width: float) -> tuple[Scalar, ...]:
        return tuple(poses.from_rotation_and_position(*around.pose(nominal, half_angle, half_width)))

    if has_target_spread(scene):
        target = around_pose(scene.target.pose, spread.target_rotation, spread.target_position)
        drawn |= {number.name: target[index] for number, index in _indexed_target(scene)}
    for half_width, numbers in drawn_factors(scene):
        (factor,) = around((1.0,), half_width, (0,))
        drawn |= {number.name: factor * number.nominal for number in numbers}
    motion = scene.target.motion
    if isinstance(motion, ScrewMotion | Tumbling):
        turning_rate: Sequence[Scalar] = motion.angular_velocity
        speed: Sequence[Scalar] = motion.linear_velocity
        if has_velocity_spread(scene):
            turning, moving = around.axes
            turning_rate = around(turning_rate, spread.target_angular_velocity, turning)
            speed = around(speed, spread.target_linear_velocity, moving)
        if isinstance(motion, Tumbling):  # its velocity is given in inertial axes
            speed = transposed_matrix_vector(rotations.to_matrix(target[:4]), speed)
        twist = (*turning_rate, *speed)
        drawn |= {number.name: twist[index] for number, index in _indexed_velocity(scene)}
    at_rest = scene.staged.resting[0] if scene.phases else None  # where the first phase has it
    if at_rest is not None and (motion is not None or not has_target_spread(scene)):
        target = at_rest
    grasp: Sequence[Scalar] = scene.target.grasp.dual_quaternion
    if has_grasp_spread(scene):
        grasp = around_pose(scene.target.grasp, spread.grasp_rotation, spread.grasp_position)
        drawn |= {number.name: grasp[index] for number, index in _indexed_grasp(scene)}
    rotation = target[:4]
    return (multiply(rotation, grasp[:4]) if has_grasp(scene) else rotation), drawn


def parameter_values(scene: Scene, start: EpisodeStart) -> list[Scalar]:
    """All parameters at a start, (n_p,): drawn ones, and the others' nominal values."""
    return [start.drawn.get(number.name, number.nominal) for number in parameters(scene)]


def episode_scene(scene: Scene, values: Sequence[float]) -> Scene:
    """The scene in which the parameters, (n_p,), are constants; SceneError for what no scene may have."""
    changes: dict[str, Any] = {"spread": Spread(), "parameters": ()}
    target, places = list(scene.target.pose.dual_quaternion), dict(_indexed_target(scene))
    grasp, grasp_places = list(scene.target.grasp.dual_quaternion), dict(_indexed_grasp(scene))
    twist = list(first_velocity(scene))
    velocity_places = dict(_indexed_velocity(scene))
    staged = scene.staged.values if scene.phases else {}
    for number, value in zip(parameters(scene), values, strict=True):
        if number.name in staged or is_part(number.name, CATCH):
            continue  # the phases stay
        if number in places:
            target[places[number]] = float(value)
            changes["target.pose"] = {"dual_quaternion": target}
        elif number in grasp_places:
            grasp[grasp_places[number]] = float(value)
            changes["target.grasp"] = {"dual_quaternion": grasp}
        elif number in velocity_places:
            twist[velocity_places[number]] = float(value)
        changes |= dict.fromkeys(number.paths, float(value))
        if is_planar(scene) and number.name.endswith(".inertia.zz"):  # the rest of the inertia in proportion
            place = number.name.removesuffix(".inertia.zz")
            changes |= {
                path: float(value) / number.nominal * entry for path, entry in inertia_paths(scene, place)
            }
    motion = scene.target.motion
    if isinstance(motion, ScrewMotion | Tumbling):
        linear = twist[3:]
        if isinstance(motion, Tumbling):
            linear = list(matrix_vector(rotations.to_matrix(target[:4]), linear))
        changes["target.motion"] = motion.model_dump() | {
            "angular_velocity": twist[:3],
            "linear_velocity": linear,
        }
    if "target.pose" in changes:
        changes["phases"] = list(_resting_where_they_did(scene))
    return scene.replace(changes)


def _resting_where_they_did(scene: Scene) -> Iterator[dict[str, Any]]:
    """The phases; those whose target rests give its whole pose, which the scene's own would complete."""
    for phase in scene.phases:
        own, given = phase_scene(scene, phase)[0].target, phase.model_dump()
        if scene.target.motion is not None and own.motion is None:
            pose = {f"target.pose.{name}": value for name, value in own.pose.model_dump().items()}
            others = {name: value for name, value in phase.changes if not is_part(name, "target.pose")}
            given["changes"] = others | pose
        yield given


def _indexed_target(scene: Scene) -> Iterator[tuple[Number, int]]:
    """The numbers of the target with their indices in the dual quaternion."""
    return zip(target_numbers(scene), target_entries(scene), strict=True)


def _indexed_grasp(scene: Scene) -> Iterator[tuple[Number, int]]:
    """Likewise of the grasp frame."""
    return zip(grasp_numbers(scene), target_entries(scene) if has_grasp(scene) else (), strict=True)


def _indexed_velocity(scene: Scene) -> Iterator[tuple[Number, int]]:
    """The numbers of the target's velocity with their indices in the twist."""
    moves = scene.target.motion is not None
    return zip(velocity_numbers(scene), velocity_entries(scene) if moves else (), strict=True)


def _coordinates(scene: Scene, nominal: Sequence[float], turns: Sequence[Scalar]) -> list[list[Scalar]]:
    """Coordinates of each joint from its nominal ones and how far it is from there, degree by degree.

    Of a spherical joint both are rotation vectors; of q and -q, one rotation, it gets the one with q_0 >= 0.
    """
    given, found = iter(zip(nominal, turns, strict=True)), list[list[Scalar]]()
    for link in scene.links:
        own = [next(given) for _ in range(link.freedoms)]
        if link.is_spherical:
            start, turned = (rotations.exponential(vector) for vector in zip(*own, strict=True))
            rotation = multiply(start, turned)
            sign = select(rotation[0] < 0.0, -1.0, 1.0)
            found.append([sign * entry for entry in rotation])
        else:
            found.append([value + turn for value, turn in own])
    return found


def _tip_rotation(
    scene: Scene, joint_angles: Sequence[Sequence[Any]], wrist_angles: Sequence[Any]
) -> Sequence[Any]:
    """Rotation of q_{G/e0}: real parts of eq. (27), without the base."""
    q: Sequence[Any] = (1.0, 0.0, 0.0, 0.0)
    way, body = list[int](), scene.tip_body
    while body:
        way.insert(0, body - 1)
        body = scene.parent_bodies[body - 1]
    for link, coordinates in ((scene.links[index], joint_angles[index]) for index in way):
        q = multiply(q, link.joint.rotation)
        if link.is_spherical:
            q = multiply(q, coordinates)
        elif link.turns and not link.is_fixed:
            q = multiply(q, rotations.from_axis_angle(_Z, coordinates[0]))
    if scene.wrist:
        psi, theta, phi = wrist_angles
        q = multiply(multiply(q, scene.wrist.frame.rotation), rotations.from_euler_321(psi, theta, phi))
    return multiply(q, scene.tip.rotation)
