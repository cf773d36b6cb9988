"""Where everything lies in the state, the tangent and the controls of a scene, and where an episode starts.

State: base pose, joint angles, wrist angles, base velocity, joint rates. Tangent: the same, with a twist
increment of the base in base axes (rotation, then translation) in place of the pose. Controls: base force,
base torque, joint torques of the actuated joints, wrist rates. What a scene does not have is missing; the
order stays.
A planar base keeps only what is not zero by construction: q_r0, q_r3, q_d1, q_d2 of its pose, and omega_z,
v_x, v_y.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import (
    PLANAR_POSE,
    Array,
    draw_initial_state,
    free_axes,
    initial_state,
    is_planar,
)
from dq_space_arm_env.scene.task import AxisLimits

__all__ = [
    "ControlEntries",
    "StateEntries",
    "StateLayout",
    "TangentEntries",
    "draw_initial_state",
    "initial_state",
]

_AXES = ("x", "y", "z")
_EULER_ANGLES = ("psi", "theta", "phi")
_POSE = tuple(f"base pose q_{part}{index}" for part in "rd" for index in range(4))


@dataclass(frozen=True)
class StateEntries:
    """The entries of the state x; empty slices for what the scene does not have.

    Attributes:
        names: Name of each entry.
        units: Unit of each entry, "1" for dimensionless.
        pose: Base pose q_{e0/I}, 8 numbers (planar: q_r0, q_r3, q_d1, q_d2).
        joint_angles: Joint angles, base to tip.
        wrist_angles: Wrist angles psi, theta, phi.
        base_velocity: Velocity of the base in base axes, 6 numbers (planar: omega_z, v_x, v_y).
        angular_velocity: The angular part of `base_velocity`.
        linear_velocity: The linear part of `base_velocity`.
        joint_rates: Joint rates, base to tip.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    pose: slice
    joint_angles: slice
    wrist_angles: slice
    base_velocity: slice
    angular_velocity: slice
    linear_velocity: slice
    joint_rates: slice


@dataclass(frozen=True)
class TangentEntries:
    """The entries of the tangent of the state; empty slices for what the scene does not have.

    Attributes:
        names: Name of each entry.
        units: Unit of each entry.
        rotation: Rotation increment of the base in base axes, 3 numbers (planar: z).
        translation: Translation increment of the base in base axes, 3 numbers (planar: x, y).
        joint_angles: Joint angles, base to tip.
        wrist_angles: Wrist angles psi, theta, phi.
        base_velocity: Velocity of the base in base axes, 6 numbers (planar: omega_z, v_x, v_y).
        angular_velocity: The angular part of `base_velocity`.
        linear_velocity: The linear part of `base_velocity`.
        joint_rates: Joint rates, base to tip.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    rotation: slice
    translation: slice
    joint_angles: slice
    wrist_angles: slice
    base_velocity: slice
    angular_velocity: slice
    linear_velocity: slice
    joint_rates: slice


@dataclass(frozen=True)
class ControlEntries:
    """The entries of the controls u; empty slices for what the scene does not have.

    Attributes:
        names: Name of each entry.
        units: Unit of each entry.
        base_force: Force on the base in base axes, 3 numbers (planar: x, y).
        base_torque: Torque on the base in base axes, 3 numbers (planar: z).
        joint_torque: Torques of the actuated joints, base to tip.
        wrist_rate: Euler rates psi, theta, phi of the wrist.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    base_force: slice
    base_torque: slice
    joint_torque: slice
    wrist_rate: slice


@dataclass(frozen=True, eq=False)
class StateLayout:
    """The layout of a scene's state, tangent and controls.

    Attributes:
        planar: Whether the base moves in its x-y plane only.
        n_joints: Number of joints.
        actuated_joints: Indices of the joints with a motor, base to tip.
        has_wrist: Whether the scene has a wrist.
        state: Entries of the state x.
        tangent: Entries of the tangent of the state.
        control: Entries of the controls u.
        control_limit: Largest magnitude of each control, shape (n_u,), units of the controls; inf: unlimited.
        control_weight: Weight of each squared control in the cost, shape (n_u,), 1/unit^2.
        initial_state: The scene's nominal start with the sign rule applied, shape (n_x,), units of the state.
    """

    planar: bool
    n_joints: int
    actuated_joints: tuple[int, ...]
    has_wrist: bool
    state: StateEntries
    tangent: TangentEntries
    control: ControlEntries
    control_limit: Array
    control_weight: Array
    initial_state: Array

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.state.names)

    @property
    def n_t(self) -> int:
        """Number of tangent coordinates."""
        return len(self.tangent.names)

    @property
    def n_u(self) -> int:
        """Number of controls."""
        return len(self.control.names)

    @classmethod
    def of(cls, scene: Scene) -> "StateLayout":
        """Lay out a scene.

        Args:
            scene: A validated scene.

        Returns:
            Its layout.
        """
        control, limit, weight = _lay_out_controls(scene)
        return cls(
            planar=is_planar(scene),
            n_joints=len(scene.links),
            actuated_joints=_actuated_joints(scene),
            has_wrist=scene.wrist is not None,
            state=_lay_out_state(scene),
            tangent=_lay_out_tangent(scene),
            control=control,
            control_limit=_constant(limit),
            control_weight=_constant(weight),
            initial_state=_constant(initial_state(scene)),
        )


