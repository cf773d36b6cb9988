"""Entries of the state, the tangent, the controls and the parameters of a scene: names, units, slices.

`layout` says what they are, and their order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from dq_space_arm_env.scene.actuator_chains import chains
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import previous_controls
from dq_space_arm_env.scene.parameters import (
    TARGET,
    ControlNumbers,
    catch_numbers,
    control_numbers,
    is_part,
    moving_numbers,
    parameters,
    wheel_names,
)
from dq_space_arm_env.scene.pose import PLANAR_POSE
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import Array, free_axes, is_planar

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

    joint_angles: slice  # base to tip, of spherical joints w, x, y, z of a unit quaternion
    wrist_angles: slice  # psi, theta, phi
    base_velocity: slice  # base axes, 6 numbers (planar: omega_z, v_x, v_y)
    angular_velocity: slice  # part of base_velocity
    linear_velocity: slice  # part of base_velocity
    joint_rates: slice  # base to tip, of spherical joints x, y, z of the angular velocity in the link's axes
    motor_angles: slice  # of elastic joints, on the joints' side
    motor_rates: slice  # likewise
    wheel_momenta: slice  # axial, inertial rate, in the order of the scene's wheels
    propellant: slice  # mass left in the tank
    actuators: slice  # previous controls, those of `StateLayout.previous_controls`
    drives: slice  # commands on their way and outputs, those of `StateLayout.chains`

    def without_actuators(self) -> Self:
        """Those of the motion alone."""
        end = self.actuators.start
        none = slice(end, end)
        names, units = self.names[:end], self.units[:end]
        return replace(self, names=names, units=units, actuators=none, drives=none)


@dataclass(frozen=True, kw_only=True)
class StateEntries(_MotionEntries):
    """The entries of the state x."""

    pose: slice  # of the base, q_{e0/I}, 8 numbers (planar: q_r0, q_r3, q_d1, q_d2)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Lay out the state."""
        entries = _Collector()
        pose = [_POSE[index] for index in PLANAR_POSE] if is_planar(scene) else _POSE
        real = entries.add("1", [name for name in pose if "q_r" in name])
        dual = entries.add("m", [name for name in pose if "q_d" in name])
        motion = entries.add_motion(scene)
        return cls(pose=slice(real.start, dual.stop), **motion, **entries.collected())


@dataclass(frozen=True, kw_only=True)
class TangentEntries(_MotionEntries):
    """The entries of the tangent of the state."""

    rotation: slice  # increment of the base in base axes, 3 numbers (planar: z)
    translation: slice  # increment of the base in base axes, 3 numbers (planar: x, y)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Lay out the tangent."""
        entries = _Collector()
        turning, moving = free_axes(scene)
        rotation = entries.add("rad", [f"base rotation {_AXES[axis]}" for axis in turning])
        translation = entries.add("m", [f"base translation {_AXES[axis]}" for axis in moving])
        motion = entries.add_motion(scene)
        return cls(rotation=rotation, translation=translation, **motion, **entries.collected())


