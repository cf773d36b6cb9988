"""The part of a flight that can be shown, and the frames of the robot during it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.scene.pose import PLANAR_POSE
from dq_space_arm_env.scene.start import unit_quaternions
from dq_space_arm_env.task.step_report import STATE_LIMIT
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.constraint_shapes import violations
from dq_space_arm_env.viewing.payload_places import payload_path

FloatArray = NDArray[np.float64]
MOST_FLIGHTS = 6
"""Flights on one page: as many as there are colors that everybody can tell apart."""

_LARGEST_INPUT = 1e30  # larger ones have blown up, and exceed the page's single precision
_UNIT = 1e-3  # within which the real part of a pose has length 1


@dataclass(frozen=True, eq=False)
class ShownFlight:
    """The part of a flight that can be shown: M of its steps."""

    label: str
    controls: FloatArray  # commanded, shape (M, n_u), N, N m or rad/s
    noise: FloatArray | None  # added to it at the actuators, same shape and units; None for none
    acting: FloatArray  # what the actuators make of both, same shape and units
    # Desired pose of the tip q_{D/I}, and pose of the target's body, None if that is the same; one that moves
    # has a pose for each state, with signs that make them continuous in time.
    target: FloatArray  # shape (8,) or (M + 1, 8)
    target_body: FloatArray | None  # shape (8,) or (M + 1, 8)
    payload: FloatArray | None  # pose of its frame, None at the tip; shape (8,) or (M + 1, 8), signs likewise
    # Poses of base, joint frames, wrist frame (if any) and tip, with signs that make them continuous in time.
    frames: FloatArray  # shape (M + 1, frames, 8), dimensionless and m
    angle: FloatArray  # Euler angle of the tip's attitude error, shape (M + 1,), deg
    distance: FloatArray  # from tip to target, shape (M + 1,), m
    note: str  # why it is cut off; empty if it is not
    is_success: bool | None  # as flown; None if unknown
    violated: NDArray[np.bool_]  # whether rows of constraints are, shape (rows, M + 1)
    dt: float  # time step, s
    stride: int = 1  # of the flight's own steps in one of these

    @property
    def steps(self) -> int:
        """Number of steps M."""
        return len(self.controls)


def prepare(flights: Sequence[Trajectory], scene: Scene) -> list[ShownFlight]:
    """Check flights, and compute their frames and errors.

    A diverged flight is cut off where its numbers are no longer finite or too large to draw.
    """
    if not flights:
        raise ValueError("there is no flight to show: give at least one")
    if len(flights) > MOST_FLIGHTS:
        raise ValueError(f"{len(flights)} flights, should be at most {MOST_FLIGHTS} on one page")
    layout = StateLayout.of(scene)
    return [_prepare(flight, scene, layout) for flight in flights]


def aimed(flight: Trajectory, scene: Scene) -> Trajectory:
    """Give a flight that names no target the nominal one of a scene; ValueError if it goes on beyond that."""
    if flight.target is not None:
        return flight
    steps = len(np.asarray(flight.states)) - 1
    target, body = target_during(scene, steps)
    if target.ndim == 2 and len(target) <= steps:
        raise ValueError(
            f"flight {flight.label!r} has {steps} steps, the scene {scene.name!r} knows where its target is "
            f"for {len(target) - 1}: give the flight a target of its own, one pose for each of {steps + 1} "
            "states"
        )
    body = body if flight.target_body is None else flight.target_body
    return replace(flight, target=target, target_body=body)


def _prepare(flight: Trajectory, scene: Scene, layout: StateLayout) -> ShownFlight:
    what = f"flight {flight.label!r}"
    if not flight.label.strip():
        raise ValueError("a flight has no label: give it one")
    states = _matrix(f"{what}: states", flight.states, (None, layout.n_x))
    if len(states) < 2:
        raise ValueError(f"{what}: states: {len(states)} rows, should be at least 2: nothing moves")
    steps = len(states) - 1
    controls = _matrix(f"{what}: controls", flight.controls, (steps, layout.n_u))
    noise = None if flight.noise is None else _matrix(f"{what}: noise", flight.noise, (steps, layout.n_u))
    shown = _finite_steps(states, controls, noise)
    if shown < 1:
        raise ValueError(f"{what}: its first step is not finite or has blown up: there is nothing to show")
    for part in (_real_part(layout), *unit_quaternions(scene)):
        lengths = np.linalg.norm(states[: shown + 1, part], axis=1)
        if (np.abs(lengths - 1.0) > _UNIT).any():
            worst = lengths[np.abs(lengths - 1.0).argmax()]
            raise ValueError(
                f"{what}: states: entries {part.start} to {part.stop - 1} have length {worst:.4g}, should "
                "have 1: they are a rotation"
            )
    flight = aimed(flight, scene)
    given, body = flight.target, flight.target_body
    assert given is not None
    target = _target(f"{what}: target", given, steps, shown)
    frames = _continuous(frame_poses(scene, layout, states[: shown + 1]))
    payload = flight.payload
    if payload is not None:
        payload = _target(f"{what}: payload", payload, steps, shown)
    elif (path := payload_path(flight.scene or scene, frames[:, -1], target)) is not None:
        payload = _target(f"{what}: payload", path, shown, shown)
    seconds = shown * scene.simulation.dt
    body = None if body is None else _target(f"{what}: target_body", body, steps, shown)
    angle, distance = tip_errors(flight.scene or scene, frames, target, body)
    own = flight.scene or scene
    given_inputs = controls[:shown] if noise is None else controls[:shown] + noise[:shown]
    acting = _acting(own, states[:shown], given_inputs)
    # The page has one list of constraints; limits and targets are the flight's.
    charged = own.replace(constraints=scene.constraints) if own.constraints != scene.constraints else own
    placed = charged, states[: shown + 1], acting, target if body is None else body, target
    return ShownFlight(
        label=flight.label,
        controls=controls[:shown],
        noise=None if noise is None else noise[:shown],
        acting=acting,
        target=target,
        target_body=body,
        payload=payload,
        frames=frames,
        angle=np.degrees(angle),
        distance=distance,
        note="" if shown == steps else f"diverges after {seconds:.4g} s",
        is_success=None if np.isnan(flight.attitude_error) else flight.is_success,
        violated=violations(*placed) if scene.constraints else np.zeros((0, shown + 1), np.bool_),
        dt=scene.simulation.dt,
    )


def _acting(scene: Scene, states: FloatArray, inputs: FloatArray) -> FloatArray:
    """Inputs as the actuators of a scene apply them, (M, n_u), at states, (M, n_x)."""
    if not scene.constraints and scene.actuators.thrusters is None:
        return inputs  # neither a row nor a jet shows them
    # Compiled code is loaded, or made, for actuators that are not ideal alone.
    from dq_space_arm_env.kernels import compile_scene
    from dq_space_arm_env.task.actuator_limits import are_ideal

    if are_ideal(scene):
        return inputs
    kernels = compile_scene(scene)
    stages = np.minimum(np.arange(len(inputs)), scene.simulation.steps)
    return np.asarray(kernels.applied_inputs(states, inputs, p=kernels.stage_parameters()[stages]))


def frame_poses(scene: Scene, layout: StateLayout, states: FloatArray) -> FloatArray:
    """Frames of the robot, eq. (27), for states (M, n_x); shape (M, frames, 8); without compiled code."""
    entries = layout.state
    base = np.zeros((8, len(states)))
    stored = list(PLANAR_POSE) if layout.planar else list(range(8))
    base[stored] = states[:, entries.pose].T
    joints, wrist = tuple(states[:, entries.joint_angles].T), tuple(states[:, entries.wrist_angles].T)
    tree = KinematicTree.from_scene(scene)
    frames = kinematics.frame_poses(tree, tuple(base), tree.coordinates(joints), wrist)
    return np.stack([np.stack(frame, axis=1) for frame in frames], axis=1)


def tip_errors(
    scene: Scene, frames: FloatArray, target: FloatArray, body: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Errors of the tips from their goals, of each instant the worst tip's.

    Args:
        scene: The scene.
        frames: Poses of the robot's frames, shape (M, frames, 8), m.
        target: q_{D/I}, shape (8,), or (M, 8) where it moves, m.
        body: Pose of the target's body, likewise; None if it is the target's.

    Returns:
        Angles, rad, and distances, m, shape (M,) each.
    """
    first = 1 + len(scene.links)
    aims = [(frames[:, -1], tuple(target.T))]
    for index, tip in enumerate(scene.other_tips):
        goal: tuple[Any, ...] = tip.goal.dual_quaternion
        if tip.relative_to == "target":
            goal = dual_quaternion.multiply(tuple((target if body is None else body).T), goal)
        aims.append((frames[:, first + index], goal))
    pairs = [(tuple(tip.T), goal) for tip, goal in aims]
    angles = [np.asarray(poses.error_angle(*pair)) for pair in pairs]
    distances = [np.asarray(poses.error_distance(*pair)) for pair in pairs]
    return np.max(angles, axis=0), np.max(distances, axis=0)