class _Entries:
    """Names, units and slices, collected part by part."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.units: list[str] = []

    def add(self, unit: str, names: Sequence[str]) -> slice:
        """Append entries of one unit and return where they lie."""
        start = len(self.names)
        self.names += names
        self.units += [unit] * len(names)
        return slice(start, len(self.names))


def _lay_out_state(scene: Scene) -> StateEntries:
    entries = _Entries()
    pose = [_POSE[index] for index in PLANAR_POSE] if is_planar(scene) else _POSE
    real = entries.add("1", [name for name in pose if "q_r" in name])
    dual = entries.add("m", [name for name in pose if "q_d" in name])
    joint_angles, wrist_angles, angular, linear, joint_rates = _add_joints_and_velocities(entries, scene)
    return StateEntries(
        names=tuple(entries.names),
        units=tuple(entries.units),
        pose=slice(real.start, dual.stop),
        joint_angles=joint_angles,
        wrist_angles=wrist_angles,
        base_velocity=slice(angular.start, linear.stop),
        angular_velocity=angular,
        linear_velocity=linear,
        joint_rates=joint_rates,
    )


def _lay_out_tangent(scene: Scene) -> TangentEntries:
    entries = _Entries()
    turning, moving = free_axes(scene)
    rotation = entries.add("rad", [f"base rotation {_AXES[axis]}" for axis in turning])
    translation = entries.add("m", [f"base translation {_AXES[axis]}" for axis in moving])
    joint_angles, wrist_angles, angular, linear, joint_rates = _add_joints_and_velocities(entries, scene)
    return TangentEntries(
        names=tuple(entries.names),
        units=tuple(entries.units),
        rotation=rotation,
        translation=translation,
        joint_angles=joint_angles,
        wrist_angles=wrist_angles,
        base_velocity=slice(angular.start, linear.stop),
        angular_velocity=angular,
        linear_velocity=linear,
        joint_rates=joint_rates,
    )


def _add_joints_and_velocities(entries: _Entries, scene: Scene) -> tuple[slice, slice, slice, slice, slice]:
    """Append what state and tangent have in common."""
    turning, moving = free_axes(scene)
    wrist = _EULER_ANGLES if scene.wrist else ()
    return (
        entries.add("rad", [f"{link.name} angle" for link in scene.links]),
        entries.add("rad", [f"wrist {angle}" for angle in wrist]),
        entries.add("rad/s", [f"base omega_{_AXES[axis]}" for axis in turning]),
        entries.add("m/s", [f"base v_{_AXES[axis]}" for axis in moving]),
        entries.add("rad/s", [f"{link.name} rate" for link in scene.links]),
    )


def _lay_out_controls(scene: Scene) -> tuple[ControlEntries, list[float], list[float]]:
    """Entries, limits and weights of the controls."""
    entries, actuators, cost = _Entries(), scene.actuators, scene.cost
    limits: list[float] = []
    weights: list[float] = []

    def add(unit: str, inputs: Sequence[_Input]) -> slice:
        limits.extend(limit for _, limit, _ in inputs)
        weights.extend(weight for _, _, weight in inputs)
        return entries.add(unit, [name for name, _, _ in inputs])

    turning, moving = free_axes(scene)
    force_names = [f"base force {axis}" for axis in _AXES]
    torque_names = [f"base torque {axis}" for axis in _AXES]
    rate_names = [f"wrist {angle} rate" for angle in _EULER_ANGLES]
    force = add("N", _axis_inputs(force_names, actuators.base_force, cost.base_force, moving))
    torque = add("N m", _axis_inputs(torque_names, actuators.base_torque, cost.base_torque, turning))
    joint = add("N m", _joint_inputs(scene))
    rate = add("rad/s", _axis_inputs(rate_names, actuators.wrist_rate, cost.wrist_rate, range(3)))
    control = ControlEntries(
        names=tuple(entries.names),
        units=tuple(entries.units),
        base_force=force,
        base_torque=torque,
        joint_torque=joint,
        wrist_rate=rate,
    )
    return control, limits, weights


_Input = tuple[str, float, float]  # name, limit, weight


def _axis_inputs(
    names: Sequence[str], actuator: AxisLimits | None, weights: Sequence[float], axes: Sequence[int]
) -> list[_Input]:
    if actuator is None:
        return []
    return [(names[axis], actuator.limit[axis], weights[axis]) for axis in axes]


def _joint_inputs(scene: Scene) -> list[_Input]:
    motors = scene.actuators.joint_torque
    if motors is None:
        return []
    return [
        (
            f"{link.name} torque",
            motors.limit if link.torque_limit is None else link.torque_limit,
            scene.cost.joint_torque,
        )
        for link in scene.links
        if link.actuated
    ]


def _actuated_joints(scene: Scene) -> tuple[int, ...]:
    if scene.actuators.joint_torque is None:
        return ()
    return tuple(index for index, link in enumerate(scene.links) if link.actuated)


def _constant(values: Sequence[float] | Array) -> Array:
    """Array that cannot be written to: a layout is shared."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
