"""The options of `reset`: initial state, target and parameters given instead of drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import TARGET, VELOCITY, target_entries
from dq_space_arm_env.scene.path import given_path
from dq_space_arm_env.scene.pose import PLANAR_POSE, Pose
from dq_space_arm_env.scene.start import episode_scene, unit_quaternions
from dq_space_arm_env.task.step_report import STATE_LIMIT

Array = NDArray[Any]

_OPTIONS = ("nominal", "initial_state", "target", "parameters", "state")


class GivenStart(NamedTuple):
    """The part of a start that is given, for one episode or for B; None for what is drawn.

    With a state come nominal parameters unless they are given too.
    """

    state: Array | None = None  # shape (n_x,) or (B, n_x), units of the state
    target: Array | None = None  # q_{D/I}, shape (8,) or (B, 8), dimensionless and m
    parameters: Array | None = None  # shape (n_p,) or (B, n_p), units of the parameters

    def apply(self, kernels: Kernels, x: Array, parameters: Array) -> None:
        """Overwrite drawn states, (n_x,) or (B, n_x), and parameters, (n_p,) or (B, n_p), in place."""
        if self.state is not None:
            x[...] = self.state
        if self.parameters is not None:
            parameters[...] = self.parameters
        if self.target is not None:
            where = kernels.parameters.indices(TARGET)
            body = kernels.layout.target_body_below(self.target, parameters)
            parameters[..., where] = body[..., target_entries(kernels.scene)]
        if any(given is not None for given in self):
            _give_sign_of_target(kernels, x, kernels.layout.target_with(parameters))


def checked_options(options: Any) -> dict[str, Any]:
    """The options of a reset as a dictionary, empty without any; ValueError for anything but a mapping."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(
            f"options: {shortened(options)}, should be a mapping from names, such as {{'nominal': True}}"
        )
    return dict(options)


def saved_state(options: dict[str, Any]) -> Any:
    """The option "state", which excludes the others; None without it."""
    state = options.get("state")
    if state is not None and len(options) > 1:
        others = ", ".join(sorted(map(str, set(options) - {"state"})))
        raise ValueError(f"options: state holds the whole episode, it excludes {others}")
    return state


def given_start(kernels: Kernels, options: dict[str, Any]) -> GivenStart:
    """Check the options of `DQSpaceArmEnv.reset`.

    Raises:
        ValueError: If an option is unknown; if nominal is not a bool; if a number is missing or not finite;
            if the pose of the base or the target is not a unit dual quaternion; if the target is too far
            away; if actuators keep what is beyond their limits, or a tank less than nothing; if the scene's
            target is a constant; or if no scene may have the parameters (`SceneError`).
    """
    unknown = set(options) - set(_OPTIONS)
    if unknown:
        raise ValueError(f"options: {sorted(unknown, key=str)} unknown; choose from {', '.join(_OPTIONS)}")
    state, target, parameters = (options.get(name) for name in ("initial_state", "target", "parameters"))
    nominal = options.get("nominal")
    if not isinstance(nominal, bool | np.bool_ | None):
        raise ValueError(f"options: nominal {shortened(nominal)}, should be True or False")
    if parameters is not None:
        parameters = _checked_parameters(kernels, parameters)
    if state is not None:
        if nominal:
            raise ValueError("options: nominal and initial_state exclude each other")
        state = _checked_state(kernels, state)
        _check_actuators(kernels, state, parameters)
    elif nominal:
        state = kernels.layout.initial_state
    return GivenStart(state, None if target is None else _checked_target(kernels, target), parameters)


def _checked_state(kernels: Kernels, state: Any) -> Array:
    """A state with the rounding errors of its base pose, and of spherical joints' quaternions, removed."""
    x = _finite("initial_state", state, kernels.n_x)
    where = kernels.layout.state.pose
    stored = list(PLANAR_POSE) if kernels.layout.planar else list(range(8))
    pose = np.zeros(8)
    pose[stored] = x[where]
    x[where] = _unit_pose("initial_state has a base pose", pose)[stored]
    for where in unit_quaternions(kernels.scene):
        length = math.hypot(*x[where])
        if abs(length - 1.0) > 1e-6:
            raise ValueError(
                f"options: initial_state has a spherical joint with |q| = {length:.9g} (entries "
                f"{where.start} to {where.stop - 1}); a unit quaternion has 1"
            )
        x[where] /= length
    check_size("options: initial_state", x)
    return x


def _check_actuators(kernels: Kernels, x: Array, parameters: Array | None) -> None:
    """Raise ValueError for a state in which actuators keep more than their limits, or a tank less than 0."""
    layout, entries = kernels.layout, range(kernels.n_x)
    most = layout.control_limit
    if parameters is not None:
        most = np.maximum(most, layout.limits_with(parameters))
    least = layout.lower_limits(most)
    kept = _kept_controls(layout)
    where = [*entries[layout.state.actuators], *entries[layout.state.drives]]
    bounds = [*zip(where, least[kept], most[kept], strict=True)]
    bounds += [(index, 0.0, math.inf) for index in entries[layout.state.propellant]]
    for index, low, high in bounds:
        rounding = 1e-6 * (high if high < math.inf else 1.0)
        if not low - rounding <= x[index] <= high + rounding:
            allowed = f"from {low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
            raise ValueError(
                f"options: initial_state has {layout.state.names[index]} = {x[index]:g} (entry {index}), "
                f"should be {allowed}"
            )


