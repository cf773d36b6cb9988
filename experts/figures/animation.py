"""A maneuver as an animated GIF or WebP or a strip of moments, drawn by the environment's renderer."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.constraint_shapes import (
    REACH,
    constraint_shapes,
    gas_of,
    shapes_in_space,
    thruster_shapes,
)
from dq_space_arm_env.viewing.picture_format import PictureFormat, View
from dq_space_arm_env.viewing.rendering import Renderer
from dq_space_arm_env.viewing.rendering.camera import Camera, camera_around
from dq_space_arm_env.viewing.rendering.spacecraft import SpacecraftModel
from dq_space_arm_env.viewing.replay.flights import ShownFlight, prepare, target_during
from dq_space_arm_env.viewing.replay.geometry import view_of
from experts.maneuver import Maneuver

Image = NDArray[np.uint8]

FASTEST = 50.0
"""Pictures per second, 1/s: players slow down pictures shorter than 0.02 s."""

_LONGEST_HOLD = 600.0  # s; the file has 16 bits for hundredths of a second
_GAP = 4  # pixels between the pictures of a strip
_MARGIN = 0.03  # around a whole maneuver, of its extent
_PALETTE_PICTURES = 12  # from which the colors of all are chosen
_PALETTE_POWER = 0.5  # of how often a color occurs, for its share of the palette


def draw_maneuver(
    maneuver: Maneuver, picture: PictureFormat, fps: float, seconds: float, *, whole: bool = False
) -> list[Image]:
    """Draw the first seconds of a maneuver in real time: RGB pictures, shape (height, width, 3).

    The camera stands where the environment has it, or, for a `whole` maneuver, where a replay has it: on the
    side that shows most, with all of the motion in view; and constraints and the gas of thrusters are drawn
    as shapes, too.
    """
    for name, value in (("fps", fps), ("seconds", seconds)):
        if not value > 0.0:
            raise ValueError(f"{name}: {value}, should be positive")
    if not math.isfinite(fps):
        raise ValueError(f"fps: {fps}, should be finite")
    renderer = Renderer(maneuver.scene, picture)
    if whole:
        shown = _shown(maneuver)
        renderer.camera = _camera_of_all(shown, maneuver.scene, picture)
        length = REACH * SpacecraftModel(maneuver.scene).axis_length
        groups = [*constraint_shapes(maneuver.scene, length), thruster_shapes(maneuver.scene, length)]
        shapes = [each for group in groups for each in group]
        gas = gas_of(maneuver.scene, shown.acting)
    tips = np.array(poses.position(maneuver.frames[:, -1].T)).T
    times = np.arange(0.0, min(seconds, maneuver.time[-1]) + 1e-9, 1.0 / fps)
    stages = np.searchsorted(maneuver.time, times - 0.5 * maneuver.scene.simulation.dt)
    targets, bodies = target_during(maneuver.scene, len(tips) - 1)
    pictures = []
    for stage in stages:
        target, body, payload = (
            each if each is None or each.ndim == 1 else each[stage]
            for each in (targets, bodies, maneuver.payload)
        )
        assert target is not None
        renderer.aim_at(target, body, payload)
        if whole:
            here = np.vstack([maneuver.frames[stage], target, target if body is None else body])
            renderer.overlay = [*shapes_in_space(shapes, here, gas[stage])]
        pictures.append(renderer.draw(maneuver.frames[stage], tips[: stage + 1]))
    return pictures


def _shown(maneuver: Maneuver) -> ShownFlight:
    """The maneuver as a replay has it."""
    flight = Trajectory(maneuver.scene.name, maneuver.states, maneuver.controls, scene=maneuver.scene)
    return prepare([flight], maneuver.scene)[0]


def _camera_of_all(shown: ShownFlight, scene: Scene, picture: PictureFormat) -> Camera:
    """The replay's side and points in view; its azimuth and elevation are those of the camera."""
    view = view_of([shown], scene)
    toward = View(180.0 + math.degrees(view.azimuth), -math.degrees(view.elevation))
    margins = np.full(len(view.points), _MARGIN * float(np.ptp(view.points, axis=0).max()))
    return camera_around(view.points, margins, toward, picture.width, picture.height)


