"""Maneuver of a scene: actuators and limits, target, cost, start, spread of starts, success."""

import math
from typing import Literal

from pydantic import Field

from dq_space_arm_env.scene.bodies import Payload
from dq_space_arm_env.scene.motion import Motion
from dq_space_arm_env.scene.pose import Pose
from dq_space_arm_env.scene.shapes import Shape, geometry_field
from dq_space_arm_env.scene.thrusters import Tank, Thrusters
from dq_space_arm_env.scene.wheels import Wheels
from dq_space_arm_env.validation.fields import (
    Angles,
    AngleSpread,
    ControlWeight,
    ControlWeights3,
    Delay,
    Flag,
    Fraction,
    LengthSpread,
    Limit,
    Limits3,
    Load,
    Loads,
    Name,
    Positive,
    Rates,
    RateSpread,
    StateWeights6,
    StateWeights8,
    Twist,
)
from dq_space_arm_env.validation.problems import Model

_ZERO_TWIST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Dynamics(Model):
    """How the output of an actuator follows its commands; what is on the way is part of the state."""

    time_constant: Positive | None = Field(
        default=None,
        exclude_if=lambda constant: constant is None,
        description="time constant of a first-order lag of the output, s; absent: it is the command",
    )
    delay: Delay = Field(
        default=0,
        exclude_if=lambda steps: not steps,
        description="whole time steps by which commands act later",
    )
    slew_limit: Positive | None = Field(
        default=None,
        exclude_if=lambda rate: rate is None,
        description="greatest change of the commands that the actuator takes, of each axis or joint, N/s, "
        "N m/s, rad/s^2; absent: any",
    )


class AxisLimits(Dynamics):
    """An actuator with three axes, each limited to [-limit, limit]."""

    limit: Limits3 = Field(
        description="largest magnitude per axis: one number for all three axes, or three; .inf: unlimited"
    )


class JointLimit(Dynamics):
    """The joint motors, each limited to [-limit, limit]; a link may set its own torque_limit."""

    limit: Limit = Field(description="largest magnitude of a joint torque, one number, N m; .inf: unlimited")


class Actuators(Model):
    """The actuators; an absent one has no controls."""

    base_force: AxisLimits | None = Field(
        default=None, description="net force of thrusters on the base in base axes, N"
    )
    base_torque: AxisLimits | None = Field(
        default=None, description="ideal wheels: torque on the base in base axes, N m"
    )
    joint_torque: JointLimit | None = Field(
        default=None, description="joint motors: torque about the joint axis, N m"
    )
    wrist_rate: AxisLimits | None = Field(
        default=None, description="wrist: Euler rates psi, theta, phi of the spherical joint, rad/s"
    )
    wheels: Wheels | None = Field(
        default=None,
        exclude_if=lambda wheels: wheels is None,
        description="reaction wheels, one by one, or as a set: {set: orthogonal or pyramid, ...}",
    )
    thrusters: Thrusters | None = Field(
        default=None,
        exclude_if=lambda thrusters: thrusters is None,
        description="thrusters, one by one: their forces are inputs, zero or greater",
    )
    tank: Tank | None = Field(
        default=None,
        exclude_if=lambda tank: tank is None,
        description="tank of the thrusters, whose propellant's mass is a state; absent: masses stay",
    )


class TipWrench(Model):
    """A constant wrench acting on the tip at G, in the axes of G (eq. 16)."""

    force: Load = Field(default=(0.0, 0.0, 0.0), description="force at the tip in tip axes, N")
    torque: Load = Field(default=(0.0, 0.0, 0.0), description="torque at the tip in tip axes, N m")


class Target(Model):
    """Target pose of the tip, fixed or moving with a body, and velocity of the base there."""

    pose: Pose = Field(
        description="pose of the target's body in the inertial frame, at the start if it moves, m; without a "
        "grasp frame this is the desired pose q_{D/I} of the tip"
    )
    grasp: Pose = Field(
        default_factory=Pose,
        exclude_if=lambda pose: pose == Pose(),
        description="desired pose of the tip in the frame of the target's body, m",
    )
    motion: Motion | None = Field(
        default=None,
        exclude_if=lambda motion: motion is None,
        description="motion of the target's body, of kind screw, tumbling, waypoints or file; absent: rest",
    )
    base_velocity: Twist = Field(
        default=_ZERO_TWIST,
        description="desired velocity of the base in base axes: angular (3) rad/s, linear (3) m/s",
    )
    base_velocity_relative: Flag = Field(
        default=False,
        exclude_if=lambda relative: not relative,
        description="whether base_velocity is relative to a target that moves: at 0 the base moves along as "
        "if fixed to it",
    )
    observed: Flag = Field(
        default=False,
        exclude_if=lambda observed: not observed,
        description="whether q_{D/I} is observed besides q_{D/G}: where the target varies, the cost with "
        "pose_error: paper depends on it",
    )
    geometry: tuple[Shape, ...] = geometry_field("only axes and the ghost of a hand")


