"""A scene: the immutable, validated description of a spacecraft with an arm and its maneuver.

Units are SI (m, kg, s, N, N m, rad) unless a field says otherwise. Links go from the base to the tip,
velocities have their angular part first, quaternions their scalar.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, StrictStr, ValidationError, ValidationInfo, field_validator

from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.bodies import BASE, Base, Link, Payload, Wrist, freedoms, parent_bodies
from dq_space_arm_env.scene.constraint_problems import constraint_problems
from dq_space_arm_env.scene.constraint_rows import previous_controls
from dq_space_arm_env.scene.constraints import FRAMES, AnyConstraint
from dq_space_arm_env.scene.integrator_registry import INTEGRATORS
from dq_space_arm_env.scene.maneuver import (
    Actuators,
    Cost,
    InitialState,
    OtherTip,
    Spread,
    Success,
    Target,
    TipWrench,
)
from dq_space_arm_env.scene.motion import Motion, ScrewMotion, Tumbling, Waypoints
from dq_space_arm_env.scene.parameters import (
    ACTUATORS,
    CATCH,
    PHASE,
    control_numbers,
    drawn_factors,
    is_part,
    numbers,
    parents,
)
from dq_space_arm_env.scene.phases import Phase, StagedNumbers, phase_problems, staged_numbers
from dq_space_arm_env.scene.pose import Matrix3, Pose
from dq_space_arm_env.scene.simulation import Simulation
from dq_space_arm_env.scene.thrusters import tank_problems, thruster_problems
from dq_space_arm_env.scene.wheels import wheel_problems
from dq_space_arm_env.validation.changes import ChangeError, merged, nested
from dq_space_arm_env.validation.fields import Name, numbers_of
from dq_space_arm_env.validation.problems import Model, Problem, SceneError, problem_list, raise_problems
from dq_space_arm_env.validation.yaml_text import dump_yaml

_LARGEST_COST = 1e30  # of one actuator: sums and second derivatives stay finite in single precision too
_LARGEST_TURN = 0.2  # rad, of a tumbling target in a time step: its attitude then errs by 1e-6 rad a step
_PLANAR = 'base.motion is "planar"'
# What joints do there whose z axis is across the plane.
_OUT_OF_PLANE = {"spherical": "turns", "prismatic": "slides", "screw": "slides"}
_Location = tuple[str | int, ...]
_GEOMETRY: Mapping[str, Any] = {"geometry": True}
_NOT_CONTENT: Any = {  # words and pictures, which change neither motion nor task
    "name": True,
    "description": True,
    **dict.fromkeys(("base", "payload", "target"), _GEOMETRY),
    "links": {"__all__": _GEOMETRY},
    "other_tips": {"__all__": {"payload": _GEOMETRY}},
}


class Scene(Model):
    """A spacecraft with an arm, its actuators and its maneuver; equations and task are derived from it."""

    name: Name = Field(description="name of the scene")
    description: StrictStr = Field(default="", description="purpose of the scene")
    base: Base = Field(description="the spacecraft")
    links: tuple[Link, ...] = Field(default=(), description="links of arms and appendages, from the base out")
    tip_link: Name | None = Field(
        default=None,
        exclude_if=lambda link: link is None,
        description="link that carries wrist and tip, or base; absent: the last link",
    )
    wrist: Wrist | None = Field(
        default=None, description="massless spherical joint after that link; absent: none"
    )
    tip: Pose = Field(
        default_factory=Pose,
        description="pose of the tip frame G in the wrist frame, m (without wrist: in the joint frame of the "
        "link that carries it, or the base frame)",
    )
    payload: Payload | None = Field(default=None, description="body held rigidly at the tip; absent: none")
    other_tips: tuple[OtherTip, ...] = Field(
        default=(),
        exclude_if=lambda tips: not tips,
        description="tips of other arms, each with a task of its own; absent: none",
    )
    actuators: Actuators = Field(default_factory=Actuators, description="thrusters, wheels and motors")
    tip_wrench: TipWrench | None = Field(
        default=None, description="constant wrench at the tip, tip axes; absent: none"
    )
    target: Target = Field(description="pose that the tip is to reach")
    cost: Cost = Field(default_factory=Cost, description="weights of the quadratic cost")
    initial_state: InitialState = Field(
        default_factory=InitialState, validate_default=True, description="the nominal start"
    )
    spread: Spread = Field(
        default_factory=Spread, description="half-widths of the random draws of each episode"
    )
    parameters: tuple[StrictStr, ...] = Field(
        default=(),
        exclude_if=lambda paths: not paths,
        description="numbers that are inputs of the machine code, besides those with a spread: paths such as "
        "links.0.mass, base.inertia, target.pose, cost, actuators; all others are constants",
    )
    success: Success = Field(
        default_factory=Success, description="tolerances that count as reaching the target"
    )
    phases: tuple[Phase, ...] = Field(
        default=(),
        exclude_if=lambda phases: not phases,
        description="phases of the episode, one after another; absent: one, without changes",
    )
    constraints: tuple[AnyConstraint, ...] = Field(
        default=(),
        exclude_if=lambda constraints: not constraints,
        description="what a maneuver must keep to besides the limits of its actuators; absent: nothing",
    )
    simulation: Simulation = Field(
        default_factory=Simulation, description="time step, number of steps, integrator"
    )

    @property
    def parent_bodies(self) -> tuple[int, ...]:
        """What carries each link: 0 for the base, i + 1 for link i."""
        return tuple(body or 0 for body in parent_bodies(self.links))

    @property
    def tip_body(self) -> int:
        """What carries wrist and tip, likewise."""
        return len(self.links) if self.tip_link is None else self.body_named(self.tip_link)

    def body_named(self, name: str) -> int:
        """Find a body by its name.

        Args:
            name: Of a link, or "base".

        Returns:
            0 for the base, i + 1 for link i.
        """
        return [BASE, *(link.name for link in self.links)].index(name)

    @property
    def staged(self) -> StagedNumbers:
        """What the phases change."""
        return staged_numbers(self)

    @field_validator("initial_state")
    @classmethod
    def _complete_initial_state(cls, start: InitialState, info: ValidationInfo) -> InitialState:
        """Fill in zeros, and check that there is one number per joint."""
        if "links" not in info.data or "wrist" not in info.data:
            return start  # they have problems of their own, which are reported
        links = info.data["links"]
        per_link = "one per link"
        if any(link.freedoms != 1 for link in links):
            per_link += "; none of a fixed joint; of a spherical one three, x, y, z"
        lengths = {
            "joint_angles": (len(freedoms(links)), per_link),
            "joint_rates": (len(freedoms(links)), per_link),
            "wrist_angles": (3, "psi, theta, phi") if info.data["wrist"] else (0, "the scene has no wrist"),
        }
        problems, zeros = [], {}
        for name, (length, why) in lengths.items():
            given = getattr(start, name)
            if not given:
                zeros[name] = (0.0,) * length
            elif len(given) != length:
                problems.append(
                    Problem((name,), given, f"must be {numbers_of(length)} ({why}); it has {len(given)}")
                )
        raise_problems(problems)
        return start.model_copy(update=zeros)

    def _problems(self) -> Iterator[Problem]:
        if tree := [*self._tree_problems()]:
            yield from tree
            return  # others look along the arms
        own = [*self._problems_without_phases()]
        yield from own
        if self.phases:
            yield from phase_problems(self, sound=not own)

    def _problems_without_phases(self) -> Iterator[Problem]:
        yield from self._actuator_problems()
        yield from self._part_problems()
        yield from self._integrator_problems()
        yield from self._tumbling_problems()
        yield from wheel_problems(self)
        yield from thruster_problems(self)
        yield from tank_problems(self)
        yield from self._cost_problems()
        yield from self._parameter_problems()
        found = [*constraint_problems(self)]
        yield from found or self._previous_control_problems()
        if self.base.motion == "planar":
            yield from self._planar_problems()

    def _tree_problems(self) -> Iterator[Problem]:
        """Find links whose parents are not before them, names given twice, and a tip on nothing."""
        names = [link.name for link in self.links]
        for index, (link, parent) in enumerate(zip(self.links, parent_bodies(self.links), strict=True)):
            if parent is None:
                before = ", ".join([BASE, *names[:index]])
                sentence = f"must be the base or a link before this one: {before}"
                yield Problem(("links", index, "parent"), link.parent, sentence)
            if link.name in names[:index]:
                sentence = "another link has this name: each needs its own"
                yield Problem(("links", index, "name"), link.name, sentence)
            elif link.name == BASE:
                yield Problem(("links", index, "name"), link.name, "is the spacecraft's: rename the link")
        if self.tip_link is not None and self.tip_link not in (BASE, *names):
            sentence = f"must be one of {', '.join([BASE, *names])}"
            yield Problem(("tip_link",), self.tip_link, sentence)
        taken = [*names]
        for index, tip in enumerate(self.other_tips):
            here: _Location = ("other_tips", index)
            if tip.link not in (BASE, *names):
                sentence = f"must be one of {', '.join([BASE, *names])}"
                yield Problem((*here, "link"), tip.link, sentence)
            elif tip.link == BASE and tip.payload is not None:
                sentence = "the tip is on the base: add the payload's mass and inertia to the base's"
                yield Problem((*here, "payload"), tip.payload, sentence)
            if tip.name in FRAMES:
                sentence = "is a frame of every scene, which constraints name: rename the tip"
                yield Problem((*here, "name"), tip.name, sentence)
            elif tip.name in taken:
                yield Problem((*here, "name"), tip.name, "another tip, a link or the base has this name")
            taken.append(tip.name)

    def _actuator_problems(self) -> Iterator[Problem]:
        """Find actuators without a part to act on, and limits without motors."""
        wrist_rate, joint_torque = self.actuators.wrist_rate, self.actuators.joint_torque
        if wrist_rate and not self.wrist:
            sentence = "the scene has no wrist: remove it or add a wrist"
            yield Problem(("actuators", "wrist_rate"), wrist_rate, sentence)
        if joint_torque and not self.links:
            sentence = "the scene has no links: remove it or add links"
            yield Problem(("actuators", "joint_torque"), joint_torque, sentence)
        for index, link in enumerate(self.links):
            for field, what in (("torque_limit", "limit"), ("torque_weight", "weight")):
                if (value := getattr(link, field)) is None:
                    continue
                if not joint_torque:
                    sentence = (
                        f"without actuators.joint_torque all joints are passive: add it or remove this {what}"
                    )
                    yield Problem(("links", index, field), value, sentence)
                elif not link.actuated:
                    sentence = f"the joint is not actuated: remove this {what} or actuated: false"
                    yield Problem(("links", index, field), value, sentence)

    def _part_problems(self) -> Iterator[Problem]:
        """Find parts that contradict each other."""
        if self.payload and self.wrist:
            sentence = "the wrist is massless and cannot carry a payload: remove the wrist or the payload"
            yield Problem(("payload",), self.payload, sentence)
        if self.payload and self.tip_body == 0:
            sentence = "the tip is on the base: add the payload's mass and inertia to the base's"
            yield Problem(("payload",), self.payload, sentence)
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
        if self.spread.observed and not any(drawn_factors(self)):
            sentence = "must be false: neither masses nor inertias are drawn"
            yield Problem(("spread", "observed"), True, sentence)
        if self.target.base_velocity_relative and self.target.motion is None:
            sentence = "must be false: the target has no motion to be relative to"
            yield Problem(("target", "base_velocity_relative"), True, sentence)
        for field in ("target_angular_velocity", "target_linear_velocity"):
            half_width = getattr(self.spread, field)
            if half_width and not isinstance(self.target.motion, ScrewMotion | Tumbling):
                sentence = "must be 0: the target is on no screw and does not tumble"
                yield Problem(("spread", field), half_width, sentence)

    def _integrator_problems(self) -> Iterator[Problem]:
        """Find an integrator that does not know quaternions among its angles."""
        name = self.simulation.integrator
        if any(link.is_spherical for link in self.links) and not INTEGRATORS[name].turns_quaternions:
            able = ", ".join(each for each, entry in INTEGRATORS.items() if entry.turns_quaternions)
            sentence = f"has no quaternions among its angles, as spherical joints have: take {able}"
            yield Problem(("simulation", "integrator"), name, sentence)

    def _tumbling_problems(self) -> Iterator[Problem]:
        """Find a tumble too fast for the time step, of which the target takes one step each."""
        motion = self.target.motion
        if isinstance(motion, Tumbling):
            drawn = math.sqrt(3.0) * self.spread.target_angular_velocity
            fastest = motion.rate_growth * (math.hypot(*motion.angular_velocity) + drawn)
            turn = fastest * self.simulation.dt
            if turn > _LARGEST_TURN:
                sentence = (
                    f"the target may turn at {fastest:.3g} rad/s, {turn:.3g} rad in a time step; it must be "
                    f"at most {_LARGEST_TURN:g} rad: lower it or simulation.dt"
                )
                yield Problem(("target", "motion", "angular_velocity"), motion.angular_velocity, sentence)

    def _cost_problems(self) -> Iterator[Problem]:
        """Find weights with which the reward of inputs at their limits would not be a number."""
        for name, controls in control_numbers(self).items():
            limited = [each for each in controls if each.limit.nominal < math.inf]
            costs = [each.weight.nominal * each.limit.nominal**2 for each in limited]
            cost = max(costs, default=0.0) * self.simulation.steps
            if cost > _LARGEST_COST:
                worst = limited[costs.index(max(costs))]
                here: _Location = ("cost", name)
                weight, limit = getattr(self.cost, name), f"actuators.{ACTUATORS[name]}"
                if is_part(worst.weight.name, "links"):
                    index = int(worst.weight.name.split(".")[1])
                    here, weight = ("links", index, "torque_weight"), worst.weight.nominal
                if is_part(worst.limit.name, "links"):
                    limit = worst.limit.name
                sentence = (
                    f"with the limit {worst.limit.nominal:g} and {self.simulation.steps} steps an episode "
                    f"may cost {cost:.3g}, it must be at most {_LARGEST_COST:g}: lower it or {limit}"
                )
                yield Problem(here, weight, sentence)

    def _parameter_problems(self) -> Iterator[Problem]:
        """Find paths that lead to no number that may vary."""
        names = [number.name for number in numbers(self)] if self.parameters else []
        names = [name for name in names if not is_part(name, PHASE) and not is_part(name, CATCH)]
        for index, path in enumerate(self.parameters):
            if not any(is_part(name, path) for name in names):
                paths = dict.fromkeys(part for name in names for part in parents(name))
                sentence = (
                    "such are target.pose, base, links.0, payload, cost, actuators, and what is in them"
                )
                sentence = f"leads to no number that may vary; {did_you_mean(path, paths, sentence)}"
                yield Problem(("parameters", index), path, sentence)

    def _previous_control_problems(self) -> Iterator[Problem]:
        """Find controls before the episode that are not those whose rates are limited."""
        given, place = self.initial_state.previous_controls, ("initial_state", "previous_controls")
        controls = [each for numbers in control_numbers(self).values() for each in numbers]
        limited = [controls[index] for index in previous_controls(self)]
        if given and len(given) != len(limited):
            names = ", ".join(each.name for each in limited) or "nothing limits a control's rate"
            sentence = f"must be {numbers_of(len(limited))} ({names}); it has {len(given)}"
            yield Problem(place, given, sentence)
            return
        for index, value in enumerate(given):
            control = limited[index]
            most = control.limit.nominal
            least = 0.0 if is_part(control.limit.name, "actuators.thrusters") else -most
            if not least <= value <= most:
                sentence = f"must be within the limits of {control.name}, {least:g} to {most:g}"
                yield Problem((*place, index), value, sentence)

    def _planar_problems(self) -> Iterator[Problem]:
        """Find what leaves the x-y plane or turns about another axis than z."""
        if self.wrist is not None:
            yield Problem(("wrist",), self.wrist, f"{_PLANAR}: remove the wrist, it turns out of the plane")
        yield from _inertia_problems(("base", "inertia"), self.base.inertia)
        for index, link in enumerate(self.links):
            here: _Location = ("links", index)
            if leaves := _OUT_OF_PLANE.get(link.joint_type):
                sentence = f"{_PLANAR}: a {link.joint_type} joint {leaves} out of the plane"
                yield Problem((*here, "joint_type"), link.joint_type, sentence)
            yield from _pose_problems((*here, "joint"), link.joint)
            yield from _height_problems((*here, "center_of_mass"), link.center_of_mass)
            yield from _inertia_problems((*here, "inertia"), link.inertia)
        yield from _pose_problems(("tip",), self.tip)
        held: list[tuple[_Location, Payload | None]] = [(("payload",), self.payload)]
        for index, tip in enumerate(self.other_tips):
            here = ("other_tips", index)
            yield from _pose_problems((*here, "frame"), tip.frame)
            yield from _pose_problems((*here, "goal"), tip.goal)
            held.append(((*here, "payload"), tip.payload))
        for location, payload in held:
            if payload is not None:
                yield from _height_problems((*location, "center_of_mass"), payload.center_of_mass)
                yield from _inertia_problems((*location, "inertia"), payload.inertia)
        if self.tip_wrench is not None:
            yield from _height_problems(("tip_wrench", "force"), self.tip_wrench.force)
            if any(self.tip_wrench.torque[:2]):
                sentence = f"{_PLANAR}: only the torque about z may be nonzero"
                yield Problem(("tip_wrench", "torque"), self.tip_wrench.torque, sentence)
        yield from _pose_problems(("target", "pose"), self.target.pose)
        yield from _pose_problems(("target", "grasp"), self.target.grasp)
        yield from _motion_problems(("target", "motion"), self.target.motion)
        yield from _velocity_problems(("target", "base_velocity"), self.target.base_velocity)
        yield from _pose_problems(("initial_state", "base_pose"), self.initial_state.base_pose)
        yield from _velocity_problems(("initial_state", "base_velocity"), self.initial_state.base_velocity)

    def replace(self, changes: Mapping[str, Any] | None = None, /, **sections: Any) -> "Scene":
        """Copy the scene with something changed, and validate it (`model_copy` does not).

        A mapping changes what it names, and leaves the rest of its section; a model or a list replaces all
        of it. None removes a part that may be absent.

            scene.replace({"links.0.mass": 4.0}, simulation={"dt": 0.01}, spread=Spread())

        Args:
            changes: New values by their paths, keys and positions with dots between them.
            **sections: New values of top-level fields.

        Returns:
            The new scene.

        Raises:
            SceneError: If a path leads nowhere, or the new scene is not valid; it lists every problem.
        """
        origin = f"scene {self.name!r}, changed"
        if not isinstance(changes, Mapping | None):
            raise SceneError(f"{origin}: {shortened(changes)}, should be a mapping from paths to new values")
        try:
            named = [*(changes or {}).items(), *sections.items()]
            return type(self).model_validate(merged(self, nested(named)))
        except ValidationError as error:
            raise SceneError(problem_list(origin, error)) from error
        except ChangeError as error:
            raise SceneError(f"{origin}: {error}") from error

    def to_yaml(self, path: str | Path | None = None) -> str:
        """Write the scene with defaults, but for parts that it lacks; loading it gives an equal scene.

        Of a target that passes more than some 280 waypoints the text is longer than `load_scene` takes.

        Args:
            path: File to write, besides returning the text; nothing is written when None.

        Returns:
            The YAML text.
        """
        text = dump_yaml(self.model_dump(exclude_none=True))
        if path is not None:
            write_atomically(Path(path), text)
        return text

    def content_hash(self) -> str:
        """Identify the scene by its content: everything but name, description and geometry.

        Returns:
            SHA-256 of the canonical JSON of all other fields, 64 hexadecimal digits.
        """
        content = self.model_dump(exclude=_NOT_CONTENT)
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()


def _pose_problems(location: _Location, pose: Pose) -> Iterator[Problem]:
    yield from _height_problems((*location, "position"), pose.position)
    if any(pose.rotation[1:3]):
        sentence = f"{_PLANAR}: only rotations about z are possible, so x and y of [w, x, y, z] must be 0"
        yield Problem((*location, "rotation"), pose.rotation, sentence)


def _motion_problems(location: _Location, motion: Motion | None) -> Iterator[Problem]:
    if isinstance(motion, Waypoints):
        for index, point in enumerate(motion.points):
            yield from _pose_problems((*location, "points", index, "pose"), point.pose)
    elif motion is not None:
        yield from _height_problems((*location, "linear_velocity"), motion.linear_velocity)
        if any(motion.angular_velocity[:2]):
            sentence = f"{_PLANAR}: only the angular velocity about z may be nonzero"
            yield Problem((*location, "angular_velocity"), motion.angular_velocity, sentence)
    if isinstance(motion, Tumbling):
        yield from _inertia_problems((*location, "inertia"), motion.inertia)


def _height_problems(location: _Location, vector: tuple[float, float, float]) -> Iterator[Problem]:
    if vector[2] != 0:
        yield Problem(location, vector, f"{_PLANAR}: the z component must be 0")


def _inertia_problems(location: _Location, inertia: Matrix3) -> Iterator[Problem]:
    if inertia[0][2] != 0 or inertia[1][2] != 0:
        yield Problem(location, inertia, f"{_PLANAR}: the products of inertia Ixz and Iyz must be 0")


def _velocity_problems(location: _Location, velocity: tuple[float, ...]) -> Iterator[Problem]:
    if any(velocity[index] for index in (0, 1, 5)):
        sentence = f"{_PLANAR}: only wz, vx and vy (numbers 3, 4 and 5 of 6) may be nonzero"
        yield Problem(location, velocity, sentence)