def target_during(scene: Scene, steps: int) -> tuple[FloatArray, FloatArray | None]:
    """A scene's target and the target's body, None if that is the same, during a number of steps.

    Each of shape (8,), or (steps + 1, 8) where it moves.
    """
    target, body = (
        each[: steps + 1] if each is not None and each.ndim == 2 else each for each in shown_target(scene)
    )
    assert target is not None
    return target, body


def poses_at(target: FloatArray, instants: NDArray[np.intp]) -> FloatArray:
    """Poses of a target, (8,) or (M + 1, 8), at some instants, shape (instants, 8)."""
    return target[instants] if target.ndim == 2 else np.tile(target, (len(instants), 1))


def _continuous(frames: FloatArray) -> FloatArray:
    """Signs of q, of which both mean one pose, such that neighbors in time are near: the page blends them."""
    overlaps = np.sum(frames[1:, :, :4] * frames[:-1, :, :4], axis=2)
    signs = np.cumprod(np.where(overlaps < 0.0, -1.0, 1.0), axis=0)
    result = frames.copy()
    result[1:] *= signs[:, :, None]
    return result


def _finite_steps(states: FloatArray, controls: FloatArray, noise: FloatArray | None) -> int:
    """Number of steps before the first that is not finite or has blown up."""
    with np.errstate(over="ignore", invalid="ignore"):
        good_states = np.linalg.norm(states, axis=1) <= STATE_LIMIT  # false for NaN
    good = good_states[:-1] & good_states[1:]
    for inputs in (controls, noise):
        if inputs is not None:
            good &= (np.abs(inputs) <= _LARGEST_INPUT).all(axis=1)
    return len(good) if good.all() else int(np.argmin(good))


