"""The record of a maneuver, flown or planned, and its file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.bounded_formats import read_arrays
from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.scene.loading import load_scene
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.validation.problems import SceneError

FloatArray = NDArray[np.float64]

_REQUIRED, _OPTIONAL = ("states", "controls"), ("noise", "rewards", "target", "target_body", "payload")
_LONGEST = 200  # characters of a sentence about an array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A maneuver of M steps as it was flown or planned.

    Attributes:
        label: Name in tables and plots.
        states: Shape (M + 1, n_x), units of the state.
        controls: Commanded inputs, constant over a step, shape (M, n_u), N, N m or rad/s.
        noise: Disturbance added to them at the actuators, shape (M, n_u), same units; None for none.
        rewards: Shape (M,), dimensionless; None if unknown.
        target: Desired pose of the tip q_{D/I}, shape (8,), or (M + 1, 8) if it moves, one for each state,
            dimensionless and m; None for the scene's.
        target_body: Pose of the target's body in the inertial frame, shape (8,) or (M + 1, 8), dimensionless
            and m; None if it is the desired pose of the tip.
        payload: Pose of the payload's frame, which is that of the tip that holds it, in the inertial frame,
            shape (M + 1, 8), dimensionless and m; None if it is where the scene's phases have it.
        scene: The scene; None if unknown.
        start: The initial state in words.
        seed: Seed of the episode; None without one.
        attitude_error: Of the tip at the end, deg; NaN if unknown.
        position_error: Of the tip at the end, m; NaN if unknown.
        is_success: Whether both are within the scene's tolerances.
        diverged: Whether the simulation blew up.
        action_seconds: Median time the controller took per action, s; NaN if not timed.
    """

    label: str
    states: FloatArray
    controls: FloatArray
    noise: FloatArray | None = None
    rewards: FloatArray | None = None
    target: FloatArray | None = None
    target_body: FloatArray | None = None
    payload: FloatArray | None = None
    scene: Scene | None = None
    start: str = ""
    seed: int | None = None
    attitude_error: float = math.nan
    position_error: float = math.nan
    is_success: bool = False
    diverged: bool = False
    action_seconds: float = math.nan

    @property
    def cost(self) -> float:
        """J, minus the return of the episode, dimensionless; NaN without rewards."""
        return math.nan if self.rewards is None else -math.fsum(self.rewards.tolist())

    def facts(self) -> dict[str, Any]:
        """Describe the trajectory in JSON values, units in the keys, None for what is unknown."""
        numbers = {
            "cost": self.cost,
            "final_attitude_error_deg": self.attitude_error,
            "final_position_error_m": self.position_error,
            "action_seconds": self.action_seconds,
        }
        return {
            "label": self.label,
            "scene": None if self.scene is None else self.scene.name,
            "start": self.start,
            "seed": self.seed,
            "steps": len(self.controls),
            "is_success": self.is_success,
            "diverged": self.diverged,
            **{name: value if math.isfinite(value) else None for name, value in numbers.items()},
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory to a file in NumPy's npz format, in one go or not at all.

        The file holds `states`, `controls`, and where they are known `rewards`, `target`, `target_body`,
        `payload` and `noise`; and `facts`, JSON text with the scene and the entries of `facts()`.

        Args:
            path: The file, `.npz` by convention; its folder must exist.
        """
        arrays = {
            name: array
            for name in (*_REQUIRED, *_OPTIONAL)
            if (array := getattr(self, name)) is not None and (name != "noise" or array.any())
        }
        scene = None if self.scene is None else self.scene.model_dump(mode="json")
        content = BytesIO()
        facts = np.array(json.dumps({**self.facts(), "scene": scene}))
        np.savez_compressed(content, allow_pickle=False, facts=facts, **arrays)
        write_atomically(Path(path), content.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str], label: str | None = None) -> Self:
        """Read a trajectory from a file that `save`, or `save` of a solution, has written.

        Args:
            path: The file.
            label: Name in tables and plots; by default the file's own, "expert" for a solution, or the name
                of the file.

        Returns:
            The trajectory.

        Raises:
            ValueError: If the file cannot be read or lacks states or controls.
        """
        path = Path(path)
        if not path.exists():
            raise ValueError(f"{path}: there is no such file")
        try:
            arrays: dict[str, Any] = read_arrays(path, (*_REQUIRED, *_OPTIONAL, "facts"))
            facts = parse_json(str(arrays.pop("facts", "{}")), f"{path}: facts")
            if not isinstance(facts, dict) or not isinstance(facts.get("metadata", {}), dict):
                raise UnreadableError("its facts are not a mapping")
            missing = set(_REQUIRED) - set(arrays)
            if missing:
                raise ValueError(f"{path} holds no flight: it lacks {' and '.join(sorted(missing))}")
            _check_arrays(arrays)
            known = _known(facts)
        except UnreadableError as error:
            raise ValueError(f"{path} cannot be read as a flight ({error})") from error
        name = label or facts.get("label") or ("expert" if "stop_reason" in facts else path.stem)
        return cls(str(name), **arrays, **known)


_KINDS: Mapping[str, tuple[str, Any]] = {  # fields, their keys in the facts, and what these may be
    "label": ("label", str),
    "start": ("start", str),
    "seed": ("seed", int),
    "attitude_error": ("final_attitude_error_deg", float | int),
    "position_error": ("final_position_error_m", float | int),
    "is_success": ("is_success", bool),
    "diverged": ("diverged", bool),
    "action_seconds": ("action_seconds", float | int),
}


def _check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise UnreadableError for arrays that are no numbers, or not of one maneuver."""
    steps, inputs = (*arrays["controls"].shape, 0, 0)[:2]
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "states": ((steps + 1, *(arrays["states"].shape[1:2] or (1,))),),
        "controls": ((steps, inputs),),
        "noise": ((steps, inputs),),
        "rewards": ((steps,),),
        "target": ((8,), (steps + 1, 8)),
        "target_body": ((8,), (steps + 1, 8)),
        "payload": ((steps + 1, 8),),
    }
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise UnreadableError(f"{name} holds {array.dtype}, it should hold numbers"[:_LONGEST])
        if array.shape not in shapes[name]:
            wanted = " or ".join(map(str, shapes[name]))
            raise UnreadableError(f"{name} has shape {shortened(array.shape)}, it should have {wanted}")


def _known(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a trajectory in the facts of its file; a solution has its scene among its metadata."""
    scene = facts.get("scene") or facts.get("metadata", {}).get("scene")
    found: dict[str, Any] = {}
    for name, (key, kind) in _KINDS.items():
        value = facts.get(key)
        if value is not None and (
            not isinstance(value, kind) or isinstance(value, bool) is not (kind is bool)
        ):
            raise UnreadableError(f"facts: {key} is {shortened(value)}, it should be a {_word(kind)}")
        if value is not None and name != "label":
            found[name] = value
    if found.get("seed", 0) < 0:
        raise UnreadableError(f"facts: seed is {shortened(found['seed'])}, it should be 0 or greater")
    if scene is not None:
        if not isinstance(scene, dict):
            raise UnreadableError(f"facts: scene is {shortened(scene)}, it should be a mapping")
        try:
            found["scene"] = load_scene(scene)
        except SceneError as error:
            raise UnreadableError(f"facts: {error}") from error
    return found


def _word(kind: Any) -> str:
    return {str: "text", int: "whole number", bool: "truth value"}.get(kind, "number")
