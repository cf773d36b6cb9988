"""Flights from files: solutions, demonstrations, and rollouts in a format of their own."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.scene import StateLayout
from experts.demonstrations import load_demonstrations
from experts.files import write_atomically
from experts.replay.flights import Flight

_ARRAYS = ("states", "controls", "noise", "target")


@dataclass(frozen=True, eq=False)
class Recording:
    """A flight from a file.

    Attributes:
        flight: The flight.
        scene: Its scene; None if the file does not say.
    """

    flight: Flight
    scene: Scene | None


def save_flight(path: str | os.PathLike[str], flight: Flight, scene: Scene) -> None:
    """Write a flight with its scene into a file, complete or not at all.

    Args:
        path: The file, `.npz` by custom; its folder must exist.
        flight: The flight.
        scene: Its scene.
    """
    arrays = {name: getattr(flight, name) for name in _ARRAYS if getattr(flight, name) is not None}
    facts = {"label": flight.label, "scene": scene.model_dump(mode="json")}
    content = BytesIO()
    np.savez_compressed(content, facts=np.array(json.dumps(facts)), **arrays)
    write_atomically(Path(path), content.getvalue())


def read_recording(source: str | os.PathLike[str], label: str | None = None) -> Recording:
    """Read a flight.

    Args:
        source: A file that `save_flight` or `Solution.save` has written; or a folder of demonstrations, with
            "#" and a number for another demonstration than the first: `demonstrations/paper#3`.
        label: What the page calls it; by default what the file says, or the name of the file.

    Returns:
        The flight, and its scene if the file has it.

    Raises:
        ValueError: If there is no flight in it.
        DemonstrationsError: If the folder cannot be read.
    """
    text = os.fspath(source)
    folder, mark, number = text.rpartition("#")
    if mark and Path(folder).is_dir():
        return _from_demonstrations(Path(folder), number, label)
    path = Path(text)
    if path.is_dir():
        return _from_demonstrations(path, "0", label)
    return _from_file(path, label)


def _from_demonstrations(folder: Path, number: str, label: str | None) -> Recording:
    demonstrations = load_demonstrations(folder)
    last = len(demonstrations) - 1
    if not number.isdecimal() or int(number) > last:
        raise ValueError(f"{folder}: there is no demonstration {number!r}; the last one is {last}")
    demonstration, scene = demonstrations[int(number)], demonstrations.scene
    controls = demonstration.actions * StateLayout.of(scene).control_limit
    name = label or f"demonstration {number}"
    return Recording(Flight(name, np.array(demonstration.states), controls), scene)


def _from_file(path: Path, label: str | None) -> Recording:
    try:
        # Read first: of a file that is no archive, NumPy would leave the descriptor open.
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as content:
            arrays: dict[str, NDArray[Any]] = {
                name: content[name] for name in content.files if name in (*_ARRAYS, "facts")
            }
        facts = json.loads(str(arrays.pop("facts"))) if "facts" in arrays else {}
        if not isinstance(facts, dict) or not isinstance(facts.get("metadata", {}), dict):
            raise ValueError("its facts are no mapping")
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file") from None
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as a flight ({error})") from error
    missing = {"states", "controls"} - set(arrays)
    if missing:
        raise ValueError(f"{path} holds no flight: it lacks {' and '.join(sorted(missing))}")
    is_solution = "stop_reason" in facts
    name = label or facts.get("label") or ("expert" if is_solution else path.stem)
    return Recording(Flight(str(name), **arrays), _scene_of(facts))


def _scene_of(facts: Mapping[str, Any]) -> Scene | None:
    """The scene that a rollout, or the metadata of a solution, names."""
    data = facts.get("scene") or facts.get("metadata", {}).get("scene")
    return None if data is None else Scene.model_validate(data)


def common_scene(recordings: Sequence[Recording], scene: Scene | None = None) -> tuple[list[Flight], Scene]:
    """Find the scene in which all flights can be shown.

    Scenes may differ in masses, limits and targets, which change the flights and not the picture.

    Args:
        recordings: Flights, each with its scene if known.
        scene: The scene to show; by default the first that is known.

    Returns:
        The flights, each with the target that its own scene has; and the scene.

    Raises:
        ValueError: If no scene is known, or the robot or time step of one is another.
    """
    scene = scene or next((item.scene for item in recordings if item.scene is not None), None)
    if scene is None:
        raise ValueError("no file says which scene it belongs to: name the scene")
    flights = []
    for recording in recordings:
        flight, own = recording.flight, recording.scene
        if own is not None:
            _check_same_robot(flight.label, own, scene)
            if flight.target is None:
                flight = replace(flight, target=np.array(own.target.pose.dual_quaternion))
        flights.append(flight)
    return flights, scene


def _check_same_robot(label: str, own: Scene, scene: Scene) -> None:
    if own.simulation.dt != scene.simulation.dt:
        raise ValueError(
            f"flight {label!r} has time steps of {own.simulation.dt:g} s, the scene {scene.name!r} has "
            f"{scene.simulation.dt:g} s: show them on pages of their own"
        )
    mine, other = (
        (item.base.motion, [link.joint for link in item.links], item.wrist, item.tip) for item in (own, scene)
    )
    if mine != other:
        raise ValueError(
            f"flight {label!r} is one of another robot ({own.name!r}) than that of the scene {scene.name!r}: "
            "show them on pages of their own"
        )


__all__ = ["Recording", "common_scene", "read_recording", "save_flight"]
