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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.scene.actuator_chains import Chain, chains
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import previous_controls
from dq_space_arm_env.scene.entries import (
    ControlEntries,
    ParameterEntries,
    StateEntries,
    TangentEntries,
    constant,
)
from dq_space_arm_env.scene.parameters import (
    GRASP,
    PHASE,
    TARGET,
    VELOCITY,
    control_numbers,
)
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import Array, initial_state, is_planar


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
        state, tangent = self.state.without_actuators(), self.tangent.without_actuators()
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
        return self._given(self.control.limits, self.control_limit, parameters)

    def weights_with(self, parameters: Array) -> Array:
        """Weights of the squared controls in the cost, likewise, shape (..., n_u)."""
        return self._given(self.control.weights, self.control_weight, parameters)

    def _given(self, names: Sequence[str], nominal: Array, parameters: Array) -> Array:
        """Numbers of the controls, (..., n_u), of which those with the name of a parameter have its value."""
        values = np.broadcast_to(nominal, (*parameters.shape[:-1], self.n_u)).copy()
        for index, name in enumerate(names):
            if name in self.parameters.names:
                values[..., index] = parameters[..., self.parameters.names.index(name)]
        return values

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

    def to_control(self, action: ArrayLike, parameters: Array | None = None) -> Array:
        """Scale actions to controls.

        Args:
            action: Fractions of the limits in [-1, 1], shape (..., n_u); below 0 a thruster is off.
            parameters: Of the stages, where limits may be parameters, shape (..., n_p), units of
                `parameters`; None: nominal limits.

        Returns:
            Controls, shape (..., n_u), N, N m, rad/s.

        Raises:
            TypeError: If the actions are masked, or not of real numbers.
        """
        controls = real_array("action", action, np.float64) * self._limits(parameters)
        jets = controls[..., self.control.thruster_force]
        np.maximum(jets, 0.0, out=jets)
        return controls

    def to_action(self, control: ArrayLike, parameters: Array | None = None) -> Array:
        """Scale controls to actions, the inverse of `to_control`.

        Args:
            control: Controls, shape (..., n_u), N, N m, rad/s.
            parameters: As for `to_control`.

        Returns:
            Fractions of the limits, shape (..., n_u); 0 where a control has no limit, or its limit is 0.

        Raises:
            TypeError: If the controls are masked, or not of real numbers.
        """
        controls, limits = real_array("control", control, np.float64), self._limits(parameters)
        actions: Array = np.zeros(np.broadcast_shapes(controls.shape, limits.shape))
        np.divide(controls, limits, out=actions, where=limits > 0.0)
        return actions

    def to_action_gains(self, gains: Array, parameters: Array | None = None) -> Array:
        """Scale feedback gains of controls to those of actions.

        Args:
            gains: Controls per deviation, shape (..., n_u, n_t).
            parameters: As for `to_control`.

        Returns:
            Fractions of the limits per deviation, shape (..., n_u, n_t).
        """
        rows = None if parameters is None else parameters[..., None, :]
        return self.to_action(gains.swapaxes(-1, -2), rows).swapaxes(-1, -2)

    def _limits(self, parameters: Array | None) -> Array:
        return self.control_limit if parameters is None else self.limits_with(parameters)

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
            state=StateEntries.of(scene),
            tangent=TangentEntries.of(scene),
            control=ControlEntries.of(controls),
            previous_controls=previous_controls(scene),
            chains=chains(scene),
            parameters=ParameterEntries.of(scene),
            target=constant(scene.target.pose.dual_quaternion),
            grasp=constant(scene.target.grasp.dual_quaternion),
            control_limit=constant([control.limit.nominal for control in every_control]),
            control_weight=constant([control.weight.nominal for control in every_control]),
            initial_state=constant(initial_state(scene)),
        )


def _actuated_joints(scene: Scene) -> tuple[int, ...]:
    if scene.actuators.joint_torque is None:
        return ()
    driven = (scene.links[index].actuated for index, _ in freedoms(scene.links))
    return tuple(number for number, actuated in enumerate(driven) if actuated)


def _entries(vectors: Array) -> tuple[Array, ...]:
    """Components of vectors, shape (..., n), as the algebra takes them."""
    return tuple(np.moveaxis(vectors, -1, 0))
