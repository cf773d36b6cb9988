"""The work-precision report as tables of text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from experts.report.tables import TextTable
from experts.report.throughput.formats import three_digits
from experts.report.work_precision.benchmark import WorkPrecision
from experts.report.work_precision.cases import DEFAULT_ACCURACY
from experts.report.work_precision.choices import (
    ACCURACIES,
    Choice,
    cheapest,
    default_at_step,
    order_of,
    own_choice,
)
from experts.report.work_precision.formulations import Formulations
from experts.report.work_precision.measurement import CaseResult, Curve, Point

_EXPLAINED = (
    "Motions: order claimed and shown; time of a step of a single motion, and of one of 1024 on one core; "
    "the longest step that does not lose the motion, with its error of the tip; the least error, with those "
    "of angular momentum [kg m^2/s] and of energy [relative] at that step."
)

CHEAPEST = "The cheapest method and step that reach an accuracy"


def tables(found: WorkPrecision) -> list[TextTable]:
    """Make the tables.

    Args:
        found: What is measured.

    Returns:
        One for each motion, the cheapest choices, the defaults, the formulations.
    """
    made = [_case_table(case) for case in found.cases]
    if found.cases:
        made += [_choices_table(CHEAPEST, found.cases), _defaults_table(found.cases)]
    if found.scenes:
        made += [_choices_table(f"{CHEAPEST}, in each scene", found.scenes), _scenes_table(found.scenes)]
    if found.formulations is not None:
        made.append(_formulations_table(found.formulations))
    return made


def notes(found: WorkPrecision) -> list[str]:
    """Sentences below the tables.

    Args:
        found: What is measured.

    Returns:
        Where the references come from, and what is left out.
    """
    sentences = [_EXPLAINED] if found.cases else []
    for case in found.cases:
        trust = ""
        if case.uncertainty is not None:
            trust = f"; on our own accelerations it ends {case.uncertainty:.0e} from there"
        sentences.append(f"{case.title}: reference {case.reference}{trust}.")
    if found.formulations is not None:
        sentences.append(
            f"Accelerations: reference, (20) with 50 digits; the articulated body with as many is "
            f"{found.formulations.reference_agreement:.0e} from it, for constants are rounded."
        )
        sentences += found.formulations.notes
    return sentences


def _case_table(case: CaseResult) -> TextTable:
    return TextTable(
        f"{case.title}: {case.duration:g} s",
        (
            "",
            "order,\nshown",
            "ns/step\none",
            "ns/step\nof 1024",
            "longest\nstep s",
            "error\nm, rad",
            "least\nerror",
            "at step\ns",
            "momen-\ntum",
            "energy",
        ),
        tuple(_curve_row(curve, case.uncertainty) for curve in case.curves),
        right=1,
    )


def _curve_row(curve: Curve, uncertainty: float | None) -> tuple[str, ...]:
    order = order_of(curve, uncertainty)
    times = (three_digits(curve.single_step_ns), three_digits(curve.batch_step_ns))
    orders = f"{curve.order}, {'-' if order is None else f'{order:.1f}'}"
    if not curve.points:
        return (curve.title, orders, *times, "lost", "-", "-", "-", "-", "-")
    first, best = curve.points[0], min(curve.points, key=lambda point: point.errors.pose)
    return (
        curve.title,
        orders,
        *times,
        _step(first),
        f"{first.errors.pose:.0e}",
        f"{best.errors.pose:.0e}",
        _step(best),
        f"{best.errors.angular_momentum:.0e}",
        f"{best.errors.energy:.0e}",
    )


def _step(point: Point) -> str:
    if point.tolerance is not None:
        return f"tol. {point.tolerance:.0e}"
    return f"{point.step:.3g}"


def _choices_table(title: str, cases: Iterable[CaseResult]) -> TextTable:
    return TextTable(
        f"{title}; µs per simulated second",
        ("", "error", "of 1024 on one core", "µs", "a single motion", "µs"),
        tuple(row for case in cases for row in _choice_rows(case)),
    )


def _choice_rows(case: CaseResult) -> Iterator[tuple[str, ...]]:
    for index, accuracy in enumerate(ACCURACIES):
        batch, single = (cheapest(case.curves, accuracy, batch=batch) for batch in (True, False))
        yield (
            "" if index else case.title,
            f"{accuracy:g}",
            *_choice(batch, batch=True),
            *_choice(single, batch=False),
        )


def _choice(choice: Choice | None, *, batch: bool) -> tuple[str, str]:
    if choice is None:
        return "not reached", "-"
    time = choice.point.batch_ns if batch else choice.point.single_ns
    return f"{choice.title}, {_step(choice.point)}", three_digits(1e-3 * time)


def _defaults_table(cases: Iterable[CaseResult]) -> TextTable:
    rows = []
    for case in cases:
        choice = default_at_step(case, case.dt)
        found = (
            ("none follows it", "-", "-")
            if choice is None
            else (choice.title, _step(choice.point), f"{choice.point.errors.pose:.0e}")
        )
        rows.append((case.title, f"{case.dt:g}", *found))
    return TextTable(
        f"The integrator that a scene of its kind should name: the cheapest one that is right to "
        f"{DEFAULT_ACCURACY:g} at the scene's step, or the most accurate one",
        ("", "step of the scene [s]", "integrator", "step", "error [m, rad]"),
        tuple(rows),
        right=4,
    )


def _scenes_table(scenes: Iterable[CaseResult]) -> TextTable:
    rows = []
    for scene in scenes:
        own, best = own_choice(scene), default_at_step(scene, scene.dt)
        rows.append(
            (
                scene.scene,
                scene.integrator,
                "lost" if own is None else f"{own.point.errors.pose:.0e}",
                "-" if best is None else best.title,
                "-" if best is None else f"{best.point.errors.pose:.0e}",
            )
        )
    return TextTable(
        f"The integrator of each scene, and the cheapest one that follows the expert's maneuver to "
        f"{DEFAULT_ACCURACY:g} m and rad at the scene's step, a thousandth of what counts as a success",
        ("", "its own", "error", "cheapest", "error"),
        tuple(rows),
    )


def _formulations_table(found: Formulations) -> TextTable:
    return TextTable(
        f"Accelerations in scene {found.scene}: relative error in {found.states} states, and time",
        ("", "precision", "largest\nerror", "median\nerror", "backward\nerror", "ns,\none", "ns,\nof 1024"),
        tuple(
            (
                result.name,
                result.precision,
                f"{result.largest_error:.1e}",
                f"{result.median_error:.1e}",
                f"{result.backward_error:.1e}",
                "-" if result.single_ns is None else three_digits(result.single_ns),
                "-" if result.batch_ns is None else three_digits(result.batch_ns),
            )
            for result in found.results
        ),
        right=2,
    )
