"""Drives of the joints: motors with rotor, gear and friction."""

from collections.abc import Iterator
from typing import Literal

from pydantic import Field

from dq_space_arm_env.validation.fields import Gear, MomentOfInertia, NonNegative, Speed
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
        default=0.0, description="Coulomb friction of the joint, N m (N); it is smooth: tanh(rate / speed)"
    )
    friction_speed: Speed = Field(
        default=0.01, description="speed in it, at which it reaches 76 %, rad/s (m/s)"
    )

    @property
    def reflected_inertia(self) -> float:
        """N^2 J_r, the rotor's inertia about the joint, kg m^2 (kg)."""
        return self.gear * self.gear * self.inertia

    def _problems(self) -> Iterator[Problem]:
        if not (self.inertia or self.friction):
            yield Problem(("inertia",), self.inertia, "a motor needs an inertia or friction: remove it")