@dataclass(frozen=True, kw_only=True)
class ControlEntries(_Entries):
    """The entries of the controls u; empty slices for what the scene does not have."""

    base_force: slice  # base axes, 3 numbers (planar: x, y)
    base_torque: slice  # base axes, 3 numbers (planar: z)
    joint_torque: slice  # actuated joints, base to tip
    wrist_rate: slice  # Euler rates psi, theta, phi
    wheel_torque: slice  # of the motor on each wheel, about its axis
    thruster_force: slice  # of each thruster, zero or greater
    limits: tuple[str, ...]  # name of each control's limit in the scene
    weights: tuple[str, ...]  # name of each control's weight in the cost

    def unit(self, entries: slice, prefix: str = "") -> str:
        """Find the unit of some controls.

        Args:
            entries: Their place.
            prefix: Prefix of the unit, such as "m".

        Returns:
            The unit; two of motors of which some turn and others slide, such as "N m or N".
        """
        return " or ".join(prefix + unit for unit in dict.fromkeys(self.units[entries]))

    @classmethod
    def of(cls, controls: Mapping[str, Sequence[ControlNumbers]]) -> Self:
        """Lay out the controls."""
        entries = _Collector()
        slices = {
            field: entries.add_each([each.limit.unit for each in numbers], [each.name for each in numbers])
            for field, numbers in controls.items()
        }
        everything = [number for numbers in controls.values() for number in numbers]
        return cls(
            base_force=slices["base_force"],
            base_torque=slices["base_torque"],
            joint_torque=slices["joint_torque"],
            wrist_rate=slices["wrist_rate"],
            wheel_torque=slices["wheel_torque"],
            thruster_force=slices["thruster_force"],
            limits=tuple(each.limit.name for each in everything),
            weights=tuple(each.weight.name for each in everything),
            **entries.collected(),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterEntries(_Entries):
    """The entries of the parameters p, the numbers that vary; none in a scene of constants.

    Attributes:
        nominal: The scene's own values, shape (n_p,), units of the parameters.
        moving: Indices of those that change from stage to stage: pose and velocity of a target that moves.
        staged: Indices of those that change from phase to phase, and of what is caught between them.
    """

    nominal: Array
    moving: tuple[int, ...]
    staged: tuple[int, ...]

    @property
    def move_target(self) -> bool:
        """Whether the target has another pose at some stages: it moves, or phases move it."""
        return bool(self.moving or {*self.staged}.intersection(self.indices(TARGET)))

    def indices(self, path: str) -> list[int]:
        """Find parameters.

        Args:
            path: A name, or a path to what has several: "links.0.mass", "target.pose", "base.inertia".

        Returns:
            Their indices; empty if there are none.
        """
        if path not in self._found:
            self._found[path] = [index for index, name in enumerate(self.names) if is_part(name, path)]
        return [*self._found[path]]

    @cached_property
    def _found(self) -> dict[str, list[int]]:
        """Indices found before: environments look for them in every step."""
        return {}

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Lay out the parameters."""
        found, moving = parameters(scene), {number.name for number in moving_numbers(scene)}
        staged = (
            {*scene.staged.values, *(number.name for number in catch_numbers(scene))} if scene.phases else {}
        )
        return cls(
            moving=tuple(index for index, number in enumerate(found) if number.name in moving),
            staged=tuple(index for index, number in enumerate(found) if number.name in staged),
            names=tuple(number.name for number in found),
            units=tuple(number.unit for number in found),
            nominal=constant([number.nominal for number in found]),
        )


class _Collector:
    """Names and units of entries, collected part by part."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.units: list[str] = []

    def add(self, unit: str, names: Sequence[str]) -> slice:
        """Append entries of one unit and return their place."""
        return self.add_each([unit] * len(names), names)

    def add_each(self, units: Sequence[str], names: Sequence[str]) -> slice:
        """Append entries and return their place."""
        start = len(self.names)
        self.names += names
        self.units += units
        return slice(start, len(self.names))

    def collected(self) -> dict[str, Any]:
        return {"names": tuple(self.names), "units": tuple(self.units)}

    def add_motion(self, scene: Scene) -> dict[str, Any]:
        """Append what state and tangent have in common."""
        turning, moving = free_axes(scene)
        wrist = _EULER_ANGLES if scene.wrist else ()
        angles = [(f"{link.name} {name}", unit) for link in scene.links for name, unit in link.coordinates]
        joint_angles = self.add_each([unit for _, unit in angles], [name for name, _ in angles])
        freely = [(scene.links[index], axis) for index, axis in freedoms(scene.links)]
        wrist_angles = self.add("rad", [f"wrist {angle}" for angle in wrist])
        angular = self.add("rad/s", [f"base omega_{_AXES[axis]}" for axis in turning])
        linear = self.add("m/s", [f"base v_{_AXES[axis]}" for axis in moving])
        joint_rates = self.add_each(
            [f"{link.unit}/s" for link, _ in freely], [f"{link.name} rate{axis}" for link, axis in freely]
        )
        return {
            "joint_angles": joint_angles,
            "wrist_angles": wrist_angles,
            "base_velocity": slice(angular.start, linear.stop),
            "angular_velocity": angular,
            "linear_velocity": linear,
            "joint_rates": joint_rates,
            **self.add_motors(scene),
            "wheel_momenta": self.add("N m s", [f"{name} momentum" for name in wheel_names(scene)]),
            "propellant": self.add("kg", ["propellant mass"] if scene.actuators.tank else []),
            "actuators": self.add_previous_controls(scene),
            "drives": self.add_chains(scene),
        }

    def add_motors(self, scene: Scene) -> dict[str, slice]:
        """Append angles and rates of the motors of elastic joints."""
        links = [link for link in scene.links if link.is_elastic]
        kinds = ("displacement", "angle")
        angles = [f"{link.name} motor {kinds[link.turns]}" for link in links]
        rates = [f"{link.name} motor rate" for link in links]
        return {
            "motor_angles": self.add_each([link.unit for link in links], angles),
            "motor_rates": self.add_each([f"{link.unit}/s" for link in links], rates),
        }

    def add_previous_controls(self, scene: Scene) -> slice:
        """Append the controls that the state keeps, each with its unit."""
        controls = [number for numbers in control_numbers(scene).values() for number in numbers]
        kept = [controls[index] for index in previous_controls(scene)]
        return self.add_each([each.limit.unit for each in kept], [f"previous {each.name}" for each in kept])

    def add_chains(self, scene: Scene) -> slice:
        """Append what is on its way from commands to outputs, each with its unit."""
        found = [(name, chain.unit) for chain in chains(scene) for name in chain.names]
        return self.add_each([unit for _, unit in found], [name for name, _ in found])


def constant(values: Sequence[float] | Array) -> Array:
    """Make a read-only array: layouts are shared."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
