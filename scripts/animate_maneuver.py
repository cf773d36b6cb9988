"""Solve a scene's maneuver and draw it as the environment's render mode "rgb_array" shows it.

A GIF shows its first seconds in real time; a PNG shows moments of all of it, side by side.

Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from dq_space_arm_env import load_scene
from dq_space_arm_env.command_line.verb_program import run_to_end
from dq_space_arm_env.common.console import SUCCESS
from dq_space_arm_env.common.files import check_writable_file, write_atomically
from dq_space_arm_env.viewing.picture_format import PictureFormat
from experts import GuidedDDP
from experts.figures.animation import check_gif, draw_maneuver, encode_gif, encode_strip
from experts.maneuver import Maneuver


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script and return its exit status."""
    options = _parse(arguments)
    return run_to_end(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    config = {key: value for key, value in vars(options).items() if key in ("azimuth", "elevation")}
    picture = PictureFormat.checked(options.width, options.height, config)
    check_gif(options.fps, options.hold, options.colors)
    is_strip = options.out.suffix == ".png"
    if is_strip and options.moments < 2:
        raise ValueError(f"moments: {options.moments}, should be at least 2: the start and the end")
    check_writable_file(options.out)
    scene = load_scene(options.scene)
    solution = GuidedDDP(scene).solve()
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
    verdict = "converged" if solution.converged else f"NOT CONVERGED: {solution.message}"
    Console(highlight=False).print(
        f"{options.out}: {len(pictures)} pictures, {len(content) / 1e6:.2f} MB; the solution has {verdict}",
        markup=False,
        soft_wrap=True,
    )
    return SUCCESS


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
    own = argparse.SUPPRESS  # what is not given is the scene's choice
    parser.add_argument("--azimuth", type=float, default=own, help="direction of view about z from x, deg")
    parser.add_argument("--elevation", type=float, default=own, help="of the direction, negative: down, deg")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
