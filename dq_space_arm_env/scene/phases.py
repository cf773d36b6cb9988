"""Phases of an episode: what the tip holds, masses, actuators, cost and target change from one to the next.

A phase changes numbers of the scene, which thereby become parameters of the stages: inputs of the one machine
code. At its start the payload may be caught.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.maneuver import Success
from dq_space_arm_env.scene.parameters import (
    ACTUATORS,
    control_numbers,
    drawn_factors,
    has_target_spread,
    numbers,
    parents,
    target_numbers,
)
from dq_space_arm_env.validation.changes import list_position
from dq_space_arm_env.validation.fields import Name, Steps
from dq_space_arm_env.validation.problems import Model, Problem, SceneError, problem

Scene = Any  # `schema.Scene`, which has phases

_REMOVABLE = ("payload", "target.motion")
_ACTUATORS = "actuators."


def _read_changes(value: Any) -> tuple[tuple[str, Any], ...]:
    """Flatten mappings within mappings into paths with their values, sorted."""
    if isinstance(value, tuple):  # read before
        return value
    if not isinstance(value, Mapping):
        raise problem("must be a mapping from paths, such as base.mass, to new values")
    changes = sorted(_flat(value.items()), key=lambda change: change[0])
    for (path, _), (following, _) in pairwise(changes):
        if path == following:
            raise problem(f"gives {path} twice")
    return tuple(changes)


def _flat(items: Iterable[tuple[Any, Any]], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in items:
        inner = value.model_dump(exclude_unset=True) if isinstance(value, Model) else value
        if isinstance(inner, Mapping) and inner:
            yield from _flat(inner.items(), f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", _plain(f"{prefix}{key}", inner)


def _plain(path: str, value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(_plain(path, entry) for entry in value)
    if isinstance(value, float):
        return value + 0.0  # no -0.0: equal scenes have equal content hashes
    if value is None or isinstance(value, bool | int | str):
        return value
    raise problem(f"{path} must be numbers or null, each by its path, such as links.0.mass")


Changes = Annotated[
    tuple[tuple[str, Any], ...],
    BeforeValidator(_read_changes),
    PlainSerializer(lambda changes: dict(changes)),
]


class Phase(Model):
    """A part of the episode with numbers of its own."""

    name: Name = Field(description="name of the phase, unique in the scene")
    steps: Steps = Field(description="number of time steps; those of all phases add up to simulation.steps")
    catch: Success | None = Field(
        default=None,
        exclude_if=lambda tolerances: tolerances is None,
        description="tolerances of the tip within which the payload, which moves with the target until then, "
        "is caught as the phase begins; absent: nothing is caught",
    )
    changes: Changes = Field(
        default=(),
        description="numbers of the scene that differ in this phase, by their paths; payload, an actuator "
        "such as actuators.base_force, or target.motion may be null: nothing held, out of work, at rest",
    )


class StagedNumbers(NamedTuple):
    """What the phases of a scene change."""

    starts: tuple[int, ...]  # first stage of each phase
    values: dict[str, tuple[float, ...]]  # by name, a value for each phase, of those that any changes
    resting: tuple[tuple[float, ...] | None, ...]  # pose of a target at rest in a phase; None where it moves
    catches: tuple[bool, ...]  # whether a phase begins with a catch


@lru_cache(maxsize=64)
def staged_numbers(scene: Scene) -> StagedNumbers:
    """Find what the phases of a scene change; SceneError for what none may."""
    starts, every, resting = [0], [], []
    for phase in scene.phases:
        starts.append(starts[-1] + phase.steps)
        own, removed = phase_scene(scene, phase)
        moves = scene.target.motion is not None and own.target.motion is not None
        resting.append(None if moves else own.target.pose.dual_quaternion)
        every.append(
            {number.name: 0.0 if _is_in(number.name, removed) else number.nominal for number in numbers(own)}
        )
    own_values = {number.name: number.nominal for number in numbers(scene.replace(phases=()))}
    moving = ("target.pose", "target.velocity") if scene.target.motion is not None else ()
    values = {
        name: tuple(each[name] for each in every)
        for name in (every[0] if every else {})
        if not _is_in(name, moving) and len({own_values[name], *(each[name] for each in every)}) > 1
    }
    if any(_is_in(name, ("target.pose",)) for name in values):  # a pose changes as a whole
        values |= {
            name: tuple(each[name] for each in every) for name in every[0] if _is_in(name, ("target.pose",))
        }
    if every:
        values = {"phase": tuple(float(index) for index in range(len(every))), **values}
    catches = tuple(phase.catch is not None for phase in scene.phases)
    return StagedNumbers(tuple(starts[:-1]), values, tuple(resting), catches)


def phase_scene(scene: Scene, phase: Phase) -> tuple[Scene, tuple[str, ...]]:
    """The scene with the numbers of a phase, and the names of those that are zero in it."""
    changes, removed, idle = {}, list[str](), set[str]()
    for path, value in phase.changes:
        if value is None and path == "payload":
            removed.append(path)
        elif value is None and path.startswith(_ACTUATORS):
            idle.add(path.removeprefix(_ACTUATORS))
        else:
            changes[path] = value
            if path == "target.motion":  # at rest, nothing of it is drawn
                changes |= dict.fromkeys(
                    ("spread.target_angular_velocity", "spread.target_linear_velocity"), 0.0
                )
                changes["target.base_velocity_relative"] = False
    own = scene.replace({**changes, "phases": ()})
    controls = control_numbers(own)
    removed += [
        each.limit.name for field, part in ACTUATORS.items() if part in idle for each in controls[field]
    ]
    return own, tuple(removed)


def phases_change_masses(scene: Scene) -> bool:
    """Tell whether masses or inertias are not the same all the time, or what the tip holds."""
    paths = (path for phase in scene.phases for path, _ in phase.changes)
    return any(path == "payload" or "mass" in path or "inertia" in path for path in paths)


def _is_in(name: str, paths: Iterable[str]) -> bool:
    return any(name == path or name.startswith(path + ".") for path in paths)


def phase_problems(scene: Scene, sound: bool = True) -> Iterator[Problem]:
    """Find mistakes in the phases of a scene; of one that is not sound otherwise, only in their lengths."""
    total = sum(phase.steps for phase in scene.phases)
    if total != scene.simulation.steps:
        sentence = (
            f"have {total} steps together, the simulation has {scene.simulation.steps}: make them equal"
        )
        yield Problem(("phases",), total, sentence)
    taken = [phase.name for phase in scene.phases]
    for index, name in enumerate(taken):
        if name in taken[:index]:
            yield Problem(("phases", index, "name"), name, "another phase has this name: each needs its own")
    if not sound:
        return  # changes make scenes, all with the mistakes of this one
    names = {number.name for number in numbers(scene.replace(phases=()))}
    moves = valid = True
    held: list[bool] = []  # whether the tip holds the payload, phase by phase
    for index, phase in enumerate(scene.phases):
        here: tuple[str | int, ...] = ("phases", index, "changes")
        wrong = [*_change_problems(scene, phase, here, names)]
        yield from wrong
        if wrong:
            valid = False
            continue
        try:
            own, removed = phase_scene(scene, phase)
        except SceneError as error:
            valid = False
            yield Problem(here, dict(phase.changes), f"makes no valid scene: {error}")
            continue
        own_names = {number.name for number in numbers(own)}
        rests = scene.target.motion is not None and own.target.motion is None
        still = {name for name in names if _is_in(name, ("target.velocity",))} if rests else set[str]()
        if unlike := sorted((own_names | still) ^ names):
            valid = False
            if _is_in(unlike[0], ("cost",)):
                what = "a term of the cost: give its weight a number other than 0 in the scene"
            else:
                what = f"{unlike[0]}: give it a number other than 0, however small"
            yield Problem(here, dict(phase.changes), f"adds or removes {what}")
        if rests and index == 0:
            yield Problem(here, dict(phase.changes), "stops the target before it moves: remove target.motion")
        if not rests and not moves:
            yield Problem(
                here, dict(phase.changes), "moves a target that came to rest: keep target.motion null"
            )
        moves = not rests
        posed = next((path for path, _ in phase.changes if _is_in(path, ("target.pose",))), None)
        if posed is not None and own.target.motion is not None:
            sentence = "has no effect on a target that moves: it needs target.motion: null beside it"
            yield Problem((*here, posed), dict(phase.changes)[posed], sentence)
        held.append(scene.payload is not None and "payload" not in removed)
        if sentence := _catch_flaw(phase.catch is not None, held):
            yield Problem(("phases", index, "catch"), phase.catch, sentence)
    if valid and scene.payload is not None and held and not any(held):
        yield Problem(("phases",), len(held), "never hold the payload: leave it out of the scene")
    if valid:
        yield from _drawn_problems(scene)


def _catch_flaw(catches: bool, held: Sequence[bool]) -> str:
    """Say what is wrong with the catch of the last of some phases, each of which holds the payload or not."""
    gains = list(held[-2:]) == [False, True]
    if gains and not catches:
        return (
            "must be given: the phase before holds no payload and this one does; its tolerances, such as "
            "position_error: 0.01, say within what the payload is caught"
        )
    if gains and any(held[:-1]):
        return (
            "must be in no phase after one that holds the payload: once let go, it drifts and does not "
            "move with the target"
        )
    if gains or not catches:
        return ""
    if not held[-1]:
        return "must be absent: this phase holds no payload"
    if len(held) == 1:
        return "must be absent: the first phase holds the payload from the start"
    return "must be absent: the phase before already holds the payload"


def _change_problems(
    scene: Scene, phase: Phase, here: tuple[str | int, ...], names: set[str]
) -> Iterator[Problem]:
    """Find changes that phases cannot make."""
    for path, value in phase.changes:
        removable = [*_REMOVABLE, *(_ACTUATORS + field for field in _FIELDS)]
        if value is None and path not in removable:
            sentence = "only payload, actuators or target.motion may be null"
            yield Problem((*here, path), value, did_you_mean(path, removable, sentence))
        elif path == "payload" and scene.payload is None:
            yield Problem((*here, path), value, "the scene has no payload")
        elif value is None and path.startswith(_ACTUATORS) and _value_at(scene, path) is None:
            yield Problem((*here, path), value, f"the scene has no {path}")
        elif value is not None and _is_in(path, ("payload",)):
            yield Problem((*here, path), value, "the payload is held as it is, or not at all: payload: null")
        elif value is not None and not _may_change(path, names):
            yield Problem((*here, path), value, _why_not(scene, path, names))


def _why_not(scene: Scene, path: str, names: set[str]) -> str:
    """Say why phases cannot change what a path leads to."""
    such = "such are base.mass, links.0.mass, cost.pose, target.pose"
    present = _value_at(scene, path)
    if present is None:
        first, _, rest = path.partition(".")
        positions = {link.name: str(index) for index, link in enumerate(scene.links)}
        name = next((name for name in positions if rest.startswith(f"{name}.")), None)
        if first == "links" and name is not None:
            meant = f"links.{positions[name]}{rest.removeprefix(name)}"
            if meant in names:
                return f"links go by their positions, from 0: did you mean {meant!r}?"
        paths = {part for name in names for part in parents(name) if _may_change(part, names)}
        known = sorted(part for part in paths if _value_at(scene, part) is not None)
        return f"leads to no number that phases change; {did_you_mean(path, known, such)}"
    if _is_in(path, ("cost",)) and not np.any(present):
        return "its weight is 0 in the scene, which leaves the term out: give it a small number there"
    return f"is the same in all phases; they change other numbers: {such}; an actuator may be null"


def _value_at(scene: Scene, path: str) -> Any:
    """What a path leads to in the scene; None for nothing."""
    here: Any = scene
    for key in path.split("."):
        position = list_position(key)
        if isinstance(here, tuple) and position is not None and position < len(here):
            here = here[position]
        elif isinstance(here, Model) and key in type(here).model_fields:
            here = getattr(here, key)
        else:
            return None
    return here


def _drawn_problems(scene: Scene) -> Iterator[Problem]:
    """Find numbers that phases change and a spread draws."""
    drawn = {number.name for _, group in drawn_factors(scene) for number in group}
    drawn |= {number.name for number in target_numbers(scene)} if has_target_spread(scene) else set()
    both = sorted(drawn & staged_numbers(scene).values.keys())
    if both:
        yield Problem(("phases",), both[0], "phases change it, so it can have no spread")


_FIELDS = tuple(ACTUATORS.values())


def _may_change(path: str, names: set[str]) -> bool:
    """Whether a path leads to numbers that may be parameters of a stage."""
    if _is_in(path, ("target.pose",)):
        return True
    if _is_in(path, ("actuators", "target", "phases", "parameters", "spread")):
        return False
    inner = re.sub(r"(\.\d+)+$", "", path)  # an entry of a list has a name
    return any(_is_in(name, (inner,)) or _is_in(inner, (name,)) for name in names)
