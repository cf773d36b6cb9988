"""The parts of the report: each measures, quickly or fully, and yields its section."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict

from rich.console import Console

from dq_space_arm_env import load_scene
from experts.report import stability as stability_cases
from experts.report.page.sections import Section, printed
from experts.report.peak import measure_peak
from experts.report.scene_cost import measurement as scene_cost
from experts.report.scene_cost.records import report_record as scene_cost_record
from experts.report.scene_cost.tables import tables as scene_cost_tables
from experts.report.solvers import effort as solver_effort
from experts.report.solvers import judgement as solver_judgement
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.records import benchmark_record
from experts.report.stability import tables as stability_tables
from experts.report.stability.records import record as stability_record
from experts.report.throughput.agreement import ACCELERATIONS, Agreement
from experts.report.throughput.kernels import VECTOR
from experts.report.throughput.measurement import measure_scene
from experts.report.throughput.records import scene_record
from experts.report.throughput.tables import print_peaks, print_scene
from experts.report.throughput.timing import OURS
from experts.report.throughput.timing import QUICK as QUICK_TIMING
from experts.report.throughput.timing import Effort as TimingEffort
from experts.report.work_precision import effort as work_effort
from experts.report.work_precision.benchmark import measure as measure_work_precision
from experts.report.work_precision.benchmark import shortcomings
from experts.report.work_precision.records import report_record as work_precision_record
from experts.report.work_precision.tables import notes, tables

AGREEMENT = 1e-10
"""Largest relative difference of our accelerations, in double precision, from those of other engines."""

Announce = Callable[[str], object]
"""Told what is being measured."""


def work_precision(*, quick: bool, announce: Announce) -> Section:
    """Error against run time of integrators and formulations.

    Args:
        quick: Whether to measure little.
        announce: Told the name of each motion.

    Returns:
        The section.
    """
    found = measure_work_precision(work_effort.QUICK if quick else work_effort.FULL, announce=announce)
    section = Section(
        "work_precision",
        "Error against run time",
        "Each integrator follows motions whose end is known from other codes, with steps from coarse to "
        "where rounding dominates. A method of order p gains p digits for every factor of ten in time; the "
        "best choice for an accuracy is the leftmost curve at its height. The last tables name the cheapest "
        "choices, the integrator that a scene should have, and compare formulations of the dynamics.",
        tables(found),
        notes=notes(found),
        shortcomings=shortcomings(found),
        record=work_precision_record(found),
    )

    def picture() -> bytes:
        from experts.report.figures.work_precision import picture as draw

        return draw(found)

    section.draw(
        "work_precision",
        "Error of the tip at the end of each motion over the time that a simulated second takes. Lower left "
        "is better. Gray lines: slopes of the orders; gray areas: where two references differ; dashed: 1e-3, "
        "1e-6 and 1e-9. Last panel: accelerations, filled in float64, empty in float32.",
        picture,
    )
    return section


def stability(*, quick: bool, announce: Announce) -> Section:
    """Stiff and extreme cases.

    Args:
        quick: Whether to try little.
        announce: Told the name of each case that is done.

    Returns:
        The section.
    """
    effort = stability_cases.QUICK if quick else stability_cases.FULL
    rows = stability_cases.run_cases(effort, progress=lambda row: announce(f"{row.group}, {row.name}"))
    section = Section(
        "stability",
        "Stiff and extreme cases",
        "A case is handled, with an error below its bound; refused, in the sentence that the user is told; "
        "or beyond what the method claims. Whatever else happens is a failure, and stands at the top.",
        stability_tables.tables(rows),
        notes=[stability_tables.summary(rows)],
        shortcomings=stability_tables.failures(rows),
        record=stability_record(rows, effort),
    )

    def picture() -> bytes:
        from experts.report.figures.stability import picture as draw

        return draw(rows)

    section.draw("stability", "Error over what makes each case extreme; dashed: its bound.", picture)
    return section


def scene_costs(*, quick: bool, announce: Announce) -> Section:
    """What scenes leave out.

    Args:
        quick: Whether to measure little.
        announce: Not called.

    Returns:
        The section.
    """
    found = scene_cost.measure(scene_cost.QUICK if quick else scene_cost.FULL)
    section = Section(
        "scene_cost",
        "What a scene leaves out",
        "A part that a scene does not have, and an output that nobody asks for, cost nothing: neither "
        "operations nor memory nor time to compile.",
        scene_cost_tables(found),
        record=scene_cost_record(found),
    )

    def picture() -> bytes:
        from experts.report.figures.scene_cost import picture as draw

        return draw(found)

    caption = (
        "Operations and time of an environment's step: scenes, and parts of one scene, left out or added."
    )
    section.draw("scene_cost", caption, picture)
    return section


def expert(*, quick: bool, announce: Announce) -> Section:
    """The expert beside other solvers: cost gap against seconds.

    Args:
        quick: Whether to measure little.
        announce: Told the name of each part.

    Returns:
        The section.
    """
    found = ExpertBenchmark(solver_effort.QUICK if quick else solver_effort.Effort(), seed=0)
    scene = load_scene("paper")

    def run(console: Console) -> None:
        for part in solver_effort.PARTS:
            announce(part)
            found.run(console, scene, (part,))

    section = Section(
        "expert",
        "The expert: cost gap against seconds",
        "What an iteration costs; how soon solvers come close to the best cost known, from the scene's start "
        "and from random ones; and the expert that plans anew during flight.",
        printed=printed(run),
    )
    section.shortcomings = solver_judgement.shortcomings(found)
    section.record = benchmark_record(found, interrupted=False)
    solved = [starts for starts in found.random_starts if starts.starts]

    def picture() -> bytes:
        from experts.report.figures.solvers import picture as draw

        return draw(found.comparisons, solved)

    caption = (
        "Above: cost above the best one known over time, for each solver. Below: share of random starts that "
        "each had solved to within 1 % after a time."
    )
    section.draw("expert", caption, picture)
    return section


def throughput(*, quick: bool, announce: Announce) -> Section:
    """States and environment steps per second, beside other engines.

    Args:
        quick: Whether to measure little.
        announce: Not called.

    Returns:
        The section.
    """
    effort = QUICK_TIMING if quick else TimingEffort()
    peaks = measure_peak(effort.repeats)
    found = measure_scene(load_scene("paper"), effort)

    def run(console: Console) -> None:
        print_peaks(console, peaks)
        print_scene(console, found, peaks)

    section = Section(
        "throughput",
        "Throughput",
        "Time per state of the compiled kernels and environments, with their share of what a core can do, "
        "and other engines with the same robot; each with its error. Best of several samples, median beside "
        "it.",
        printed=printed(run),
        shortcomings=disagreements(found.agreements),
        record={
            "peaks": {name: asdict(peak) for name, peak in peaks.items()},
            "scenes": [scene_record(found, peaks)],
        },
    )

    def picture() -> bytes:
        from experts.report.figures.throughput import picture as draw

        return draw([found])

    caption = "States and environment steps per second over the batch size; other engines as lines."
    section.draw("throughput", caption, picture)
    return section


def disagreements(agreements: list[Agreement]) -> list[str]:
    """Where accelerations in double precision are not what other engines, or our own scalar code, say.

    Args:
        agreements: How far results are apart.

    Returns:
        A sentence for each; none if all is well.
    """
    return [
        f"accelerations: {agreement.engine} and {agreement.reference} differ by {agreement.error:.1e}; it "
        f"should be below {AGREEMENT:g}."
        for agreement in agreements
        if agreement.quantity == ACCELERATIONS
        and agreement.engine in (OURS, VECTOR)
        and not agreement.error <= AGREEMENT
    ]


PARTS: Mapping[str, Callable[..., Section]] = {
    "work_precision": work_precision,
    "stability": stability,
    "scene_cost": scene_costs,
    "expert": expert,
    "throughput": throughput,
}
"""Each part by its name; called with `quick` and `announce`."""
