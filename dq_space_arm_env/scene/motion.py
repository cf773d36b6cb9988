"""Motions of the target's body: along a screw, tumbling freely, or through given poses."""

import csv
import math
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError

from dq_space_arm_env.common.bounded_reading import UnreadableError, read_text
from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.bodies import Inertia
from dq_space_arm_env.scene.pose import Pose
from dq_space_arm_env.validation.fields import MOST_WAYPOINTS, Finite, Rates3
from dq_space_arm_env.validation.problems import Model, Problem, problem

FILE_COLUMNS = ("time", "q_w", "q_x", "q_y", "q_z", "x", "y", "z")
"""Columns of a file of poses: s, the rotation as unit quaternion, the position in m."""


class ScrewMotion(Model):
    """A constant twist: rotation about a fixed axis, and translation along it."""

    kind: Literal["screw"] = Field(description="'screw'")
    angular_velocity: Rates3 = Field(
        default=(0.0, 0.0, 0.0), description="angular velocity of the body, body axes, rad/s"
    )
    linear_velocity: Rates3 = Field(
        default=(0.0, 0.0, 0.0), description="velocity of the body's origin, body axes, m/s"
    )


class Tumbling(Model):
    """A free rigid body whose frame has its origin at the center of mass."""

    kind: Literal["tumbling"] = Field(description="'tumbling'")
    inertia: Inertia = Field(
        description="inertia about the center of mass, body axes, in any unit: its scale does not matter; "
        "3 numbers (diagonal) or 3x3"
    )
    angular_velocity: Rates3 = Field(
        default=(0.0, 0.0, 0.0), description="angular velocity at the start, body axes, rad/s"
    )
    linear_velocity: Rates3 = Field(
        default=(0.0, 0.0, 0.0), description="velocity of the center of mass, inertial axes, m/s"
    )

    @property
    def rate_growth(self) -> float:
        """Bound of the angular velocity later, relative to that now: energy is kept."""
        moments = np.linalg.eigvalsh(np.array(self.inertia))
        return math.sqrt(moments[-1] / moments[0])


class Waypoint(Model):
    """A pose at a time."""

    time: Finite = Field(description="time from the start of the episode, s")
    pose: Pose = Field(description="pose of the body in the inertial frame, m")


class Waypoints(Model):
    """Given poses, with a screw motion of constant twist between neighbors, and rest before and after.

    From the target's pose at the start the body moves as the given poses do from theirs: to pass through
    them, it starts at theirs.
    """

    kind: Literal["waypoints"] = Field(description="'waypoints'")
    points: tuple[Waypoint, ...] = Field(
        description="poses with their times, in order; at least one; a `file` of them is read into this list"
    )

    def _problems(self) -> Iterator[Problem]:
        if not 1 <= len(self.points) <= MOST_WAYPOINTS:
            sentence = f"has {len(self.points)} poses; must have from 1 to {MOST_WAYPOINTS:,}"
            yield Problem(("points",), len(self.points), sentence)
        for index, (before, after) in enumerate(zip(self.points, self.points[1:], strict=False)):
            if after.time <= before.time:
                sentence = f"must be later than the time before it, {before.time:g} s"
                yield Problem(("points", index + 1, "time"), after.time, sentence)


_KINDS: dict[str, type[Model]] = {"screw": ScrewMotion, "tumbling": Tumbling, "waypoints": Waypoints}


def _read_motion(value: Any) -> Any:
    """Read a motion by its kind; a file of poses becomes waypoints."""
    if isinstance(value, tuple(_KINDS.values())) or value is None:
        return value
    kind = value.get("kind") if isinstance(value, dict) else None
    if kind == "file":
        return _read_file(value)
    if not isinstance(kind, str) or kind not in _KINDS:
        wanted = f"must be a mapping whose kind is one of {', '.join(_KINDS)}, file; or absent: at rest"
        raise problem(did_you_mean(str(kind), [*_KINDS, "file"], wanted))
    return _KINDS[kind].model_validate(value)


def _read_file(value: dict[str, Any]) -> Waypoints:
    """Read poses from a text file with a header line, columns `FILE_COLUMNS`, separated by commas."""
    others = sorted(set(value) - {"kind", "path"})
    path = value.get("path")
    if others or not isinstance(path, str | Path):
        raise problem("must have a kind, file, and a path, that of a file of poses; nothing else")
    try:
        text = read_text(Path(path)).removeprefix("\ufeff")  # which Excel writes first
        rows = [*enumerate(csv.reader(StringIO(text)), start=1)]
    except (OSError, UnreadableError, csv.Error) as error:
        raise problem(f"cannot be read: {error}") from error
    if not rows or tuple(name.strip() for name in rows[0][1]) != FILE_COLUMNS:
        raise problem(f"the first line of {path} must be {','.join(FILE_COLUMNS)}")
    rows, points = [(number, row) for number, row in rows[1:] if row], []  # empty lines say nothing
    for number, row in rows:
        try:
            time, *pose = (float(entry) for entry in row)
        except ValueError:
            pose, time = [], math.nan
        if len(pose) != len(FILE_COLUMNS) - 1:
            raise problem(f"line {number} of {path} must be {len(FILE_COLUMNS)} numbers")
        points.append({"time": time, "pose": {"rotation": pose[:4], "position": pose[4:]}})
    try:
        return Waypoints.model_validate({"kind": "waypoints", "points": points})
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        if len(detail["loc"]) == 1:
            raise
        index = int(detail["loc"][1])
        what = detail["msg"].removeprefix(f"points[{index}].")
        raise problem(f"line {rows[index][0]} of {path}: {what}") from None


Motion = Annotated[ScrewMotion | Tumbling | Waypoints, BeforeValidator(_read_motion)]