def check_size(name: str, state: Array) -> None:
    """Raise ValueError for a state, (n_x,), so large that it counts as diverged."""
    size = math.hypot(*state.tolist())
    if size > STATE_LIMIT:
        raise ValueError(
            f"{name} has a norm of {size:.3g}, should be at most {STATE_LIMIT:g}, beyond which a simulation "
            "counts as diverged; positions are small if the origin is near the spacecraft"
        )


def check_scene(scene: Scene) -> None:
    """Raise ValueError for a scene whose starts may count as diverged, or whose tip is beyond observation."""
    layout, spread = StateLayout.of(scene), scene.spread
    check_size(f"scene {scene.name!r}: initial_state", layout.initial_state)
    start = math.hypot(*layout.initial_state.tolist())
    # The dual part is half the position.
    widths = {
        "base_position": 0.5 * math.sqrt(3.0) * spread.base_position,
        "joint_angles": math.sqrt(layout.n_joints) * spread.joint_angles,
        "wrist_angles": math.sqrt(3.0) * spread.wrist_angles,
        "base_angular_velocity": math.sqrt(3.0) * spread.base_angular_velocity,
        "base_linear_velocity": math.sqrt(3.0) * spread.base_linear_velocity,
        "joint_rates": math.sqrt(layout.n_joints) * spread.joint_rates,
    }
    name, width = max(widths.items(), key=lambda each: each[1])
    if start + math.hypot(*widths.values()) > STATE_LIMIT:
        raise ValueError(
            f"scene {scene.name!r}: spread.{name} = {getattr(spread, name):g}: starts may have a norm of "
            f"{start + width:.3g}, should be at most {STATE_LIMIT:g}, beyond which a simulation counts as "
            "diverged"
        )
    kept = _kept_controls(layout)
    most = math.hypot(*layout.control_limit[kept].tolist())
    if math.hypot(start, most) > STATE_LIMIT:
        largest = kept[int(layout.control_limit[kept].argmax())]
        raise ValueError(
            f"scene {scene.name!r}: {layout.control.limits[largest]} = {layout.control_limit[largest]:g}: "
            f"what lags, is late or limited in its rate is in the state, here up to {most:.3g}; the norm of "
            f"a state should be at most {STATE_LIMIT:g}, beyond which a simulation counts as diverged"
        )
    _check_lengths(scene)


def _kept_controls(layout: StateLayout) -> list[int]:
    """The controls of the entries `actuators`, then `drives`, of the state."""
    return [*layout.previous_controls, *(chain.control for chain in layout.chains for _ in chain.names)]


def _check_lengths(scene: Scene) -> None:
    """Raise ValueError for a scene whose tip may be so far from the target that no observation holds it."""
    spread = scene.spread
    lengths = {
        f"links[{index}].joint.position": link.joint.position for index, link in enumerate(scene.links)
    }
    if scene.wrist is not None:
        lengths["wrist.frame.position"] = scene.wrist.frame.position
    lengths["tip.position"] = scene.tip.position
    for index, tip in enumerate(scene.other_tips):
        lengths[f"other_tips[{index}].frame.position"] = tip.frame.position
        lengths[f"other_tips[{index}].goal.position"] = tip.goal.position
    sizes = {name: math.hypot(*position) for name, position in lengths.items()}
    where, distance = max(_target_distances(scene), key=lambda each: each[1])
    sizes[where] = distance
    sizes["spread.target_position"] = math.sqrt(3.0) * spread.target_position
    if scene.target.grasp != Pose() or spread.grasp_position:
        grasp = math.hypot(*scene.target.grasp.position) + math.sqrt(3.0) * spread.grasp_position
        sizes["target.grasp.position"] = 2.0 * grasp  # it turns with the body
    if scene.target.motion is not None:
        sizes["target.motion"] = _target_way(scene)
    if sum(sizes.values()) > STATE_LIMIT:
        name, size = max(sizes.items(), key=lambda each: each[1])
        raise ValueError(
            f"scene {scene.name!r}: {name}: {size:.3g} m; lengths of the arm and distance of the target "
            f"should add up to at most {STATE_LIMIT:g} m, for observations to hold them"
        )


def _target_distances(scene: Scene) -> Iterator[tuple[str, float]]:
    """Distances of the target's poses from the origin, m: at the start, and at rest in phases."""
    yield "target.pose.position", math.hypot(*scene.target.pose.position)
    for index, pose in enumerate(scene.staged.resting):
        if pose is not None:
            yield f"phases[{index}].changes.target.pose.position", math.hypot(*poses.position(pose))


