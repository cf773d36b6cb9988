"""Everything that the report on what scenes leave out measures, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dq_space_arm_env import Scene, list_scenes, load_scene
from experts.arm_problem import CURVATURE_OF
from experts.report.scene_cost.installation import InstalledSize, measure_installation
from experts.report.scene_cost.processes import ProcessStage, measure_processes
from experts.report.scene_cost.programs import ProgramCost, compile_cold
from experts.report.scene_cost.sizes import SceneSize, measure_size
from experts.report.throughput import timing
from experts.report.throughput.features import feature_variants
from experts.report.throughput.scene_costs import BATCH, SceneCost, measure_costs

REFERENCE = "paper"

OUTPUTS: Mapping[str, str] = {
    "step": "the next state",
    "forward_dynamics": "accelerations",
    "reaction_wrenches": "reaction wrenches of the joints",
    "tip_pose": "pose of the tip",
    "frame_poses": "poses of all frames",
    "momentum": "momentum",
    "energy": "energy",
    "cost": "stage cost",
    "cost_derivatives": "first derivatives of the cost",
    "linearize": "first derivatives of the step",
    "lagrangian_hessian": "second derivatives of step and cost",
}
"""Programs that only their callers pay for, and what they give; the step first, to compare with."""

_SECOND = "lagrangian_hessian"
_OF_A_STEP = ("step", "linearize", _SECOND)


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        scenes: Names of the scenes that are measured if none are asked for.
        timing: Samples of each kernel; its batch sizes do not matter.
        compilations: How often each program is compiled.
        processes: New processes with a warm cache.
    """

    scenes: tuple[str, ...]
    timing: timing.Effort
    compilations: int
    processes: int


# Ratios need the best time of each: on a shared machine, many short samples find a quiet moment.
FULL = Effort(tuple(list_scenes()), timing.Effort((BATCH,), 200, 0.0005), compilations=2, processes=6)
QUICK = Effort(
    (REFERENCE, "no-wrist", "planar"), timing.Effort((BATCH,), 50, 0.0005), compilations=1, processes=2
)


@dataclass(frozen=True)
class SceneRow:
    """What a scene costs, in float64 on one thread.

    Attributes:
        title: Name of the scene, or what is different in it.
        size: Its size.
        cost: Its time.
    """

    title: str
    size: SceneSize
    cost: SceneCost


@dataclass(frozen=True)
class SceneCostReport:
    """What is measured.

    Attributes:
        scenes: The scenes, scene `paper` first.
        features: One scene as it is, and with one part left out or added.
        output_scene: Name of the scene whose programs are compiled.
        outputs: Its programs.
        processes: What new processes load and compile.
        installation: What is on disk; empty if it is not known what the package requires.
    """

    scenes: tuple[SceneRow, ...]
    features: tuple[SceneRow, ...]
    output_scene: str
    outputs: tuple[ProgramCost, ...]
    processes: tuple[ProcessStage, ...]
    installation: tuple[InstalledSize, ...]


def measure(effort: Effort, scenes: Mapping[str, Scene] | None = None) -> SceneCostReport:
    """Measure what scenes, their parts, unused outputs and the installation cost.

    Args:
        effort: How much to measure.
        scenes: Scenes by name, besides scene `paper`; parts and outputs are those of the first. By default
            those of `effort`, and parts and outputs of scene `paper`.

    Returns:
        The measurements.
    """
    paper = load_scene(REFERENCE)
    if scenes is None:
        scenes = {REFERENCE: paper, **{name: load_scene(name) for name in effort.scenes}}
    first = next(iter(scenes.values()))
    # The first program of a process also starts the compiler.
    compile_cold(paper, "tip_pose")
    compared, parts = {REFERENCE: paper, **scenes}, feature_variants(first)
    rows = _measure_rows([*compared.items(), *parts.items()], effort)
    integrators = programs_and_integrators(first)
    outputs = tuple(
        compile_cold(first, name, integrators.get(name, ""), effort.compilations)
        for name in OUTPUTS
        if name in integrators or name not in _OF_A_STEP
    )
    return SceneCostReport(
        scenes=tuple(rows[: len(compared)]),
        features=tuple(rows[len(compared) :]),
        output_scene=first.name,
        outputs=outputs,
        processes=tuple(measure_processes(effort.processes)),
        installation=tuple(measure_installation()),
    )


def programs_and_integrators(scene: Scene) -> dict[str, str]:
    """Programs about a step, and whose step it is.

    Args:
        scene: The scene.

    Returns:
        Names of integrators by names of programs; without second derivatives where there are none.
    """
    own = scene.simulation.integrator
    found = dict.fromkeys(_OF_A_STEP, own)
    if own in CURVATURE_OF:
        return found | {_SECOND: CURVATURE_OF[own]}
    del found[_SECOND]
    return found


def _measure_rows(scenes: list[tuple[str, Scene]], effort: Effort) -> list[SceneRow]:
    """Sizes one after another; times in turns, so that they can be compared."""
    sizes = [measure_size(scene, effort.compilations) for _, scene in scenes]
    # Two scenes may have one title.
    numbered = {str(index): scene for index, (_, scene) in enumerate(scenes)}
    costs = measure_costs(numbered, effort.timing, environments=False)
    return [SceneRow(title, size, cost) for (title, _), size, cost in zip(scenes, sizes, costs, strict=True)]
