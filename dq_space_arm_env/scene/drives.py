"""Drives of the joints: motors with rotor, gear, friction, and the torque that full voltage leaves."""

from collections.abc import Iterator
from typing import Any, Literal

from pydantic import Field

from dq_space_arm_env.validation.fields import Gear, MomentOfInertia, NonNegative, Positive, Speed
from dq_space_arm_env.validation.problems import Model, Problem


class Motor(Model):
    """The motor of a joint: its rotor turns N times per radian of the joint, on the body before the joint."""

    inertia: MomentOfInertia = Field(
        default=0.0,
        description="inertia J_r of the rotor about its axis, which the body before the joint does not "
        "include, kg m^2",
    )
    gear: Gear = Field(
        default=1.0,
        description="gear ratio N, turns of the rotor per turn of the joint, negative if it turns backward, "
        "1 (prismatic: rad/m)",
    )
    coupling: Literal["exact", "armature"] = Field(
        default="exact",
        description="'exact': the rotor turns with the body that carries it too; 'armature': it adds N^2 J_r "
        "to the inertia of the joint alone, as MuJoCo and Pinocchio have it",
    )
    friction: NonNegative = Field(
        default=0.0,
        description="Coulomb friction on the joint's side, N m (N), of the motor if the gear is elastic; it "
        "is smooth: tanh(rate / speed)",
    )
    friction_speed: Speed = Field(
        default=0.01, description="speed in it, at which it reaches 76 %, rad/s (m/s)"
    )
    stiffness: Positive | None = Field(
        default=None,
        exclude_if=lambda stiffness: stiffness is None,
        description="stiffness of the gear between rotor and link, N m/rad (N/m): angle and rate of the "
        "motor are states then, on the joint's side; absent: rigid",
    )
    damping: NonNegative = Field(
        default=0.0,
        exclude_if=lambda damping: not damping,
        description="viscous damping of an elastic gear, N m s/rad (N s/m)",
    )
    stall_torque: Positive | None = Field(
        default=None,
        exclude_if=lambda torque: torque is None,
        description="torque at full voltage of the motor at rest, on the joint's side, N m (N): it falls "
        "with the speed by the back EMF; absent: at any speed the limit of the torque, which stands for that "
        "of the current",
    )
    no_load_speed: Speed | None = Field(
        default=None,
        exclude_if=lambda speed: speed is None,
        description="speed at full voltage at which no torque is left, on the joint's side, rad/s (m/s)",
    )

    @property
    def reflected_inertia(self) -> float:
        """N^2 J_r, the rotor's inertia about the joint, kg m^2 (kg)."""
        return self.gear * self.gear * self.inertia

    def envelope(self, rate: Any) -> tuple[Any, Any] | None:
        """Least and greatest torque at a speed.

        Args:
            rate: Of the motor, on the joint's side, a scalar, rad/s (m/s).

        Returns:
            Both, N m (N); None where they do not depend on the speed.
        """
        if self.stall_torque is None or self.no_load_speed is None:
            return None
        # tau = N k (+-V - N k rate) / R: back EMF N k rate, resistance R, stall torque N k V / R.
        fallen = (self.stall_torque / self.no_load_speed) * rate
        return -self.stall_torque - fallen, self.stall_torque - fallen

    @property
    def is_elastic(self) -> bool:
        """Whether the gear is a spring."""
        return self.stiffness is not None

    @property
    def varying(self) -> list[str]:
        """The numbers that may be parameters, those that are not 0: others are not in the machine code."""
        return [name for name in ("inertia", "friction", "stiffness", "damping") if getattr(self, name)]

    def _problems(self) -> Iterator[Problem]:
        if not (self.inertia or self.friction or self.stall_torque):
            sentence = "a motor needs an inertia, friction or stall_torque: remove it"
            yield Problem(("inertia",), self.inertia, sentence)
        elif self.is_elastic and not self.inertia:
            sentence = "the rotor behind an elastic gear needs an inertia: give it, or remove stiffness"
            yield Problem(("inertia",), self.inertia, sentence)
        if self.is_elastic and self.coupling != "armature":
            sentence = (
                "the rotor behind an elastic gear moves relative to its carrier alone (Spong's reduced "
                "model): set it to armature"
            )
            yield Problem(("coupling",), self.coupling, sentence)
        if (self.stall_torque is None) != (self.no_load_speed is None):
            sentence = "stall_torque and no_load_speed need each other"
            yield Problem(("no_load_speed",), self.no_load_speed, sentence)
        if self.damping and not self.is_elastic:
            sentence = "a rigid gear has none: give a stiffness too, or damping of the link"
            yield Problem(("damping",), self.damping, sentence)
