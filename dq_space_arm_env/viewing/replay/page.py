"""The page: one HTML file with style, scripts and data inside."""

from __future__ import annotations

import json
import math
import os
import re
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.viewing.replay.curves import panels
from dq_space_arm_env.viewing.replay.flights import prepare, verdict
from dq_space_arm_env.viewing.replay.geometry import Triangles, constraints_of, solids_of, view_of
from dq_space_arm_env.viewing.replay.thinning import thinned

# In the order of their dependencies.
SCRIPTS = (
    "algebra.mjs",
    "recording.mjs",
    "player.mjs",
    "camera.mjs",
    "shaders.mjs",
    "shapes.mjs",
    "renderer.mjs",
    "labels.mjs",
    "plots.mjs",
    "gestures.mjs",
    "video.mjs",
    "main.mjs",
)

_IMPORT = re.compile(r'^import \{[^}]*\} from "\./(\w+\.mjs)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) )", re.MULTILINE)


class _Blob:
    """Arrays one after another, and their places."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: NDArray[Any]) -> dict[str, Any]:
        """Append an array, little-endian, at a multiple of 4 bytes."""
        data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        place = {"type": array.dtype.name, "start": self._size, "length": int(array.size)}
        data += bytes(-len(data) % 4)
        self._parts.append(data)
        self._size += len(data)
        return place

    def encoded(self) -> str:
        """The bytes in base 64."""
        return b64encode(b"".join(self._parts)).decode("ascii")


def replay_page(
    flights: Sequence[Trajectory], scene: Scene, *others: tuple[Sequence[Trajectory], Scene]
) -> str:
    """Make a page that shows flights in 3-D and as curves.

    The first flight is drawn solid and the others as ghosts, until the reader selects another. Where all
    flights of a scene are longer than a page should be, instants of the longest are left out evenly.

    Args:
        flights: One to six, of any lengths.
        scene: The scene of all of them.
        *others: Flights of further scenes, which the page lists by their names.

    Returns:
        HTML that needs no other file and makes no request.

    Raises:
        ValueError: If a scene has no flights or too many, arrays do not fit it, or two have the same name.
    """
    shown = [(flights, scene), *others]
    names = [each.name for _, each in shown]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"two scenes are called {twice!r}: show their flights together or rename one")
    parts = {
        "title": escape(f"{', '.join(names)}: replay"),
        "style": _read("replay.css"),
        "data": "\n".join(_data_element(*each) for each in shown),
        "script": bundle(),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], _read("page.html"))


def write_replay(
    path: str | os.PathLike[str],
    flights: Sequence[Trajectory],
    scene: Scene,
    *others: tuple[Sequence[Trajectory], Scene],
) -> Path:
    """Write such a page to a file, in one go or not at all.

    Args:
        path: The file, `.html` by convention; its folder must exist.
        flights: One to six, of any lengths.
        scene: The scene of all of them.
        *others: Flights of further scenes, which the page lists by their names.

    Returns:
        The file.

    Raises:
        ValueError: If a scene has no flights or too many, arrays do not fit it, or two have the same name.
    """
    file = Path(path)
    write_atomically(file, replay_page(flights, scene, *others))
    return file


def bundle() -> str:
    """Join the scripts into one without imports and exports."""
    joined: list[str] = []
    for position, name in enumerate(SCRIPTS):
        text = _read(name)
        unknown = set(_IMPORT.findall(text)) - set(SCRIPTS[:position])
        if unknown:
            raise ValueError(f"{name} imports {', '.join(sorted(unknown))}, which should come before it")
        joined.append(_EXPORT.sub("", _IMPORT.sub("", text)))
    return "\n".join(joined)


def _read(name: str) -> str:
    return files("dq_space_arm_env.viewing.replay").joinpath("browser", name).read_text(encoding="utf-8")


def _data_element(flights: Sequence[Trajectory], scene: Scene) -> str:
    """The data of a scene's flights, under the scene's name."""
    opening = f'<script type="application/json" class="replay-data" data-scene="{escape(scene.name)}">'
    return f"{opening}{_as_script(_describe(flights, scene))}</script>"


def _as_script(data: dict[str, Any]) -> str:
    """JSON that is safe inside a `script` element: it cannot end the element or start a comment."""
    # In ASCII, as file names need not be valid Unicode.
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _poses(poses: NDArray[np.float64] | None, blob: _Blob) -> list[float] | dict[str, Any] | None:
    """The numbers of a pose, or the place of those of what moves; None for none."""
    if poses is None:
        return None
    return poses.tolist() if poses.ndim == 1 else blob.add(poses.astype(np.float32))


def _triangles(triangles: Triangles, blob: _Blob) -> dict[str, Any]:
    """Places of the arrays of triangles."""
    arrays = triangles._asdict()
    counts = arrays.pop("counts")
    return {**{name: blob.add(array) for name, array in arrays.items()}, "counts": counts}


def _describe(flights: Sequence[Trajectory], scene: Scene) -> dict[str, Any]:
    """Content of the page as JSON values."""
    shown = thinned(prepare(flights, scene), len(scene.actuators.thrusters or ()))
    view, blob = view_of(shown, scene), _Blob()
    data: dict[str, Any] = {
        "scene": {
            "name": scene.name,
            "description": scene.description,
            "planar": scene.base.motion == "planar",
            "dt": scene.simulation.dt,
            "tolerance": scene.success.position_error,
        },
        "solids": {**_triangles(solids_of(scene), blob), "axisLength": SpacecraftModel(scene).axis_length},
        "view": {
            "azimuth": view.azimuth,
            "elevation": view.elevation,
            "points": blob.add(view.points.astype(np.float32)),
            "pivot": view.pivot.tolist(),
        },
        "flights": [
            {
                "label": flight.label,
                "steps": flight.steps,
                "dt": flight.dt,
                "note": flight.note,
                "verdict": verdict(flight, scene),
                "target": _poses(flight.target, blob),
                "targetBody": _poses(flight.target_body, blob),
                "payload": _poses(flight.payload, blob),
                "frames": blob.add(flight.frames.astype(np.float32)),
            }
            for flight in shown
        ],
        "panels": [
            {
                "title": panel.title,
                "unit": panel.unit,
                "note": panel.note,
                "names": panel.names,
                "steps": panel.steps,
                "bounds": [bound for bound in panel.bounds if math.isfinite(bound)],
                "curves": [blob.add(curve.astype(np.float32)) for curve in panel.curves],
                "disturbed": [
                    None if curve is None else blob.add(curve.astype(np.float32)) for curve in panel.disturbed
                ],
            }
            for panel in panels(shown, scene)
        ],
    }
    drawn = constraints_of(scene, shown)
    if drawn is not None:
        data["constraints"] = {
            **_triangles(drawn.triangles, blob),
            "names": drawn.names,
            "frames": drawn.frames,
            "nozzles": drawn.nozzles,
            "gas": [blob.add(each.astype(np.float32)) for each in drawn.gas],
            "owners": drawn.owners,
            "violated": [blob.add(each.astype(np.uint8)) for each in drawn.violated],
            "broken": [blob.add(each.astype(np.uint8)) for each in drawn.broken],
        }
    data["blob"] = blob.encoded()
    return data
