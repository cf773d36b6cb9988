"""Stiff and extreme cases: each handled within an error bound, refused in a sentence, or beyond a claim.

`cases` defines a case, `references` holds accelerations with 50 digits and by every formulation, `scenes` the
scenes and states of the cases; each other module is a group of cases. The references need mpmath.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Picture, Row
from scripts.benchmarks.stability import (
    bad_numbers,
    divided_steps,
    expert,
    extreme_motions,
    far_away,
    finite_deflections,
    long_motions,
    masses,
    motions,
    paper_form,
    payloads,
    poses,
    reactions,
    stiff_joints,
    time_steps,
)
from scripts.benchmarks.stability.cases import Case

_MODULES = (
    masses,
    reactions,
    motions,
    extreme_motions,
    stiff_joints,
    finite_deflections,
    long_motions,
    time_steps,
    divided_steps,
    paper_form,
    far_away,
    poses,
    bad_numbers,
    payloads,
    expert,
)
GROUPS: Mapping[str, Callable[[], Iterator[Case]]] = {module.GROUP: module.cases for module in _MODULES}


def all_cases(groups: Iterable[str] = ()) -> list[Case]:
    """The cases of some groups, or of all."""
    wanted = tuple(groups) or tuple(GROUPS)
    for group in wanted:
        if group not in GROUPS:
            raise ValueError(f"group: {group!r} is unknown; choose from {', '.join(GROUPS)}")
    return [case for group in wanted for case in GROUPS[group]()]


def measure(effort: Effort) -> Iterator[Row]:
    """Try all cases."""
    scenes = effort.shipped(effort.cost_scenes)
    for case in all_cases(effort.only):
        if not case.scene or case.scene in scenes:
            yield from case.rows(effort)


_PLOT = {"x": "x", "y": "y", "color": "subject", "log": "xy", "floor": 1e-16}


def _long_motions(part: str, caption: str, labels: Mapping[str, str]) -> Picture:
    """A picture of the long motions, a panel for each."""
    return Picture(
        f"stability_long_motions_{part}",
        f"curves of {long_motions.GROUP}",
        caption,
        {**_PLOT, "facet": "name", "columns": 3, "labels": labels},
        lambda row: row["name"].startswith(part),
    )


BENCHMARK = Benchmark(
    "stability",
    "Stiff and extreme cases",
    "A case is handled, with an error below its bound; refused, in the sentence that the user is told; or "
    "beyond what the method claims. All else is a failure, and stands at the top.",
    measure,
    pictures=(
        Picture(
            "stability_masses",
            f"curves of {masses.GROUP}",
            "Error of the accelerations over the ratio of base to arm mass; dashed: the bound.",
            {
                **_PLOT,
                "facet": "name",
                "floor": 1e-17,
                "levels": (masses.BACKWARD_BOUND,),
                "labels": {"x": "mass of base / mass of arm [$-$]", "y": "error [$-$]"},
            },
        ),
        Picture(
            "stability_stiff_joints",
            f"curves of {stiff_joints.GROUP}",
            f"Largest change of energy of a joint on its spring in {stiff_joints.STEPS} steps over the "
            "product of step and frequency: 1 where it is damped, at the upper edge where it blew up.",
            {
                **_PLOT,
                "labels": {"x": r"$\Delta t\,\omega$ [$-$]", "y": "largest change / first energy [$-$]"},
            },
        ),
        Picture(
            "stability_finite_deflections",
            f"curves of {finite_deflections.GROUP}",
            "Error of pose and angles after 0.3 s in steps of 15 ms over the first deflection, or rate, of a "
            "stiff joint; dashed: the bound. A point is missing where the method tells that it is not right.",
            {
                **_PLOT,
                "facet": "name",
                "columns": 3,
                "levels": (finite_deflections.RIGHT,),
                "labels": {"x": "deflection [rad], rate [rad/s]", "y": "error [rad, m]"},
            },
        ),
        _long_motions(
            long_motions.ENERGY,
            "Largest change of the energy of free motions in steps of 15 ms over the number of steps.",
            {"x": "steps [$-$]", "y": "change / first energy [$-$]"},
        ),
        _long_motions(
            long_motions.MOMENTUM,
            "Largest change of the momentum, linear or angular, of the same motions.",
            {"x": "steps [$-$]", "y": "change / first momentum [$-$]"},
        ),
        _long_motions(
            long_motions.TIP,
            "Error of the tip's pose after 6 s over run time, in steps of several lengths.",
            {"x": "run time [ms]", "y": "error [$-$, m]"},
        ),
    ),
    packages=("mpmath", "pin", "mujoco"),
)
