"""The scene: one immutable, validated description of a spacecraft with an arm and of its maneuver.

Units are SI (m, kg, s, N, N m, rad) unless a field says otherwise. Links go from the base to the tip,
velocities have their angular part first, quaternions their scalar.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, StrictStr, ValidationInfo, field_validator

from dq_space_arm_env.scene._fields import Count, Positive
from dq_space_arm_env.scene._planar import planar_problems
from dq_space_arm_env.scene._problems import Model, Problem, did_you_mean, problem, raise_problems
from dq_space_arm_env.scene._yaml import dump_yaml
from dq_space_arm_env.scene.bodies import Base, Link, Payload, Wrist
from dq_space_arm_env.scene.pose import AxisAngle, Pose
from dq_space_arm_env.scene.task import (
    Actuators,
    AxisLimits,
    Cost,
    InitialState,
    JointLimit,
    Spread,
    Success,
    Target,
    TipWrench,
)

__all__ = [
    "ADAPTIVE_INTEGRATORS",
    "CURVED_INTEGRATORS",
    "INTEGRATORS",
    "Actuators",
    "AxisAngle",
    "AxisLimits",
    "Base",
    "Cost",
    "InitialState",
    "JointLimit",
    "Link",
    "Payload",
    "Pose",
    "Scene",
    "Simulation",
    "Spread",
    "Success",
    "Target",
    "TipWrench",
    "Wrist",
]

INTEGRATORS = (
    "symplectic_euler",
    "rk4",
    "rk6",
    "rk8",
    "dormand_prince",
    "rodas4",
    "rodas5p",
    "momentum_rk4",
    "momentum_rosenbrock",
)
CURVED_INTEGRATORS = ("symplectic_euler", "rk4")
"""Those whose steps have second derivatives, which Newton's method for optimal control needs."""
ADAPTIVE_INTEGRATORS = ("dormand_prince",)
"""Those that divide a time step as far as tolerances ask for."""

TOLERANCES = {"float64": (1e-8, 1e-10), "float32": (1e-5, 1e-6)}
"""Relative and absolute tolerance of adaptive integrators where a scene gives none, by precision."""
SMALLEST_SINGLE_RTOL = 1e-6
"""Relative tolerance that rounding in single precision leaves within reach."""


class Simulation(Model):
    """How time is discretized."""

    dt: Positive = Field(default=0.015, description="time step, s")
    steps: Count = Field(default=1000, description="number of time steps of an episode")
    integrator: StrictStr = Field(default="rk4", description="name of the integrator")
    precision: Literal["float64", "float32"] = Field(
        default="float64",
        description="numbers that the machine code computes with: 'float64', or 'float32', about twice as "
        "fast in batches and right to six digits",
    )
    formulation: Literal["articulated_body", "minimal_coordinates"] | None = Field(
        default=None,
        description="how accelerations are solved for: 'articulated_body', joint by joint, or "
        "'minimal_coordinates', with the mass matrix, where a base lighter than its arm loses digits; "
        "absent: the faster one, which is articulated_body unless the integrator keeps the momentum",
    )
    rtol: Positive | None = Field(
        default=None,
        description="relative tolerance of an adaptive integrator, of velocities and, in rad and m, of pose "
        "and angles; absent: 1e-8, or 1e-5 in single precision",
    )
    atol: Positive | None = Field(
        default=None,
        description="absolute tolerance of an adaptive integrator, rad, m, rad/s, m/s; absent: 1e-10, or "
        "1e-6 in single precision",
    )

    @field_validator("integrator")
    @classmethod
    def _is_known(cls, name: str) -> str:
        if name not in INTEGRATORS:
            raise problem(
                f"unknown; {did_you_mean(name, INTEGRATORS)}It must be one of {', '.join(INTEGRATORS)}"
            )
        return name

    def _problems(self) -> Iterator[Problem]:
        """Find tolerances that nothing asks for, or that single precision cannot keep."""
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if value is not None and self.integrator not in ADAPTIVE_INTEGRATORS:
                adaptive = " or ".join(ADAPTIVE_INTEGRATORS)
                sentence = f"{self.integrator} takes fixed steps: remove it, or set integrator to {adaptive}"
                yield Problem((name,), value, sentence)
        if self.precision == "float32" and self.rtol is not None and self.rtol < SMALLEST_SINGLE_RTOL:
            sentence = f"must be at least {SMALLEST_SINGLE_RTOL:g} in single precision"
            yield Problem(("rtol",), self.rtol, sentence)

    @property
    def tolerances(self) -> tuple[float, float]:
        """Relative and absolute tolerance of an adaptive integrator."""
        rtol, atol = TOLERANCES[self.precision]
        return (rtol if self.rtol is None else self.rtol, atol if self.atol is None else self.atol)


