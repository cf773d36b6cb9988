"""Layout of the state, the tangent, the controls and the parameters of a scene.

State: base pose, joint angles (quaternions of spherical joints), wrist angles, base velocity, joint rates,
angles and rates of motors behind elastic gears, axial momenta of wheels, mass of the propellant in a tank,
and what actuators keep from step to step: the previous controls whose rates are limited, then commands on
their way and outputs. Tangent: the same, with a twist increment of the base in base axes (rotation, then
translation) in place of the pose. Controls: base force, base torque, joint torques of the actuated joints,
wrist rates, wheel torques, thruster forces. Parameters: target, bodies from base to payload, weights, limits.
What a scene does not have is missing; the order stays.
A planar base keeps only what is not zero by construction: q_r0, q_r3, q_d1, q_d2 of its pose, and omega_z,
v_x, v_y.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.scene.actuator_chains import Chain, chains
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import previous_controls
from dq_space_arm_env.scene.parameters import (
    GRASP,
    PHASE,
    TARGET,
    VELOCITY,
    ControlNumbers,
    catch_numbers,
    control_numbers,
    is_part,
    moving_numbers,
    parameters,
    wheel_names,
)
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import Array, free_axes, initial_state, is_planar

_Part = TypeVar("_Part", bound="_MotionEntries")
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
    wheel_torque: slice  # of the motor on each wheel, about its axis
    thruster_force: slice  # of each thruster, zero or greater
    limits: tuple[str, ...]  # name of each control's limit in the scene
    weights: tuple[str, ...]  # name of each control's weight in the cost


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
        return [index for index, name in enumerate(self.names) if is_part(name, path)]


@dataclass(frozen=True, eq=False)
class StateLayout:
    """The layout of a scene's state, tangent, controls and parameters.

    Attributes:
        planar: Whether the base moves in its x-y plane only.
        n_joints: Number of degrees of freedom of all joints: of joint rates.
        actuated_joints: Indices of those that motors drive among them, base to tip.
        has_wrist: Whether the scene has a wrist.
        state: Entries of the state x.
        tangent: Entries of the tangent of the state.
        control: Entries of the controls u.
        previous_controls: Indices of the controls that the state keeps for a step: their rates are limited.
        chains: Controls that act later than they are commanded: with a delay or a lag.
        parameters: Entries of the parameters p.
        target: The nominal pose of the target's body at the start, shape (8,), real part dimensionless, dual
            part m; without a grasp frame the target q_{D/I}.
        grasp: The nominal grasp frame in the target's body, shape (8,), likewise.
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
    previous_controls: tuple[int, ...]
    chains: tuple[Chain, ...]
    parameters: ParameterEntries
    target: Array
    grasp: Array
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

    @property
    def n_p(self) -> int:
        """Number of parameters."""
        return len(self.parameters.names)

    @property
    def of_motion(self) -> "StateLayout":
        """The layout without what actuators keep: of the state that the equations of motion advance."""
        if not self.previous_controls and not self.chains:
            return self
        state, tangent = _without_actuators(self.state), _without_actuators(self.tangent)
        start = self.initial_state[: self.state.actuators.start]
        nothing: dict[str, Any] = {"previous_controls": (), "chains": ()}
        return replace(self, state=state, tangent=tangent, initial_state=start, **nothing)

    def target_with(self, parameters: Array) -> Array:
        """Target where it may be a parameter.

        Args:
            parameters: Shape (..., n_p), units of `parameters`; those of a stage where the target moves.

        Returns:
            q_{D/I}, shape (..., 8), real part dimensionless, dual part m, of the type of the parameters.
        """
        body = self.target_body_with(parameters)
        if not self._has_grasp:
            return body
        grasp = self._pose_with(GRASP, self.grasp, parameters)
        return np.stack(dq.multiply(_entries(body), _entries(grasp)), axis=-1)

    def target_body_with(self, parameters: Array) -> Array:
        """Pose of the target's body where it may be a parameter.

        Args:
            parameters: Shape (..., n_p), units of `parameters`; those of a stage where the target moves.

        Returns:
            q_{T/I}, shape (..., 8), real part dimensionless, dual part m, of the type of the parameters.
        """
        return self._pose_with(TARGET, self.target, parameters)

    def target_body_below(self, target: Array, parameters: Array) -> Array:
        """Pose of the target's body from the desired pose of the tip, the other way round.

        Args:
            target: q_{D/I}, shape (8,) or (..., 8), real part dimensionless, dual part m.
            parameters: Shape (..., n_p), units of `parameters`, of which those of the grasp frame count.

        Returns:
            q_{T/I}, shape (8,) or (..., 8), real part dimensionless, dual part m.
        """
        if not self._has_grasp:
            return target
        grasp = self._pose_with(GRASP, self.grasp, parameters)
        body = dq.multiply(_entries(target), dq.conjugate(_entries(grasp)))
        return np.stack(body, axis=-1)

    @property
    def _has_grasp(self) -> bool:
        return bool(self.parameters.indices(GRASP)) or not np.array_equal(self.grasp, dq.IDENTITY)

    def _pose_with(self, path: str, nominal: Array, parameters: Array) -> Array:
        pose = np.tile(nominal.astype(parameters.dtype), (*parameters.shape[:-1], 1))
        where = self.parameters.indices(path)
        if where:
            pose[..., PLANAR_POSE if self.planar else range(8)] = parameters[..., where]
        return pose

    def target_velocity_with(self, parameters: Array) -> Array:
        """Velocity of the desired tip pose, which moves with the target's body.

        Args:
            parameters: Of a stage, shape (..., n_p), units of `parameters`.

        Returns:
            Twist in the axes of q_{D/I}, angular then linear, shape (..., 6), rad/s and m/s.
        """
        velocity = np.zeros((*parameters.shape[:-1], 6), parameters.dtype)
        where = self.parameters.indices(VELOCITY)
        if where:
            velocity[..., PLANAR_TWIST if self.planar else range(6)] = parameters[..., where]
        grasp = _entries(self._pose_with(GRASP, self.grasp, parameters))
        return np.stack(dual_vectors.inverse_transform(*poses.to_matrix(grasp), _entries(velocity)), axis=-1)

    def goal_observation(self, x: Array, parameters: Array) -> Array:
        """Entry `observation` of the goal environment: the state, then what scenes with phases or motion add.

        Args:
            x: States, shape (..., n_x), units of `state`.
            parameters: Of the present stages, shape (..., n_p), units of `parameters`.

        Returns:
            State, number of the phase, and velocity of a target that moves, in its axes, rad/s and m/s, shape
            (..., n).
        """
        parts = [x, parameters[..., self.parameters.indices(PHASE)]]
        if self.parameters.moving:
            parts.append(self.target_velocity_with(parameters))
        return np.concatenate(parts, axis=-1)

    def limits_with(self, parameters: Array) -> Array:
        """Limits of the controls where some may be parameters.

        Args:
            parameters: Shape (..., n_p), units of `parameters`.

        Returns:
            Largest magnitudes, shape (..., n_u), N, N m, rad/s.
        """
        limits = np.broadcast_to(self.control_limit, (*parameters.shape[:-1], self.n_u)).copy()
        for index, name in enumerate(self.control.limits):
            if name in self.parameters.names:
                limits[..., index] = parameters[..., self.parameters.names.index(name)]
        return limits

    def lower_limits(self, limits: Array) -> Array:
        """Least controls, where the greatest are given: zero for thrusters, the limits' negatives for others.

        Args:
            limits: Largest magnitudes, shape (..., n_u), N, N m, rad/s.

        Returns:
            Lower bounds, shape (..., n_u), N, N m, rad/s.
        """
        lower = -limits
        lower[..., self.control.thruster_force] = 0.0
        return lower

    def to_control(self, action: ArrayLike) -> Array:
        """Scale actions to controls.

        Args:
            action: Fractions of the limits in [-1, 1], shape (..., n_u); below 0 a thruster is off.

        Returns:
            Controls, shape (..., n_u), N, N m, rad/s.
        """
        controls = real_array("action", action, np.float64) * self.control_limit
        jets = controls[..., self.control.thruster_force]
        np.maximum(jets, 0.0, out=jets)
        return controls

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
        controls = control_numbers(scene)
        every_control = [each for numbers in controls.values() for each in numbers]
        return cls(
            planar=is_planar(scene),
            n_joints=len(freedoms(scene.links)),
            actuated_joints=_actuated_joints(scene),
            has_wrist=scene.wrist is not None,
            state=_lay_out_state(scene),
            tangent=_lay_out_tangent(scene),
            control=_lay_out_controls(controls),
            previous_controls=previous_controls(scene),
            chains=chains(scene),
            parameters=_lay_out_parameters(scene),
            target=_constant(scene.target.pose.dual_quaternion),
            grasp=_constant(scene.target.grasp.dual_quaternion),
            control_limit=_constant([control.limit.nominal for control in every_control]),
            control_weight=_constant([control.weight.nominal for control in every_control]),
            initial_state=_constant(initial_state(scene)),
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


def _lay_out_state(scene: Scene) -> StateEntries:
    entries = _Collector()
    pose = [_POSE[index] for index in PLANAR_POSE] if is_planar(scene) else _POSE
    real = entries.add("1", [name for name in pose if "q_r" in name])
    dual = entries.add("m", [name for name in pose if "q_d" in name])
    motion = entries.add_motion(scene)
    return StateEntries(pose=slice(real.start, dual.stop), **motion, **entries.collected())


def _without_actuators(entries: _Part) -> _Part:
    """Entries of the motion alone."""
    end = entries.actuators.start
    none = slice(end, end)
    names, units = entries.names[:end], entries.units[:end]
    return replace(entries, names=names, units=units, actuators=none, drives=none)


def _lay_out_tangent(scene: Scene) -> TangentEntries:
    entries = _Collector()
    turning, moving = free_axes(scene)
    rotation = entries.add("rad", [f"base rotation {_AXES[axis]}" for axis in turning])
    translation = entries.add("m", [f"base translation {_AXES[axis]}" for axis in moving])
    motion = entries.add_motion(scene)
    return TangentEntries(rotation=rotation, translation=translation, **motion, **entries.collected())


def _lay_out_controls(controls: Mapping[str, Sequence[ControlNumbers]]) -> ControlEntries:
    entries = _Collector()
    slices = {
        field: entries.add_each([each.limit.unit for each in numbers], [each.name for each in numbers])
        for field, numbers in controls.items()
    }
    everything = [number for numbers in controls.values() for number in numbers]
    return ControlEntries(
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


def _lay_out_parameters(scene: Scene) -> ParameterEntries:
    found, moving = parameters(scene), {number.name for number in moving_numbers(scene)}
    staged = {*scene.staged.values, *(number.name for number in catch_numbers(scene))} if scene.phases else {}
    return ParameterEntries(
        moving=tuple(index for index, number in enumerate(found) if number.name in moving),
        staged=tuple(index for index, number in enumerate(found) if number.name in staged),
        names=tuple(number.name for number in found),
        units=tuple(number.unit for number in found),
        nominal=_constant([number.nominal for number in found]),
    )


def _actuated_joints(scene: Scene) -> tuple[int, ...]:
    if scene.actuators.joint_torque is None:
        return ()
    driven = (scene.links[index].actuated for index, _ in freedoms(scene.links))
    return tuple(number for number, actuated in enumerate(driven) if actuated)


def _entries(vectors: Array) -> tuple[Array, ...]:
    """Components of vectors, shape (..., n), as the algebra takes them."""
    return tuple(np.moveaxis(vectors, -1, 0))


def _constant(values: Sequence[float] | Array) -> Array:
    """Make a read-only array: layouts are shared."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array
