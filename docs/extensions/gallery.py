"""The gallery: each scene's animation, its task, and a row of facts, from the scene and the expert's plan."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agents.zoo import list_policies
from agents.zoo.shelf import load_record
from dq_space_arm_env import Scene, list_scenes, load_scene
from dq_space_arm_env.common.tables import Column, tabulate
from dq_space_arm_env.scene import StateLayout

PICTURES = Path(__file__).resolve().parents[2] / ".github" / "pictures" / "gallery"
_COLUMNS = (
    "joints",
    Column("sizes", "states, inputs"),
    Column("cost", "J", lambda value: f"{value:,.0f}" if value >= 1000.0 else f"{value:.4g}"),
    Column("end", "at the end"),
)


def gallery() -> str:
    """Write a section for each scene.

    Returns:
        Markdown, its headings of level 2.
    """
    records = json.loads((PICTURES / "gallery.json").read_text(encoding="utf-8"))
    rates = _success_rates()
    return "\n\n".join(
        _section(load_scene(name), records[name], rates.get(name, {})) for name in list_scenes()
    )


def _section(scene: Scene, record: dict[str, Any], rates: dict[str, float]) -> str:
    _, table = tabulate("", [_row(scene, record)], _COLUMNS).markdown()
    parts = [
        f"## `{scene.name}`",
        f"![The maneuver of {scene.name}](../.github/pictures/gallery/{scene.name}.webp)",
        scene.description,
        table,
    ]
    if rates:
        shares = ", ".join(f"`{policy}` {100.0 * rate:.1f} %" for policy, rate in rates.items())
        parts.append(f"Success of [policies](agents.md#the-zoo): {shares}.")
    return "\n\n".join(parts)


def _row(scene: Scene, record: dict[str, Any]) -> dict[str, Any]:
    layout = StateLayout.of(scene)
    angle, distance = record["attitude_error_deg"], 100.0 * record["position_error_m"]
    joints = sum(not link.is_fixed for link in scene.links)
    return {
        "joints": f"{joints}, wrist" if scene.wrist is not None else f"{joints}",
        "sizes": f"{layout.n_x}, {layout.n_u}",
        "cost": record["cost"],
        "end": f"{angle:.2f}°, {distance:.1f} cm, {record['seconds']:g} s",
    }


def _success_rates() -> dict[str, dict[str, float]]:
    """Success rates of the policies that ship, by scene and policy."""
    rates: dict[str, dict[str, float]] = {}
    for policy, scene, summary in _flown():
        rates.setdefault(scene, {})[policy] = summary["success_rate"][0]
    return rates


def _flown() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for policy in list_policies():
        record = load_record(policy)
        yield policy, record["scene"], record["evaluations"][0]
        for summary in record.get("elsewhere", ()):
            yield policy, summary["scene"], summary