class Scene(Model):
    """A spacecraft with an arm, its actuators and its maneuver; equations and task are derived from it."""

    name: StrictStr = Field(min_length=1, description="name of the scene")
    description: StrictStr = Field(default="", description="what the scene is for")
    base: Base = Field(description="the spacecraft")
    links: tuple[Link, ...] = Field(default=(), description="links of the arm, base to tip")
    wrist: Wrist | None = Field(
        default=None, description="massless spherical joint after the last link; absent: none"
    )
    tip: Pose = Field(
        default_factory=Pose,
        description="pose of the tip frame G in the wrist frame, m (without wrist: last link's joint frame; "
        "without links too: base frame)",
    )
    payload: Payload | None = Field(default=None, description="body held rigidly at the tip; absent: none")
    actuators: Actuators = Field(default_factory=Actuators, description="what can be commanded")
    tip_wrench: TipWrench | None = Field(
        default=None, description="constant wrench at the tip, tip axes; absent: none"
    )
    target: Target = Field(description="where the tip should go")
    cost: Cost = Field(default_factory=Cost, description="weights of the quadratic cost")
    initial_state: InitialState = Field(
        default_factory=InitialState, validate_default=True, description="the nominal start"
    )
    spread: Spread = Field(
        default_factory=Spread, description="half-widths of what is drawn at random for each episode"
    )
    success: Success = Field(default_factory=Success, description="what counts as reaching the target")
    simulation: Simulation = Field(
        default_factory=Simulation, description="time step, number of steps, integrator"
    )

    @field_validator("initial_state")
    @classmethod
    def _complete_initial_state(cls, start: InitialState, info: ValidationInfo) -> InitialState:
        """Fill in zeros where nothing was given, and check that there is one number per joint."""
        if "links" not in info.data or "wrist" not in info.data:
            return start  # they have problems of their own, which are reported
        lengths = {
            "joint_angles": (len(info.data["links"]), "one per link"),
            "joint_rates": (len(info.data["links"]), "one per link"),
            "wrist_angles": (3, "psi, theta, phi") if info.data["wrist"] else (0, "the scene has no wrist"),
        }
        problems, zeros = [], {}
        for name, (length, why) in lengths.items():
            given = getattr(start, name)
            if not given:
                zeros[name] = (0.0,) * length
            elif len(given) != length:
                problems.append(
                    Problem((name,), given, f"must be {length} numbers ({why}); it has {len(given)}")
                )
        raise_problems(problems)
        return start.model_copy(update=zeros)

    def _problems(self) -> Iterator[Problem]:
        yield from self._actuator_problems()
        yield from self._part_problems()
        if self.base.motion == "planar":
            yield from planar_problems(self)

    def _actuator_problems(self) -> Iterator[Problem]:
        """Find actuators without anything to act on, and limits without motors."""
        wrist_rate, joint_torque = self.actuators.wrist_rate, self.actuators.joint_torque
        if wrist_rate and not self.wrist:
            sentence = "the scene has no wrist: remove it or add a wrist"
            yield Problem(("actuators", "wrist_rate"), wrist_rate, sentence)
        if joint_torque and not self.links:
            sentence = "the scene has no links: remove it or add links"
            yield Problem(("actuators", "joint_torque"), joint_torque, sentence)
        for index, link in enumerate(self.links):
            location = ("links", index, "torque_limit")
            if link.torque_limit is not None and not joint_torque:
                sentence = (
                    "without actuators.joint_torque all joints are passive: add it or remove this limit"
                )
                yield Problem(location, link.torque_limit, sentence)
            elif link.torque_limit is not None and not link.actuated:
                sentence = "the joint is not actuated: remove this limit or actuated: false"
                yield Problem(location, link.torque_limit, sentence)

    def _part_problems(self) -> Iterator[Problem]:
        """Find parts that contradict each other."""
        if self.payload and self.wrist:
            sentence = "the wrist is massless and cannot carry a payload: remove the wrist or the payload"
            yield Problem(("payload",), self.payload, sentence)
        names = [link.name for link in self.links]
        for index, name in enumerate(names):
            if name in names[:index]:
                sentence = "another link has this name: each needs its own"
                yield Problem(("links", index, "name"), name, sentence)
        spreads: dict[str, tuple[object, str]] = {
            "wrist_angles": (self.wrist, "wrist"),
            "joint_angles": (self.links, "links"),
            "joint_rates": (self.links, "links"),
            "link_masses": (self.links, "links"),
            "link_inertias": (self.links, "links"),
            "payload_mass": (self.payload, "payload"),
            "payload_inertia": (self.payload, "payload"),
        }
        for field, (part, part_name) in spreads.items():
            half_width = getattr(self.spread, field)
            if half_width and not part:
                yield Problem(("spread", field), half_width, f"must be 0: the scene has no {part_name}")

    def replace(self, **changes: Any) -> "Scene":
        """Make a scene that differs in some fields, and validate it (`model_copy` does not).

        Args:
            **changes: New values of top-level fields, as models or as plain data.

        Returns:
            The new scene.

        Raises:
            ValidationError: If the new scene is not valid.
        """
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self).model_validate({**fields, **changes})

    def to_yaml(self, path: str | Path | None = None) -> str:
        """Write the scene with every default filled in; loading it gives an equal scene.

        Args:
            path: File to write, besides returning the text; nothing is written when None.

        Returns:
            The YAML text.
        """
        text = dump_yaml(self.model_dump(exclude_none=True))
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def content_hash(self) -> str:
        """Identify the scene by its content: everything but name and description.

        Returns:
            SHA-256 of the canonical JSON of all other fields, 64 hexadecimal digits.
        """
        content = self.model_dump(exclude={"name", "description"})
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()