def _target_way(scene: Scene) -> float:
    """Largest distance of the target's body from its start in an episode, m; or its rate, if that is more."""
    motion, spread, duration = scene.target.motion, scene.spread, scene.simulation.steps * scene.simulation.dt
    if isinstance(motion, Waypoints):
        path = given_path(scene, scene.simulation.steps)
        places = np.stack(poses.position(tuple(path[:, :8].T)), axis=1)
        return float(max(np.linalg.norm(places, axis=1).max(), np.linalg.norm(path[:, 8:], axis=1).max()))
    assert motion is not None
    speed = math.hypot(*motion.linear_velocity) + math.sqrt(3.0) * spread.target_linear_velocity
    rate = math.hypot(*motion.angular_velocity) + math.sqrt(3.0) * spread.target_angular_velocity
    return max(rate, speed, duration * speed)


def _checked_target(kernels: Kernels, target: Any) -> Array:
    """A target with its rounding errors removed, if it is a pose that the compiled code can take."""
    entries = target_entries(kernels.scene)
    if len(kernels.parameters.indices(TARGET)) != len(entries):
        raise ValueError(
            f"options: target; scene {kernels.scene.name!r} has the same in every episode, a constant of its "
            "machine code: give the scene a spread of target_position or target_rotation, or add target.pose "
            "to its parameters"
        )
    if {*kernels.parameters.staged}.intersection(kernels.parameters.indices(TARGET)):
        raise ValueError(f"options: target; the phases of scene {kernels.scene.name!r} say where it is")
    pose = _unit_pose("target is a pose", _finite("target", target, 8))
    fixed = [index for index in range(8) if index not in entries]
    if np.abs(pose[fixed]).max(initial=0.0) > 1e-6:
        raise ValueError(
            f"options: target {pose} leaves the plane, its entries {fixed} should be 0 in a planar scene"
        )
    pose[fixed] = 0.0
    distance = math.hypot(*poses.position(pose))
    if distance > STATE_LIMIT:
        raise ValueError(
            f"options: target is {distance:.3g} m from the origin, should be at most {STATE_LIMIT:g} m, for "
            "observations to hold it"
        )
    return pose


def _checked_parameters(kernels: Kernels, parameters: Any) -> Array:
    """Parameters with which the environment takes the scene: a mass may not be negative."""
    values = _finite("parameters", parameters, kernels.n_p)
    nominal, names = kernels.parameters.nominal, kernels.parameters.names
    other = [index for index in kernels.parameters.staged if values[index] != nominal[index]]
    if other and (values[other] != kernels.stage_parameters(values)[0, other]).any():
        index = other[0]
        raise ValueError(
            f"options: parameters; {names[index]} is {values[index]:g}, should be {nominal[index]:g}: it is "
            "the phases that change it"
        )
    if isinstance(kernels.scene.target.motion, Waypoints):
        for index in kernels.parameters.indices(VELOCITY):
            if abs(values[index] - nominal[index]) > 1e-6 * (1.0 + abs(nominal[index])):
                raise ValueError(
                    f"options: parameters; {names[index]} is {values[index]:g}, should be "
                    f"{nominal[index]:g}: the waypoints say how fast the target moves"
                )
            values[index] = nominal[index]
    _check_values(kernels, tuple(values.tolist()))
    return values


@lru_cache(maxsize=1024)
def _check_values(kernels: Kernels, parameters: tuple[float, ...]) -> None:
    """Raise SceneError for parameters that no scene may have; episodes often share theirs.

    ValueError for those with which observations would not hold the target.
    """
    _check_lengths(episode_scene(kernels.scene, parameters))


def _finite(name: str, value: Any, size: int) -> Array:
    numbers = real_array(f"options: {name}", value).astype(np.float64)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"options: {name} {numbers} of shape {numbers.shape}, should be finite numbers of shape {(size,)}"
        )
    return numbers


def _unit_pose(what: str, pose: Array) -> Array:
    """A unit dual quaternion, |q_r| = 1 and q_r . q_d = 0, with its rounding errors removed."""
    length, overlap = math.hypot(*pose[:4]), float(np.dot(pose[:4], pose[4:]))
    if abs(length - 1.0) > 1e-6 or abs(overlap) > 1e-6 * (1.0 + math.hypot(*pose[4:])):
        raise ValueError(
            f"options: {what} with |q_r| = {length:.9g}, q_r . q_d = {overlap:.3g}; "
            "a unit dual quaternion has 1 and 0"
        )
    return np.array(dual_quaternion.normalize(tuple(pose.tolist())))


def _give_sign_of_target(kernels: Kernels, x: Array, target: Array) -> None:
    """Give q_{e0/I} the sign with q_{G/I,r} . q_{D/I,r} >= 0: q and -q are one pose but cost differently."""
    alignment = np.sum(kernels.tip_pose(x)[..., :4] * target[..., :4], axis=-1, keepdims=True)
    x[..., kernels.layout.state.pose] *= np.where(alignment < 0.0, -1.0, 1.0)