def _target(what: str, value: ArrayLike, steps: int, shown: int) -> FloatArray:
    """Check a target, and keep what is shown of it: (8,) if it is at rest there, else (shown + 1, 8)."""
    target = _numbers(what, value)
    said = f"{what}: {target if target.ndim == 1 else f'array of shape {target.shape}'}, should be a pose"
    if target.shape not in ((8,), (steps + 1, 8)) or not np.isfinite(target).all():
        raise ValueError(f"{said}, 8 finite numbers, or one for each of {steps + 1} states")
    if (np.abs(np.linalg.norm(target[..., :4], axis=-1) - 1.0) > _UNIT).any():
        raise ValueError(f"{said}: its real part should have length 1")
    if target.ndim == 1:
        return target
    moving = _continuous(target[: shown + 1, None])[:, 0]
    return moving[0] if (moving == moving[0]).all() else moving


def _real_part(layout: StateLayout) -> slice:
    """Entries of the real part of the base's pose in a state."""
    pose = layout.state.pose
    return slice(pose.start, (pose.start + pose.stop) // 2)


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    try:
        return np.array(real_array("values", value, np.float64))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: should be numbers ({error})") from error


def _matrix(name: str, value: ArrayLike, shape: tuple[int | None, int]) -> FloatArray:
    array = _numbers(name, value)
    rows, columns = shape
    if array.ndim != 2 or array.shape[1] != columns or rows not in (None, array.shape[0]):
        wanted = "N + 1" if rows is None else str(rows)
        raise ValueError(f"{name}: shape {array.shape}, should be ({wanted}, {columns})")
    return array


def verdict(flight: ShownFlight, scene: Scene) -> str:
    """Describe the end of a flight in a phrase."""
    angle, distance = float(flight.angle[-1]), float(flight.distance[-1])
    place = f"{_rounded(angle)}° and {_length(distance)} from the target"
    thin = f"; one in {flight.stride} steps shown" if flight.stride > 1 else ""
    if flight.note:
        return f"{flight.note}, {place}{thin}"
    within = angle <= scene.success.attitude_error_deg and distance <= scene.success.position_error
    reached = flight.is_success
    if reached is None:  # a plan, of which the pose is known
        more = np.isfinite(scene.success.tolerances[2:]).any() or any(each.catch for each in scene.phases)
        reached = within and not more
    short = "no success" if flight.is_success is False else "pose within the tolerances"
    end = "success" if reached else short if within else "outside the tolerances"
    return f"ends {place}: {end}{thin}"


def _length(meters: float) -> str:
    if meters >= 1.0:
        return f"{meters:.3g} m" if meters < 999.5 else f"{meters:.0f} m"
    return f"{_rounded(100.0 * meters)} cm" if meters >= 0.01 else f"{_rounded(1000.0 * meters)} mm"


def _rounded(value: float) -> str:
    """Two digits, or all digits before the decimal point."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
