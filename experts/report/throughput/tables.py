"""The throughput of a scene as tables on the terminal, 110 columns wide."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from rich.console import Console
from rich.text import Text

from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.peak import Peak
from experts.report.tables import plain_table
from experts.report.throughput.agreement import Agreement
from experts.report.throughput.environments import MAKE, MAKE_VEC, UNWRAPPED
from experts.report.throughput.formats import (
    integrator_title,
    nanoseconds,
    per_second,
    rates,
    three_digits,
    utilization,
)
from experts.report.throughput.kernels import SCALAR, VECTOR
from experts.report.throughput.measurement import SceneThroughput
from experts.report.throughput.ratios import ratios
from experts.report.throughput.timing import DYNAMICS, ENVIRONMENT, OURS, STEP, select
from experts.report.throughput.variants import PLAIN, VARIANTS, Variant

_MODULE = "gymnasium."  # in front of the names of makers
_THREADS = ("1 thread", "2 threads", "speed")


def print_peaks(console: Console, peaks: Mapping[str, Peak]) -> None:
    """Print what one core can do.

    Args:
        console: Where to print.
        peaks: Peak of a core for each precision.
    """
    rates = (f"{peak.operations_per_ns:.0f} Gflop/s in {name}" for name, peak in peaks.items())
    console.print(f"Measured multiply-add peak of a core: {', '.join(rates)}.\n")


def print_scene(console: Console, result: SceneThroughput, peaks: Mapping[str, Peak]) -> None:
    """Print what is measured of a scene.

    Args:
        console: Where to print.
        result: What is measured.
        peaks: Peak of a core for each precision.
    """
    programs = [
        (DYNAMICS, ""),
        *((STEP, name) for name in COMPARED_INTEGRATORS),
        (ENVIRONMENT, result.integrator),
    ]
    for what, integrator in programs:
        _print_kernel(console, result, peaks, what, integrator)
    _print_environments(console, result)
    _print_threads(console, result)
    _print_peers(console, result)
    console.print(
        plain_table(
            f"Scene {result.scene}: largest errors (dt = {result.dt:g} s)",
            ("", "engine", "compared with", "integrator", "error"),
            (_agreement_row(agreement) for agreement in result.agreements),
            right=4,
        ),
        *(Text(note) for note in result.notes),
    )


def _print_kernel(
    console: Console, result: SceneThroughput, peaks: Mapping[str, Peak], what: str, integrator: str
) -> None:
    """A row for each batch size; time for every variant, use of the core for the vector code."""
    timings = select(result.timings, engine=OURS, what=what, integrator=integrator)
    scalar, vector = select(timings, way=SCALAR), select(timings, way=VECTOR)
    title = f"{integrator_title(integrator)} {what}".strip()
    if what == ENVIRONMENT:
        title += ", compiled part"
    headings = ["states", "scalar"]
    for variant in VARIANTS[:3]:
        headings += [_heading("vector", variant), "op/ns,\nof peak"]
    rows = []
    for single in scalar:
        row = [f"{single.batch:,}", nanoseconds(single)]
        for variant in VARIANTS[:3]:
            for timing in select(vector, batch=single.batch, **vars(variant)):
                row += [nanoseconds(timing), utilization(timing, peaks)]
        rows.append(row)
    heading = f"Scene {result.scene}: {title}, {scalar[0].operations} operations, ns per state, best (median)"
    console.print(plain_table(heading, headings, rows, right=0))


def _heading(title: str, variant: Variant) -> str:
    """What is special about a variant, below a title."""
    special = [variant.precision] * (variant.precision != PLAIN.precision)
    special += [f"{variant.threads} threads"] * (variant.threads != 1)
    return "\n".join([title, *special])


def _print_environments(console: Console, result: SceneThroughput) -> None:
    timings = select(result.timings, engine=OURS, what=ENVIRONMENT)
    columns = [(PLAIN, name) for name in COMPARED_INTEGRATORS] + [
        (variant, result.integrator) for variant in VARIANTS if variant != PLAIN
    ]
    rows = []
    for way in (UNWRAPPED, MAKE, MAKE_VEC):
        for batch in dict.fromkeys(timing.batch for timing in select(timings, way=way)):
            row = [way.removeprefix(_MODULE), f"{batch:,}"]
            for variant, integrator in columns:
                chosen = select(timings, way=way, batch=batch, integrator=integrator, **vars(variant))
                row.append(rates(chosen[0]) if chosen else "")
            rows.append(row)
    console.print(
        plain_table(
            f"Scene {result.scene}: environment steps per second, best (median)",
            ("made by", "copies", *(_heading(integrator_title(name), variant) for variant, name in columns)),
            rows,
            right=1,
        ),
        "The copies' episodes end at times spread evenly, as in training: resets are part of the time.\n",
    )


def _print_threads(console: Console, result: SceneThroughput) -> None:
    """One thread and two, on an idle machine and while another process keeps a core busy."""
    rows = []
    for busy in select(result.busy_timings, threads=1):
        same = {name: getattr(busy, name) for name in ("what", "way", "integrator", "batch", "precision")}
        way = "kernel" if busy.way == VECTOR else busy.way.removeprefix(_MODULE)
        row = [f"{integrator_title(busy.integrator)} {busy.what}, {way}", f"{busy.batch:,}"]
        for timings in (result.timings, result.busy_timings):
            one, two = (select(timings, engine=OURS, threads=count, **same)[0] for count in (1, 2))
            row += [three_digits(timing.median_ns) for timing in (one, two)]
            row.append(f"{one.median_ns / two.median_ns:.2f}")
        rows.append(row)
    console.print(
        plain_table(
            f"Scene {result.scene}: threads, ns per state, median; alone, and beside a busy process",
            ("", "states", *(f"{kind}\n{what}" for kind in ("alone", "beside") for what in _THREADS)),
            rows,
            right=1,
        )
    )


def _print_peers(console: Console, result: SceneThroughput) -> None:
    theirs = [timing for timing in result.timings if timing.engine != OURS]
    if not theirs:
        return
    console.print(
        plain_table(
            f"Scene {result.scene}: other engines, float64, one thread, ns per state, best (median)",
            ("", "engine", "way", "time", "per s"),
            (
                (
                    f"{integrator_title(timing.integrator)} {timing.what}".strip(),
                    timing.engine,
                    timing.way,
                    nanoseconds(timing),
                    per_second(timing.best_ns),
                )
                for timing in theirs
            ),
            right=3,
        ),
        plain_table(
            f"Scene {result.scene}: states per second, ours over theirs, float64, one thread, best of each",
            ("", "ours", "ns", "theirs", "ns", "ratio"),
            _ratio_rows(result),
            right=5,
        ),
        "The other engines are general ones, as their packages are built; our code is compiled for this "
        "scene and this\nprocessor. Our environment's step holds cost, observation of the tip and info; "
        "theirs does less.\n",
    )


def _ratio_rows(result: SceneThroughput) -> Iterator[tuple[str, ...]]:
    for ratio in ratios(result):
        ours, theirs = ratio.ours, ratio.theirs
        way = ours.way.removeprefix(_MODULE)
        yield (
            f"{integrator_title(theirs.integrator)} {ratio.what}".strip(),
            f"{way}, {ours.batch:,}" if ours.batch > 1 else way,
            three_digits(ours.best_ns),
            f"{theirs.engine}: {theirs.way}",
            three_digits(theirs.best_ns),
            f"{three_digits(ratio.speed)}",
        )


def _agreement_row(agreement: Agreement) -> tuple[str, ...]:
    unit = ", relative" if agreement.unit == "1" else f" {agreement.unit}"
    return (
        agreement.quantity,
        agreement.engine,
        agreement.reference,
        integrator_title(agreement.integrator),
        f"{agreement.error:.1e}{unit}",
    )
