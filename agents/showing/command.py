"""`dq-space-arm evaluate show`: an agent's flight beside the expert's solution from the same start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from agents.evaluation.policies import as_policy
from agents.showing.beside_expert import SideBySide, fly_beside_expert
from dq_space_arm_env import load_scene
from dq_space_arm_env.environment.picture_format import PictureFormat
from experts.files import write_atomically
from experts.report.animation import NO_PILLOW
from experts.report.command import NO_PICTURE, Destination
from experts.report.maneuver import Maneuver
from experts.report.provenance import provenance
from experts.report.summary import to_json
from experts.report.tables import TextTable

_FRAMES_PER_SECOND = 20.0
_HOLD = 2.0  # s, of the last picture


@dataclass(frozen=True)
class Options:
    """What to fly.

    Attributes:
        policy: Name of the zoo, exported policy, model of Stable-Baselines3, or folder of a training run.
        scene: Name of a scene, or path of a YAML file; the policy's if None.
        seed: Start where `env.reset(seed=seed)` does; the nominal start if None.
        n: Number of flights, from further seeds; pictures are of the first.
        gif: File for the flight as a moving picture, if wanted.
    """

    policy: str
    scene: str | None = None
    seed: int | None = None
    n: int = 1
    gif: Path | None = None


def run(destination: Destination, options: Options) -> bool:
    """Fly, print the table, and write record and pictures.

    Args:
        destination: Where the results go.
        options: What to fly.

    Returns:
        Whether the agent reaches the target in all flights.

    Raises:
        ValueError: If an option, the policy or the scene cannot be used.
        PolicyFileError: If the policy's file is damaged.
        ModuleNotFoundError: If Pillow is missing that a moving picture needs.
    """
    if options.n < 1:
        raise ValueError(f"-n: {options.n}, should be at least 1")
    if options.seed is not None and options.seed < 0:
        raise ValueError(f"--seed: {options.seed}, should be at least 0")
    if options.gif is not None and find_spec("PIL") is None:
        raise ModuleNotFoundError(f"--gif: {NO_PILLOW}")
    console = destination.console(120)
    policy = as_policy(options.policy)
    scene = load_scene(options.scene or str(policy.metadata.get("scene", "paper")))
    first = 0 if options.seed is None else options.seed + 1
    seeds: list[int | None] = [options.seed, *range(first, first + options.n - 1)]
    pairs = fly_beside_expert(policy, scene, seeds)
    console.print(_table(pairs).for_terminal())
    if len(pairs) == 1:
        console.print(_verdict(pairs[0]), markup=False)
    _save(console, destination, options.gif, pairs)
    return all(pair.agent.is_success for pair in pairs)


def _table(pairs: Sequence[SideBySide]) -> TextTable:
    scene = pairs[0].agent.maneuver.scene
    headings = ("start", "", "cost J", "cost gap", "angle", "distance", "effort", "target", "time")
    rows = []
    for pair in pairs:
        start = "nominal" if pair.seed is None else f"seed {pair.seed}"
        for side in (pair.agent, pair.expert):
            is_agent = side is pair.agent
            time = f"{1e6 * side.seconds:.1f} us an action" if is_agent else f"{side.seconds:.2f} s to solve"
            rows.append(
                (
                    start if is_agent else "",
                    side.name if is_agent or pair.converged else f"{side.name}, not converged",
                    f"{side.cost:.2f}",
                    f"{100.0 * pair.cost_gap:.2f} %" if is_agent else "",
                    f"{side.attitude_error:.2f}°",
                    f"{side.position_error:.3f} m",
                    f"{side.effort:.3g}",
                    "reached" if side.is_success else "missed",
                    time,
                )
            )
    success = scene.success
    tolerance = f"{success.attitude_error_deg:g}°, {success.position_error:g} m"
    return TextTable(f"Scene {scene.name}; tolerance {tolerance}", headings, tuple(rows), right=2)


def _verdict(pair: SideBySide) -> str:
    verb = "reaches" if pair.agent.is_success else "does NOT reach"
    return f"{pair.agent.name} {verb} the target; its cost gap is {100.0 * pair.cost_gap:.2f} %."


def _save(console: Console, destination: Destination, gif: Path | None, pairs: Sequence[SideBySide]) -> None:
    folder = destination.folder
    folder.mkdir(parents=True, exist_ok=True)
    files = ["flight.json"]
    record = {"flights": [pair.record() for pair in pairs], **provenance()}
    write_atomically(folder / files[0], to_json(record))
    if destination.picture and find_spec("matplotlib") is None:
        console.print(NO_PICTURE, markup=False)
    elif destination.picture:
        from agents.showing.figure import errors_picture, inputs_picture

        for name, draw in (("errors.png", errors_picture), ("inputs.png", inputs_picture)):
            write_atomically(folder / name, draw(pairs[0]))
            files.append(name)
    if gif is not None:
        write_atomically(gif, _animation(pairs[0].agent.maneuver))
        files.append(str(gif))
    console.print(f"{folder}: {', '.join(files)}", markup=False)
    destination.print(record)


def _animation(maneuver: Maneuver) -> bytes:
    """A GIF of all of a flight, in its own time."""
    from experts.report.animation import draw_maneuver, encode_gif

    fps = min(_FRAMES_PER_SECOND, 1.0 / maneuver.scene.simulation.dt)
    return encode_gif(draw_maneuver(maneuver, PictureFormat(), fps, math.inf), fps, _HOLD)