class OtherTip(Model):
    """A tip besides the main one: where it is, what it holds, and where it is to be at the end.

    Its part of the cost is quadratic in the vector parts of its error pose q_{D/G}, which to first order are
    half the angle and half the distance: the same whatever the signs of the quaternions. Success asks of it
    what it asks of the main tip.
    """

    name: Name = Field(description="name of the tip, unlike those of links and other tips")
    link: Name = Field(description="link that carries it, or base")
    frame: Pose = Field(
        default_factory=Pose, description="pose of its frame in that of the link (joint frame) or base, m"
    )
    payload: Payload | None = Field(default=None, description="body held rigidly at it; absent: none")
    relative_to: Literal["target", "inertial"] = Field(
        default="target",
        description="'target': its goal is fixed to the target's body, and moves along; 'inertial': in space",
    )
    goal: Pose = Field(description="desired pose of the tip in that frame, m")
    pose: StateWeights6 = Field(
        default=(15.0,) * 6,
        description="running weight on the vector parts of the error pose, rotation then position: one or "
        "6; where the tip is on its link is `frame`",
    )
    terminal_pose: StateWeights6 = Field(
        default=(150.0,) * 6, description="terminal weight on them: one number or 6"
    )


class Cost(Model):
    """Weights of the quadratic cost; the defaults are the paper's. The running terms carry no dt."""

    pose_error: Literal["paper", "relative"] = Field(
        default="paper",
        exclude_if=lambda error: error == "paper",
        description="error of the tip's pose, 8 numbers: 'paper': q_{G/I} - q_{D/I}, whose dual part depends "
        "on where the origin is; 'relative': q_{D/G} - 1, the same wherever base and target are together",
    )
    pose: StateWeights8 = Field(
        default=(15.0,) * 8, description="running weight on the pose error (W_kq): one number or 8"
    )
    terminal_pose: StateWeights8 = Field(
        default=(150.0,) * 8, description="terminal weight on the pose error (W_fq): one number or 8"
    )
    base_velocity: StateWeights6 = Field(
        default=(1.0,) * 6,
        description="running weight on the base velocity error (W_kw), angular then linear: one number or 6",
    )
    terminal_base_velocity: StateWeights6 = Field(
        default=(1.0,) * 6, description="terminal weight on the base velocity error (W_fw): one number or 6"
    )
    tip_twist: StateWeights6 = Field(
        default=(0.0,) * 6,
        exclude_if=lambda weights: not any(weights),
        description="running weight on the tip's twist relative to the target, angular and linear, tip axes, "
        "with the wrist's rates, (s/rad)^2 and (s/m)^2: one number or 6",
    )
    terminal_tip_twist: StateWeights6 = Field(
        default=(0.0,) * 6,
        exclude_if=lambda weights: not any(weights),
        description="terminal weight on the tip's twist relative to the target, angular and linear, "
        "tip axes, with the wrist held, (s/rad)^2 and (s/m)^2: one number or 6",
    )
    base_force: ControlWeights3 = Field(
        default=(10.0,) * 3, description="weight on the base force, 1/N^2: one number or 3"
    )
    base_torque: ControlWeights3 = Field(
        default=(1.0,) * 3, description="weight on the base torque, 1/(N m)^2: one number or 3"
    )
    joint_torque: ControlWeight = Field(
        default=0.01, description="weight on the joint torques, 1/(N m)^2: one number"
    )
    wrist_rate: ControlWeights3 = Field(
        default=(0.1,) * 3, description="weight on the wrist's Euler rates, (s/rad)^2: one number or 3"
    )
    wheel_torque: ControlWeight = Field(
        default=1.0,
        exclude_if=lambda weight: weight == 1.0,
        description="weight on the wheels' torques, 1/(N m)^2: one number",
    )
    thruster_force: ControlWeight = Field(
        default=10.0,
        exclude_if=lambda weight: weight == 10.0,
        description="weight on the thrusters' forces, 1/N^2: one number",
    )


