"""`dq-space-arm evaluate show`: table, record and pictures of a flight beside the expert's solution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from agents.evaluation.beside_expert import SideBySide, fly_beside_expert
from agents.zoo.finding import as_policy, scene_of
from dq_space_arm_env import load_scene
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.results import Destination
from dq_space_arm_env.common.tables import Column, TextTable, tabulate
from dq_space_arm_env.viewing.picture_format import PictureFormat
from experts.maneuver import Maneuver

_FRAMES_PER_SECOND = 20.0
_HOLD = 2.0  # s, of the last picture


def show(
    destination: Destination,
    policy: str,
    scene: str | None = None,
    seed: int | None = None,
    n: int = 1,
    gif: Path | None = None,
    *,
    trust: bool = False,
    normalize: Path | None = None,
) -> bool:
    """Fly, write record and pictures, print a table; whether the agent reaches the target in all flights.

    The scene is the policy's by default. Flights after the first start at consecutive seeds.
    """
    if n < 1:
        raise ValueError(f"-n: {n}, should be at least 1")
    if seed is not None and seed < 0:
        raise ValueError(f"--seed: {seed}, should be at least 0")
    if gif is not None and gif.suffix.lower() != ".gif":
        raise ValueError(f"--gif: {gif}, should end in .gif")
    if gif is not None and find_spec("PIL") is None:
        raise ModuleNotFoundError('--gif: needs Pillow: pip install "dq-space-arm[plots]"')
    acting = as_policy(policy, trust=trust, normalize=normalize)
    flown = load_scene(scene or scene_of([acting]))
    first = 0 if seed is None else seed + 1
    pairs = fly_beside_expert(acting, flown, [seed, *range(first, first + n - 1)])
    record = {"flights": [pair.record() for pair in pairs], **provenance()}
    pictures = {
        "errors.png": lambda: _drawn("errors", pairs[0]),
        "inputs.png": lambda: _drawn("inputs", pairs[0]),
    }
    written, console = destination.write("flight", record, pictures), destination.console(120)
    if gif is not None:
        gif.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(gif, _animation(pairs[0].agent.maneuver))
        written.append(str(gif))
    console.print(_table(pairs).for_terminal())
    if n == 1:
        verb = "reaches" if pairs[0].agent.is_success else "does NOT reach"
        gap = f"its cost gap is {100.0 * pairs[0].cost_gap:.2f} %."
        console.print(f"{pairs[0].agent.name} {verb} the target; {gap}", markup=False)
    destination.tell(console, written, record)
    return all(pair.agent.is_success for pair in pairs)


def _table(pairs: Sequence[SideBySide]) -> TextTable:
    scene, rows = pairs[0].agent.maneuver.scene, []
    for pair in pairs:
        start = "nominal" if pair.seed is None else f"seed {pair.seed}"
        agent, expert = pair.agent.record(), pair.expert.record()
        agent |= {
            "start": start,
            "gap": pair.cost_gap,
            "time": f"{1e6 * pair.agent.seconds:.1f} us an action",
        }
        expert |= {"start": "", "time": f"{pair.expert.seconds:.2f} s to solve"}
        if not pair.converged:
            expert["name"] = f"{pair.expert.name}, not converged"
        rows += [agent, expert]
    columns = (
        Column("start"),
        Column("name", ""),
        Column("cost", "cost J", ".2f"),
        Column("gap", "cost gap", lambda gap: f"{100.0 * gap:.2f} %", missing=""),
        Column("attitude_error", "angle", lambda angle: f"{angle:.2f}°"),
        Column("position_error", "distance", lambda distance: f"{distance:.3f} m"),
        Column("effort"),
        Column("is_success", "target", lambda success: "reached" if success else "missed"),
        Column("time"),
    )
    tolerances = zip(scene.success.tolerances, ("°", " m", "°/s", " m/s"), strict=True)
    named = ", ".join(f"{largest:g}{unit}" for largest, unit in tolerances if math.isfinite(largest))
    return tabulate(f"Scene {scene.name}; tolerance {named}", rows, columns)


def _drawn(what: str, pair: SideBySide) -> bytes:
    """Draw errors or inputs as PNG."""
    from agents.evaluation import beside_expert_figure
    from experts.figures.style import as_png

    return as_png(partial(getattr(beside_expert_figure, f"{what}_figure"), pair))


def _animation(maneuver: Maneuver) -> bytes:
    """A GIF of a whole flight in real time."""
    from experts.figures.animation import draw_maneuver, encode_gif

    fps = min(_FRAMES_PER_SECOND, 1.0 / maneuver.scene.simulation.dt)
    return encode_gif(draw_maneuver(maneuver, PictureFormat(), fps, math.inf), fps, _HOLD)
