"""Operations and time of a scene's step, with parts of the scene left out or added."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from dq_space_arm_env.common.report_page import Section
from dq_space_arm_env.common.tables import Column, Row
from dq_space_arm_env.kernels import Kernels, compile_scene
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.scene.start import number_of_draws, start_from_draws
from experts.problems.shooting_problem import FloatArray
from experts.report.effort import Announce, Effort
from experts.report.integrator_precision import BATCH, step_call
from experts.report.scene_variants import feature_variants
from experts.report.timing import three_digits, time_in_turns


def measure(scene: Scene, effort: Effort, announce: Announce) -> dict[str, list[Row]]:
    """Costs of the scene and of its variants."""
    variants = feature_variants(scene)
    if not effort.all_parts:
        kept = [title for title in variants if title.startswith("without") or variants[title] is scene]
        variants = {title: variants[title] for title in kept}
    rows: list[dict[str, Any]] = []
    runs = []
    for index, (title, variant) in enumerate(variants.items()):
        announce(title, index, len(variants))
        kernels, integrator = compile_scene(variant), variant.simulation.integrator
        rows.append(
            {
                "part": title,
                "states": kernels.n_x,
                "inputs": kernels.n_u,
                "dynamics_operations": kernels.operation_count("forward_dynamics"),
                "step_operations": kernels.operation_count("step", integrator=integrator),
                "environment_operations": kernels.operation_count("environment_step", integrator=integrator),
            }
        )
        call = step_call(kernels, integrator, *moving_states(kernels, BATCH), variant.simulation.dt)
        runs.append(partial(call, BATCH))
    announce("times", len(variants), len(variants))
    samples = time_in_turns(runs, effort.repeats, effort.sample_seconds)
    whole = samples[0].best_ns
    for row, sample in zip(rows, samples, strict=True):
        row |= {"step_ns": sample.best_ns / BATCH, "time_ratio": sample.best_ns / whole}
        row["operations_ratio"] = row["step_operations"] / rows[0]["step_operations"]
    return {"parts": list(rows)}


def finite_limits(kernels: Kernels) -> FloatArray:
    """Limits of the inputs, shape (n_u,), units of `layout.control`; 1 for an input without limit."""
    limit = kernels.layout.control_limit
    return np.where(np.isfinite(limit), limit, 1.0)


def moving_states(kernels: Kernels, count: int) -> tuple[FloatArray, FloatArray]:
    """Moving states around the scene's start, and inputs within their limits, always the same."""
    rng = np.random.default_rng(0)
    layout, scene = kernels.layout, kernels.scene
    x = np.asarray(start_from_draws(scene, rng.uniform(-1.0, 1.0, (count, number_of_draws(scene)))))
    x = np.ascontiguousarray(x, kernels.dtype)
    for part, size in ((layout.state.base_velocity, 0.2), (layout.state.joint_rates, 0.5)):
        x[:, part] += rng.uniform(-size, size, x[:, part].shape)
    return x, (finite_limits(kernels) * rng.uniform(-1.0, 1.0, (count, kernels.n_u))).astype(kernels.dtype)


def section(scene: Scene, found: dict[str, list[Row]]) -> Section:
    """The section of the report."""
    made = Section(
        "parts",
        "What each part of the scene costs",
        "A part that a scene leaves out costs neither operations nor time. Operations are counted in the "
        f"compiled programs; times are those of a step of each of {BATCH} states on one core, with "
        f"{scene.simulation.integrator}.",
    )
    made.add_rows(
        "parts",
        found["parts"],
        [
            Column("part", ""),
            Column("states", "n_x"),
            Column("inputs", "n_u"),
            Column("dynamics_operations", "dynamics\noperations"),
            Column("step_operations", "step\noperations"),
            Column("operations_ratio", "ratio", ".2f"),
            Column("environment_operations", "environment's\nstep"),
            Column("step_ns", "step\nns", three_digits),
            Column("time_ratio", "ratio", ".2f"),
        ],
        "The scene with one part left out or added",
    )
    missing = [
        title.removeprefix("with ")
        for title in feature_variants(scene)
        if title.startswith("with ") and "link" not in title
    ]
    if missing:
        made.notes.append(f"The scene leaves out: {', '.join(missing)}.")

    def draw() -> bytes:
        from experts.figures.plots import Plot

        kinds = {"operations_ratio": "operations", "time_ratio": "time"}
        bars = [
            {**row, "ratio": row[key], "kind": kind} for row in found["parts"] for key, kind in kinds.items()
        ]
        labels = {"ratio": "of the whole scene's step"}
        return Plot("ratio", "part", color="kind", levels=(1.0,), labels=labels).png(bars)

    made.add_figure("parts", "Operations and time of a step relative to those of the whole scene.", draw)
    return made