class InitialState(Model):
    """The scene's nominal start."""

    base_pose: Pose = Field(
        default_factory=Pose, description="pose q_{e0/I} of the base in the inertial frame, m"
    )
    joint_angles: Angles = Field(
        default=(),
        description="joint angles, base to tip, one per link, rad (a fixed joint has none, a spherical one "
        "three, a rotation vector in the axes of its frame); empty: zeros",
    )
    wrist_angles: Angles = Field(
        default=(), description="wrist angles psi, theta, phi, rad; empty: zeros, or no wrist"
    )
    base_velocity: Twist = Field(
        default=_ZERO_TWIST,
        description="velocity of the base in base axes: angular (3) rad/s, linear (3) m/s",
    )
    joint_rates: Rates = Field(
        default=(),
        description="joint rates, base to tip, one per link, rad/s (a fixed joint has none, a spherical one "
        "three, in the link's axes); empty: zeros",
    )
    wheel_speeds: Rates = Field(
        default=(),
        exclude_if=lambda speeds: not speeds,
        description="speeds of the wheels relative to the base, one per wheel, rad/s; empty: zeros",
    )
    previous_controls: Loads = Field(
        default=(),
        exclude_if=lambda controls: not controls,
        description="controls before the episode, those whose rates a constraint or a slew_limit limits, in "
        "their order, N, N m, rad/s; empty: zeros",
    )


class Spread(Model):
    """Half-widths of the uniform draws at the start of an episode.

    One number for all components of a part, around the nominal start and target; fractions of the nominal
    masses and inertias, drawn for each body. A quantity without spread is a constant of the machine code.
    """

    base_rotation: AngleSpread = Field(
        default=0.0, description="rotation vector of the base in base axes, rad"
    )
    base_position: LengthSpread = Field(default=0.0, description="position of the base in inertial axes, m")
    joint_angles: AngleSpread = Field(default=0.0, description="joint angles, rad")
    wrist_angles: AngleSpread = Field(default=0.0, description="wrist angles psi, theta, phi, rad")
    base_angular_velocity: RateSpread = Field(
        default=0.0, description="angular velocity of the base, base axes, rad/s"
    )
    base_linear_velocity: RateSpread = Field(
        default=0.0, description="linear velocity of the base, base axes, m/s"
    )
    joint_rates: RateSpread = Field(default=0.0, description="joint rates, rad/s")
    wheel_speeds: RateSpread = Field(
        default=0.0, exclude_if=lambda width: not width, description="speeds of the wheels, rad/s"
    )
    target_rotation: AngleSpread = Field(
        default=0.0, description="rotation vector of the target in its own axes, rad"
    )
    target_position: LengthSpread = Field(
        default=0.0, description="position of the target in inertial axes, m"
    )
    target_angular_velocity: RateSpread = Field(
        default=0.0,
        exclude_if=lambda width: not width,
        description="angular velocity of a target on a screw or tumbling, body axes, rad/s",
    )
    target_linear_velocity: RateSpread = Field(
        default=0.0,
        exclude_if=lambda width: not width,
        description="velocity of a target on a screw (body axes) or tumbling (inertial axes), m/s",
    )
    grasp_rotation: AngleSpread = Field(
        default=0.0,
        exclude_if=lambda width: not width,
        description="rotation vector of the grasp frame in its own axes, rad",
    )
    grasp_position: LengthSpread = Field(
        default=0.0,
        exclude_if=lambda width: not width,
        description="position of the grasp frame in the axes of the target's body, m",
    )
    base_mass: Fraction = Field(default=0.0, description="mass of the base, as a fraction of it")
    base_inertia: Fraction = Field(
        default=0.0, description="inertia of the base about its center of mass, as a fraction of it"
    )
    link_masses: Fraction = Field(default=0.0, description="mass of each link, as a fraction of it")
    link_inertias: Fraction = Field(
        default=0.0, description="inertia of each link about its center of mass, as a fraction of it"
    )
    payload_mass: Fraction = Field(default=0.0, description="mass of the payload, as a fraction of it")
    payload_inertia: Fraction = Field(
        default=0.0, description="inertia of the payload about its center of mass, as a fraction of it"
    )
    observed: Flag = Field(
        default=False,
        exclude_if=lambda observed: not observed,
        description="whether the relative changes of drawn masses and inertias are observed, one number for "
        "each body's mass and inertia",
    )


class Success(Model):
    """Largest errors of the tip at the end of a successful episode."""

    attitude_error_deg: Positive = Field(default=3.0, description="largest attitude error, degrees")
    position_error: Positive = Field(default=0.1, description="largest position error, m")
    angular_velocity_error_deg: Positive | None = Field(
        default=None,
        exclude_if=lambda largest: largest is None,
        description="largest angular velocity of the tip relative to the target with the wrist held, deg/s; "
        "absent: any",
    )
    velocity_error: Positive | None = Field(
        default=None,
        exclude_if=lambda largest: largest is None,
        description="largest velocity of the tip relative to the target, m/s; absent: any",
    )

    @property
    def tolerances(self) -> tuple[float, float, float, float]:
        """Largest errors in degrees, m, deg/s and m/s; infinite where any counts."""
        turning, moving = self.angular_velocity_error_deg, self.velocity_error
        return self.attitude_error_deg, self.position_error, turning or math.inf, moving or math.inf
