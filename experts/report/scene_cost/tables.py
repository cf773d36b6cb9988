"""What scenes, their parts, unused outputs, new processes and the installation cost, as tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median

from experts.report.scene_cost.installation import InstalledSize
from experts.report.scene_cost.measurement import OUTPUTS, SceneCostReport, SceneRow
from experts.report.scene_cost.processes import OPTIONAL, ProcessStage
from experts.report.scene_cost.programs import ProgramCost
from experts.report.scene_cost.records import ratios
from experts.report.scene_cost.sizes import COMPARED_INTEGRATORS
from experts.report.tables import TextTable
from experts.report.throughput.formats import integrator_title, three_digits
from experts.report.throughput.scene_costs import BATCH


def tables(report: SceneCostReport) -> list[TextTable]:
    """Show a report.

    Args:
        report: The report.

    Returns:
        Tables that fit a terminal of 110 columns.
    """
    return [
        _sizes("Scenes: size of the equations and of the compiled step", report.scenes),
        _work("Scenes: operations and time", report.scenes),
        _sizes(f"Parts of scene {report.output_scene}, one at a time: size", report.features),
        _work(f"Parts of scene {report.output_scene}, one at a time: operations and time", report.features),
        _outputs(report.output_scene, report.outputs),
        *_processes(report.processes),
        *_installation(report.installation),
    ]


def _sizes(title: str, rows: Sequence[SceneRow]) -> TextTable:
    headings = ["", "n_x", "n_t", "n_u", "n_o", "state\n\nB"]
    for step in ("step", "env."):
        headings += [f"{step}\nwork\nB", "\ncode\nkB", "\ncold\ns"]
    cells = []
    for row in rows:
        size = row.size
        counts = (size.states, size.tangent_states, size.inputs, size.observations, size.state_bytes)
        compiled = (size.step, size.environment_step)
        cells.append((row.title, *map(str, counts), *(text for step in compiled for text in _compiled(step))))
    explained = (
        "numbers of states, tangent states, inputs, entries of an observation; memory per state in a step; "
        "machine code; seconds until it is ready for the first time; env.: step of an environment"
    )
    return TextTable(f"{title}\n{explained}", tuple(headings), tuple(cells), right=1)


def _compiled(program: ProgramCost) -> tuple[str, str, str]:
    return f"{program.memory_bytes:,}", _kilobytes(program.code_bytes), f"{program.seconds:.2f}"


def _work(title: str, rows: Sequence[SceneRow]) -> TextTable:
    steps = [f"{integrator_title(name)}\nops" for name in COMPARED_INTEGRATORS]
    first = rows[0].title
    headings = ("", "dynamics\nops", *steps, "step\nns", "ratio", "env. step\nops", "ratio", "ns", "ratio")
    cells = []
    for row in rows:
        ratio = ratios(row, rows[0])
        cells.append(
            (
                row.title,
                f"{row.size.dynamics_operations:,}",
                *(f"{row.size.step_operations[name]:,}" for name in COMPARED_INTEGRATORS),
                three_digits(row.cost.step.best_ns),
                f"{ratio.step_time:.2f}",
                f"{row.size.environment_step.operations:,}",
                f"{ratio.environment_operations:.2f}",
                three_digits(row.cost.environment_step.best_ns),
                f"{ratio.environment_time:.2f}",
            )
        )
    explained = f"ns per state, best, vector kernels on {BATCH:,} states; ratios to “{first}”"
    integrators = {integrator_title(row.cost.integrator) for row in rows}
    if len(integrators) == 1:
        explained += f"; times with {integrators.pop()}"
    return TextTable(f"{title}\n{explained}", headings, tuple(cells), right=1)


def _outputs(scene: str, programs: Sequence[ProgramCost]) -> TextTable:
    step = programs[0]
    headings = (
        "",
        "program",
        "operations",
        "of a step",
        "code\nB",
        "work\nB",
        "traced\nin s",
        "compiled\nin s",
    )
    cells = tuple(
        (
            OUTPUTS[program.name],
            program.name,
            f"{program.operations:,}",
            f"{program.operations / step.operations:.2f}",
            _kilobytes(program.code_bytes),
            f"{program.memory_bytes:,}",
            f"{program.trace_seconds:.2f}",
            f"{program.compile_seconds:.2f}",
        )
        for program in programs
    )
    title = f"Outputs of scene {scene}: what each costs who asks for it, and nobody else"
    return TextTable(title, headings, cells, right=2)


def _processes(stages: Sequence[ProcessStage]) -> Iterator[TextTable]:
    cells, additions = [], []
    for empty, warm in _pairs(stages):
        cells.append((empty.title, *_seconds(empty), *_seconds(warm)))
        more = ", ".join(name for name in empty.packages if name not in warm.packages)
        imports = ", ".join(warm.packages) + (f"; with an empty cache also {more}" if more else "")
        additions.append((empty.title, imports or "nothing", ", ".join(empty.kernels) or "nothing"))
    loaded = {name for stage in stages for name in stage.optional}
    never = ", ".join(name for name in OPTIONAL if name not in loaded)
    additions.append(("never", never, "what is not called"))
    caches = [
        f"{cache}\n{what}" for cache in ("empty cache", "warm cache") for what in ("best s", "median s")
    ]
    headings = ("", *caches[:2], "\nmodules", *caches[2:], "\nmodules")
    yield TextTable("A new process, stage by stage, scene paper", headings, tuple(cells), right=1)
    headings = ("", "imports of others", "compiles, with an empty cache")
    yield TextTable("What each stage adds to those before", headings, tuple(additions))


def _pairs(stages: Sequence[ProcessStage]) -> Iterator[tuple[ProcessStage, ProcessStage]]:
    """Each stage with an empty cache, and with a warm one."""
    warm = {stage.title: stage for stage in stages if stage.cached}
    return ((stage, warm[stage.title]) for stage in stages if not stage.cached)


def _seconds(stage: ProcessStage) -> tuple[str, str, str]:
    return f"{min(stage.seconds):.3f}", f"{median(stage.seconds):.3f}", str(stage.modules)


def _installation(sizes: Sequence[InstalledSize]) -> Iterator[TextTable]:
    if not sizes:
        return
    cells = []
    for size in sizes:
        largest = sorted(size.distributions.items(), key=lambda item: -item[1])[:4]
        parts = ", ".join(f"{name} {_megabytes(count)}" for name, count in largest)
        if size.missing:
            missing = f"not installed: {', '.join(size.missing)}"
            parts = f"{parts}; {missing}" if parts else missing
        known = size.bytes or not size.missing
        cells.append(
            (
                f"[{size.extra}] adds" if size.extra else "the package with what it requires",
                str(len(size.distributions)) if known else "",
                _megabytes(size.bytes) if known else "",
                parts,
            )
        )
    headings = ("", "packages", "MB", "the largest, MB")
    yield TextTable("On disk, without byte code", headings, tuple(cells))


def _kilobytes(count: int) -> str:
    return f"{count / 1e3:.1f}"


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.1f}"
