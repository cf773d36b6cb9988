"""Everything that is measured for an effort, and what of it is less accurate than declared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

from experts.report.work_precision.cases import DEFAULT_ACCURACY, make_case, scene_case
from experts.report.work_precision.choices import integrators_of, order_of, own_choice
from experts.report.work_precision.effort import Effort
from experts.report.work_precision.formulations import (
    LIMITS,
    PINOCCHIO,
    Formulations,
    measure_formulations,
)
from experts.report.work_precision.measurement import CaseResult, measure_case

FORMULATIONS, SCENES = "formulations", "scenes"
"""Names of the comparison of accelerations and of the maneuvers of scenes, beside those of the motions."""
SCENE_TOLERANCES = (1e-3, 1e-6, 1e-9)
"""Those of adaptive integrators in the maneuvers of scenes."""
ORDER_TOLERANCE = 0.3
"""How far an observed order may be below the claimed one."""


@dataclass(frozen=True)
class WorkPrecision:
    """What is measured.

    Attributes:
        effort: How much was to be measured.
        methods: Names of the methods that were asked for; None for all.
        cases: The motions.
        formulations: The accelerations; None if not asked for.
        scenes: The expert's maneuvers in shipped scenes.
    """

    effort: Effort
    methods: tuple[str, ...] | None
    cases: tuple[CaseResult, ...]
    formulations: Formulations | None
    scenes: tuple[CaseResult, ...] = ()


def measure(
    effort: Effort,
    names: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    announce: Callable[[str], object] = lambda name: None,
) -> WorkPrecision:
    """Measure everything.

    Args:
        effort: How much to measure.
        names: Names of motions, SCENES and FORMULATIONS; those of the effort, and both, if None.
        methods: Names of methods; all if None.
        announce: Told the name of each part before it is measured.

    Returns:
        Errors and times.

    Raises:
        ModuleNotFoundError: If SciPy or mpmath is not installed.
    """
    check_packages()
    wanted = (*effort.cases, SCENES, FORMULATIONS) if names is None else tuple(names)
    cases, scenes, formulations = [], [], None
    for name in wanted:
        announce(name)
        if name == FORMULATIONS:
            formulations = measure_formulations(effort)
        elif name == SCENES:
            brief = replace(effort, most_steps=effort.scene_steps, tolerances=SCENE_TOLERANCES)
            for scene in effort.scenes:
                announce(f"scene {scene}")
                scenes.append(measure_case(scene_case(scene), brief, methods))
        else:
            cases.append(measure_case(make_case(name, effort.duration), effort, methods))
    chosen = None if methods is None else tuple(methods)
    return WorkPrecision(effort, chosen, tuple(cases), formulations, tuple(scenes))


def check_packages() -> None:
    """Make sure that the codes of the references are there.

    Raises:
        ModuleNotFoundError: If SciPy or mpmath is not installed.
    """
    missing = [name for name in ("scipy", "mpmath") if find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(
            f'the references need {" and ".join(missing)}: pip install "dq-space-arm[test]"'
        )


def shortcomings(found: WorkPrecision) -> list[str]:
    """What is less accurate than declared.

    Args:
        found: What is measured.

    Returns:
        A sentence for each; none if all is well. Times are never judged.
    """
    sentences = []
    for case in found.cases:
        sentences += _case_shortcomings(case, all_methods=found.methods is None)
    for scene in found.scenes:
        sentences += _scene_shortcomings(scene)
    if found.formulations is not None:
        for result in found.formulations.results:
            limit = LIMITS[result.precision]
            if result.name != PINOCCHIO and not result.largest_error <= limit:
                sentences.append(
                    f"{result.name} in {result.precision}: relative error {result.largest_error:.1e} of "
                    f"accelerations; it should be below {limit:g}."
                )
    return sentences


def _scene_shortcomings(scene: CaseResult) -> list[str]:
    """A scene's own integrator must follow the expert's maneuver."""
    own = own_choice(scene)
    if own is None or own.point.errors.pose <= DEFAULT_ACCURACY:
        return []
    return [
        f"scene {scene.scene}: {own.title}, its own integrator, ends the expert's maneuver "
        f"{own.point.errors.pose:.0e} off; it should be within {DEFAULT_ACCURACY:g}."
    ]


def _case_shortcomings(case: CaseResult, *, all_methods: bool) -> list[str]:
    sentences = []
    errors = [point.errors.pose for curve in integrators_of(case) for point in curve.points]
    if all_methods and not min(errors, default=float("inf")) <= case.limit:
        best = f"{min(errors):.1e}" if errors else "lost"
        sentences.append(
            f"{case.case}: the smallest error of any integrator is {best}; it should be below {case.limit:g}."
        )
    for curve in case.curves:
        order = order_of(curve, case.uncertainty)
        if case.is_smooth and order is not None and order < curve.order - ORDER_TOLERANCE:
            sentences.append(f"{case.case}: {curve.title} shows order {order:.2f}; it claims {curve.order}.")
    return sentences
