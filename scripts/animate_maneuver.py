"""Solve a scene's maneuver and draw it as the environment's render mode "rgb_array" shows it.

A GIF shows its first seconds in real time; a PNG shows moments of all of it, side by side. --gallery draws
the small animations of docs/gallery.md, each of a whole maneuver, and records the plan's cost and errors in
gallery.json beside them, from which the page is written. Scenes whose animation is up to date are left out
unless they are named.

Exit status: 0; 1 if a plan for the gallery has not converged; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from dq_space_arm_env import Scene, list_scenes, load_scene
from dq_space_arm_env.command_line.verb_program import run_to_end
from dq_space_arm_env.common.console import FAILURE, SUCCESS, complain
from dq_space_arm_env.common.files import check_writable, check_writable_file, write_atomically
from dq_space_arm_env.viewing.picture_format import PictureFormat
from experts import GuidedDDP, Solution
from experts.ddp.solution import uninterrupted
from experts.figures.animation import check_gif, draw_maneuver, encode_gif, encode_strip, encode_webp
from experts.maneuver import Maneuver

GALLERY = Path(__file__).resolve().parent.parent / ".github" / "pictures" / "gallery"
RECORDS = "gallery.json"
MOMENTS, FPS, HOLD, QUALITY = 31, 12.0, 1.2, 50
SMALL = PictureFormat(288, 192)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script and return its exit status."""
    options = _parse(arguments)
    return run_to_end(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    if options.gallery is not None:
        return draw_gallery(options.gallery)
    config = {key: value for key, value in vars(options).items() if key in ("azimuth", "elevation")}
    picture = PictureFormat.checked(options.width, options.height, config)
    check_gif(options.fps, options.hold, options.colors)
    ending = options.out.suffix.lower()
    is_strip = ending == ".png"
    if not options.seconds > 0.0:
        raise ValueError(f"seconds: {options.seconds}, should be positive")
    if is_strip and options.moments < 2:
        raise ValueError(f"moments: {options.moments}, should be at least 2: the start and the end")
    check_writable_file(options.out)
    if ending not in (".gif", ".png"):
        raise ValueError(f"out: {options.out}, should end in .gif or .png")
    scene = load_scene(options.scene)
    solution = uninterrupted(GuidedDDP(scene).solve())
    maneuver = Maneuver(scene, solution.states, solution.controls)
    if is_strip:
        duration = float(maneuver.time[-1])
        pictures = draw_maneuver(maneuver, picture, (options.moments - 1) / duration, duration)
        content = encode_strip(pictures)
    else:
        pictures = draw_maneuver(maneuver, picture, options.fps, options.seconds)
        content = encode_gif(pictures, options.fps, options.hold, options.colors)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out, content)
    noun = "picture" if len(pictures) == 1 else "pictures"
    verdict = "converged" if solution.converged else f"NOT CONVERGED: {solution.message}"
    Console(highlight=False).print(
        f"{options.out}: {len(pictures)} {noun}, {len(content) / 1e6:.2f} MB; the solution has {verdict}",
        markup=False,
        soft_wrap=True,
    )
    return SUCCESS


def draw_gallery(names: Sequence[str] = (), folder: Path = GALLERY) -> int:
    """Draw the animations of these scenes, by default of all that have none or changed since."""
    check_writable(folder)
    file, console = folder / RECORDS, Console(highlight=False)
    known: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    scenes = [load_scene(name) for name in names or list_scenes()]
    status = SUCCESS
    for number, scene in enumerate(scenes, start=1):
        picture = folder / f"{scene.name}.webp"
        is_old = picture.exists() and known.get(scene.name, {}).get("scene") == scene.content_hash()
        if is_old and not names:
            continue
        solution = uninterrupted(GuidedDDP(scene).solve())
        if not solution.converged:
            complain(f"{scene.name}: not drawn, {solution.message}")
            status = FAILURE
            continue
        maneuver = Maneuver(scene, solution.states, solution.controls)
        duration = float(maneuver.time[-1])
        pictures = draw_maneuver(maneuver, SMALL, (MOMENTS - 1) / duration, duration, whole=True)
        content = encode_webp(pictures, FPS, HOLD, QUALITY)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(picture, content)
        known = {name: known[name] for name in known if name in list_scenes()}
        known[scene.name] = _record(scene, solution, maneuver)
        write_atomically(file, json.dumps(dict(sorted(known.items())), indent=1, allow_nan=False) + "\n")
        line = (
            f"{number} of {len(scenes)}: {picture.name}, {len(content) / 1e3:.0f} kB, J {solution.cost:.6g}"
        )
        console.print(line, markup=False, soft_wrap=True)
    return status


def _record(scene: Scene, solution: Solution, maneuver: Maneuver) -> dict[str, Any]:
    """Facts of a plan, to six digits."""
    facts = {
        "seconds": float(maneuver.time[-1]),
        "cost": solution.cost,
        "attitude_error_deg": math.degrees(maneuver.angle[-1]),
        "position_error_m": float(maneuver.distance[-1]),
    }
    return {"scene": scene.content_hash(), **{name: float(f"{fact:.6g}") for name, fact in facts.items()}}


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--scene", default="paper", help="name of a shipped scene, or path of a YAML file")
    parser.add_argument("--out", type=Path, default=Path("results/maneuver.gif"), help=".gif or .png")
    parser.add_argument("--width", type=int, default=640, help="pixels")
    parser.add_argument("--height", type=int, default=400, help="pixels")
    parser.add_argument("--fps", type=float, default=16.0, help="pictures per second")
    parser.add_argument("--seconds", type=float, default=7.0, help="of the maneuver, in real time")
    parser.add_argument("--hold", type=float, default=2.0, help="seconds for which the last picture stays")
    parser.add_argument("--moments", type=int, default=3, help="pictures of a PNG, the start and the end too")
    parser.add_argument("--colors", type=int, default=240, help="of the palette, 2 to 255")
    parser.add_argument(
        "--gallery",
        nargs="*",
        default=None,
        metavar="SCENE",
        help="draw the animations of the gallery, or those of these scenes; the other options do not apply",
    )
    own = argparse.SUPPRESS  # what is not given is the scene's choice
    parser.add_argument("--azimuth", type=float, default=own, help="direction of view about z from x, deg")
    parser.add_argument("--elevation", type=float, default=own, help="of the direction, negative: down, deg")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
