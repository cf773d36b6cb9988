"""Layout of the state, the tangent and the controls of a scene.

State: base pose, joint angles, wrist angles, base velocity, joint rates. Tangent: the same, with a twist
increment of the base in base axes (rotation, then translation) in place of the pose. Controls: base force,
base torque, joint torques of the actuated joints, wrist rates. What a scene does not have is missing; the
order stays.
A planar base keeps only what is not zero by construction: q_r0, q_r3, q_d1, q_d2 of its pose, and omega_z,
v_x, v_y.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.scene.maneuver import AxisLimits
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import PLANAR_POSE, Array, free_axes, initial_state, is_planar

_AXES = ("x", "y", "z")
_EULER_ANGLES = ("psi", "theta", "phi")
_POSE = tuple(f"base pose q_{part}{index}" for part in "rd" for index in range(4))


@dataclass(frozen=True, kw_only=True)
class _Entries:
    names: tuple[str, ...]
    units: tuple[str, ...]  # "1" for dimensionless


@dataclass(frozen=True, kw_only=True)
class _MotionEntries(_Entries):
    """Slices that state and tangent have in common; empty for what the scene does not have."""

    joint_angles: slice  # base to tip
    wrist_angles: slice  # psi, theta, phi
    base_velocity: slice  # base axes, 6 numbers (planar: omega_z, v_x, v_y)
    angular_velocity: slice  # part of base_velocity
    linear_velocity: slice  # part of base_velocity
    joint_rates: slice  # base to tip


@dataclass(frozen=True, kw_only=True)
class StateEntries(_MotionEntries):
    """The entries of the state x."""

    pose: slice  # of the base, q_{e0/I}, 8 numbers (planar: q_r0, q_r3, q_d1, q_d2)


@dataclass(frozen=True, kw_only=True)
class TangentEntries(_MotionEntries):
    """The entries of the tangent of the state."""

    rotation: slice  # increment of the base in base axes, 3 numbers (planar: z)
    translation: slice  # increment of the base in base axes, 3 numbers (planar: x, y)


@dataclass(frozen=True, kw_only=True)
class ControlEntries(_Entries):
    """The entries of the controls u; empty slices for what the scene does not have."""

    base_force: slice  # base axes, 3 numbers (planar: x, y)
    base_torque: slice  # base axes, 3 numbers (planar: z)
    joint_torque: slice  # actuated joints, base to tip
    wrist_rate: slice  # Euler rates psi, theta, phi


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

    def to_control(self, action: ArrayLike) -> Array:
        """Scale actions to controls.

        Args:
            action: Fractions of the limits in [-1, 1], shape (..., n_u).

        Returns:
            Controls, shape (..., n_u), N, N m, rad/s.
        """
        return real_array("action", action, np.float64) * self.control_limit

    def to_action(self, control: ArrayLike) -> Array:
        """Scale controls to actions, the inverse of `to_control`.

        Args:
            control: Controls, shape (..., n_u), N, N m, rad/s.

        Returns:
            Fractions of the limits, shape (..., n_u); 0 where a control has no limit.
        """
        return real_array("control", control, np.float64) / self.control_limit

    @classmethod
    def of(cls, scene: Scene) -> "StateLayout":
        """Lay out a scene."""
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


class _Collector:
    """Names and units of entries, collected part by part."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.units: list[str] = []

    def add(self, unit: str, names: Sequence[str]) -> slice:
        """Append entries of one unit and return their place."""
        start = len(self.names)
        self.names += names
        self.units += [unit] * len(names)
        return slice(start, len(self.names))

    def collected(self) -> dict[str, Any]:
        return {"names": tuple(self.names), "units": tuple(self.units)}

    def add_motion(self, scene: Scene) -> dict[str, Any]:
        """Append what state and tangent have in common."""
        turning, moving = free_axes(scene)
        wrist = _EULER_ANGLES if scene.wrist else ()
        joint_angles = self.add("rad", [f"{link.name} angle" for link in scene.links])
        wrist_angles = self.add("rad", [f"wrist {angle}" for angle in wrist])
        angular = self.add("rad/s", [f"base omega_{_AXES[axis]}" for axis in turning])
        linear = self.add("m/s", [f"base v_{_AXES[axis]}" for axis in moving])
        return {
            "joint_angles": joint_angles,
            "wrist_angles": wrist_angles,
            "base_velocity": slice(angular.start, linear.stop),
            "angular_velocity": angular,
            "linear_velocity": linear,
            "joint_rates": self.add("rad/s", [f"{link.name} rate" for link in scene.links]),
        }


def _lay_out_state(scene: Scene) -> StateEntries:
    entries = _Collector()
    pose = [_POSE[index] for index in PLANAR_POSE] if is_planar(scene) else _POSE
    real = entries.add("1", [name for name in pose if "q_r" in name])
    dual = entries.add("m", [name for name in pose if "q_d" in name])
    motion = entries.add_motion(scene)
    return StateEntries(pose=slice(real.start, dual.stop), **motion, **entries.collected())


def _lay_out_tangent(scene: Scene) -> TangentEntries:
    entries = _Collector()
    turning, moving = free_axes(scene)
    rotation = entries.add("rad", [f"base rotation {_AXES[axis]}" for axis in turning])
    translation = entries.add("m", [f"base translation {_AXES[axis]}" for axis in moving])
    motion = entries.add_motion(scene)
    return TangentEntries(rotation=rotation, translation=translation, **motion, **entries.collected())


def _lay_out_controls(scene: Scene) -> tuple[ControlEntries, list[float], list[float]]:
    """Entries, limits and weights of the controls."""
    entries, actuators, cost = _Collector(), scene.actuators, scene.cost
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
        base_force=force, base_torque=torque, joint_torque=joint, wrist_rate=rate, **entries.collected()
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
    """Make a read-only array: layouts are shared."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
