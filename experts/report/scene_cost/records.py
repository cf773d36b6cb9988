"""The measurements in JSON's types, with the ratios that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from experts.report.scene_cost.measurement import SceneCostReport, SceneRow


@dataclass(frozen=True)
class Ratios:
    """A scene beside another one.

    Attributes:
        step_operations: Operations of a step, over those of the other.
        environment_operations: Operations of an environment's step, likewise.
        step_time: Time of a step, likewise.
        environment_time: Time of an environment's step, likewise.
    """

    step_operations: float
    environment_operations: float
    step_time: float
    environment_time: float


def ratios(row: SceneRow, reference: SceneRow) -> Ratios:
    """Compare two scenes, each with its integrator.

    Args:
        row: One.
        reference: The other.

    Returns:
        Operations and best times of the one over those of the other.
    """
    size, other = row.size, reference.size
    cost, other_cost = row.cost, reference.cost
    return Ratios(
        step_operations=size.step.operations / other.step.operations,
        environment_operations=size.environment_step.operations / other.environment_step.operations,
        step_time=cost.step.best_ns / other_cost.step.best_ns,
        environment_time=cost.environment_step.best_ns / other_cost.environment_step.best_ns,
    )


def report_record(report: SceneCostReport) -> dict[str, Any]:
    """Turn a report into JSON's types.

    Args:
        report: The report.

    Returns:
        Its fields; of scenes and parts also the ratios to the first row.
    """
    return {
        "scenes": _rows(report.scenes),
        "features": _rows(report.features),
        "outputs": {
            "scene": report.output_scene,
            "programs": [asdict(program) for program in report.outputs],
        },
        "processes": [asdict(stage) for stage in report.processes],
        "installation": [{**asdict(size), "bytes": size.bytes} for size in report.installation],
    }


def _rows(rows: Sequence[SceneRow]) -> list[dict[str, Any]]:
    return [
        {
            "title": row.title,
            "integrator": row.cost.integrator,
            "size": asdict(row.size),
            "dynamics": asdict(row.cost.dynamics),
            "step": asdict(row.cost.step),
            "environment_step": asdict(row.cost.environment_step),
            "ratios": asdict(ratios(row, rows[0])),
        }
        for row in rows
    ]