def encode_strip(pictures: Sequence[Image], colors: int = 192) -> bytes:
    """Encode RGB pictures of one height as a PNG, side by side, with white between them."""
    between = np.full((len(pictures[0]), _GAP, 3), 255, np.uint8)
    row = [part for picture in pictures for part in (between, picture)][1:]
    strip = Pillow.fromarray(np.hstack(row)).quantize(colors, Pillow.Quantize.MEDIANCUT)
    file = io.BytesIO()
    strip.save(file, "PNG", optimize=True)
    return file.getvalue()


def check_gif(fps: float, hold: float, colors: int) -> None:
    """Refuse unusable settings of `encode_gif` before any picture is drawn."""
    if not 0.0 < fps <= FASTEST:
        raise ValueError(f"fps: {fps}, should be positive and at most {FASTEST:g}")
    if not 0.0 <= hold <= _LONGEST_HOLD:
        raise ValueError(f"hold: {hold}, should be 0 to {_LONGEST_HOLD:g} s")
    if not 2 <= colors <= 255:
        raise ValueError(f"colors: {colors}, should be 2 to 255")


def encode_gif(pictures: Sequence[Image], fps: float, hold: float, colors: int = 128) -> bytes:
    """Encode RGB pictures as a GIF that loops; the last one stays for `hold` seconds.

    What does not change from one picture to the next is transparent and costs next to nothing.
    """
    check_gif(fps, hold, colors)
    palette = Pillow.fromarray(_typical_colors(pictures)).quantize(colors, Pillow.Quantize.MEDIANCUT)
    frames: list[Pillow.Image] = []
    before = None
    for picture in pictures:
        frame = Pillow.fromarray(picture).quantize(palette=palette, dither=Pillow.Dither.NONE)
        indices = np.asarray(frame)
        changed = indices if before is None else np.where(indices == before, colors, indices)
        frame.putdata(changed.ravel().tolist())
        frames.append(frame)
        before = indices
    # A GIF counts in hundredths of a second: the pictures change at the nearest, and do not lag ever more.
    changes = [round(100.0 * number / fps) for number in range(len(frames))]
    durations = [10 * (after - before) for before, after in itertools.pairwise(changes)]
    durations.append(round(1000.0 * hold))
    file = io.BytesIO()
    frames[0].save(
        file,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        transparency=colors,
        disposal=1,
        optimize=False,
    )
    return file.getvalue()


def encode_webp(pictures: Sequence[Image], fps: float, hold: float, quality: int) -> bytes:
    """Encode RGB pictures as a WebP that loops, in half the bytes of a GIF; quality 0 to 100."""
    check_gif(fps, hold, 2)
    frames = [Pillow.fromarray(picture) for picture in pictures]
    durations = [round(1000.0 / fps)] * (len(frames) - 1) + [round(1000.0 * hold)]
    # A whole picture costs as much as all that follow: none but the first.
    distances = {"kmin": len(frames), "kmax": len(frames) + 1}
    file = io.BytesIO()
    frames[0].save(
        file,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        quality=quality,
        method=6,
        **distances,
    )
    return file.getvalue()


def _typical_colors(pictures: Sequence[Image]) -> Image:
    """The colors of pictures in one picture, where rare ones, such as those of axes, weigh more."""
    chosen = [pictures[i] for i in np.linspace(0, len(pictures) - 1, _PALETTE_PICTURES).astype(int)]
    # Rounded to four steps of 256: colors that differ by less count as one.
    levels, counts = np.unique(np.concatenate(chosen).reshape(-1, 3) >> 2, axis=0, return_counts=True)
    shares = np.ceil(counts**_PALETTE_POWER).astype(int)
    return np.repeat(levels << 2 | 2, shares, axis=0).astype(np.uint8)[None]
