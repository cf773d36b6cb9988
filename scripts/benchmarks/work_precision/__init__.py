"""Error against run time: of the integrators on motions with a reference, and of the formulations.

motions        motions that every integrator follows
references     where each motion ends, from independent codes; `many_digits`: in 30 digits
methods        ways to take a step: the integrators by name, and the paper's own formulation
measurement    error and time for each method and step, and what follows from them
formulations   accelerations in different formulations and precisions: error and time
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec

from dq_space_arm_env import load_scene
from dq_space_arm_env.common.tables import Column
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Picture, Row, Table, note, one_by_one, time_column

FORMULATIONS, SCENES = "formulations", "scenes"  # parts besides the motions
MANEUVER_TOLERANCES = (1e-3, 1e-6, 1e-9)  # of adaptive integrators in the maneuvers of scenes
_TINY = "{:.0e}".format


def measure(effort: Effort) -> Iterator[Row]:
    """Follow the motions and the maneuvers, and compare the formulations."""
    missing = [name for name in ("scipy", "mpmath") if find_spec(name) is None]
    if missing:
        yield note(f'The references need {" and ".join(missing)}: pip install "dq-space-arm[test]".')
        return
    from scripts.benchmarks.work_precision.formulations import measure_formulations
    from scripts.benchmarks.work_precision.measurement import maneuver_rows, measure_case, rows_of
    from scripts.benchmarks.work_precision.motions import CASES, make_case

    parts = effort.only or (*effort.motions, SCENES, FORMULATIONS)
    for part in parts:
        if part == FORMULATIONS:
            yield from measure_formulations(effort)
        elif part == SCENES:
            brief = replace(effort, most_steps=effort.maneuver_steps, tolerances=MANEUVER_TOLERANCES)
            names = effort.shipped(effort.maneuvers)
            for name in names:
                load_scene(name)  # an unusable one is refused before the first is measured
            for name in names:
                yield from one_by_one(f"scene {name}", maneuver_rows(name, brief))
        elif part in CASES:
            result = measure_case(make_case(part, effort.duration), effort)
            yield from rows_of(result, all_methods=not effort.methods)
        else:
            raise ValueError(
                f"only: {part!r} is unknown; choose from {', '.join((*CASES, SCENES, FORMULATIONS))}"
            )


BENCHMARK = Benchmark(
    "work-precision",
    "Error against run time",
    "Each integrator follows motions whose end is known from other codes, with steps from coarse to where "
    "rounding dominates. A method of order p gains p digits for every factor of ten in time; the best choice "
    "for an accuracy is the leftmost curve at its height.",
    measure,
    tables=(
        Table(
            "methods",
            "{case}: {duration_s:g} s\nns per step of a single motion, and of one of 1024 on one core; the "
            "longest step that follows the motion, with its error of the tip; the least error, with those of "
            "angular momentum [kg m^2/s] and of energy [relative] there",
            (
                "method",
                "order",
                Column("observed_order", "shown", ".1f"),
                time_column("single_ns_per_step", "ns/step\none"),
                time_column("batch_ns_per_step", "ns/step\nof 1024"),
                Column("longest_step", "longest\nstep s"),
                Column("error_there", "error\nm, rad", _TINY),
                Column("least_error", "least\nerror", _TINY),
                Column("least_at", "at step\ns"),
                Column("angular_momentum", "momen-\ntum", _TINY),
                Column("energy", format=_TINY),
            ),
            by=("case",),
        ),
        Table(
            "cheapest",
            "The cheapest method and step that reach an accuracy; µs per simulated second",
            (
                "case",
                Column("accuracy", "error", "g"),
                Column("batch", "of 1024 on one core", missing="not reached"),
                time_column("batch_us", "µs"),
                Column("single", "a single motion", missing="not reached"),
                time_column("single_us", "µs"),
            ),
        ),
        Table(
            "defaults",
            "The integrator of each scene, and the cheapest that is right to 1e-4 at the scene's step, or "
            "the most accurate\n1e-4 m is a thousandth of what counts as a success in scene paper",
            (
                "case",
                Column("dt_s", "step [s]", "g"),
                Column("own", "its own"),
                Column("own_error", "error", _TINY),
                Column("best", "cheapest"),
                Column("best_step_s", "step [s]"),
                Column("best_error", "error", _TINY),
            ),
        ),
        Table(
            "estimates",
            "{case}: the global error that `integrate(...).global_error()` tells, and the true one\n"
            "the larger of pose and angles at the end, rad or m",
            (
                Column("tolerance", format=_TINY),
                Column("error", "true", ".1e"),
                Column("estimate", "estimated", ".1e"),
                Column("ratio", format=".2f"),
            ),
            by=("case",),
        ),
        Table(
            "references",
            "Where each motion ends, according to",
            ("case", "reference", Column("second_reference_off_by", "second reference off by", _TINY)),
        ),
        Table(
            "formulations",
            "Accelerations: relative error, and time",
            (
                "formulation",
                "precision",
                Column("largest_error", "largest\nerror", ".1e"),
                Column("median_error", "median\nerror", ".1e"),
                Column("backward_error", "backward\nerror", ".1e"),
                time_column("single_ns", "ns,\none"),
                time_column("batch_ns", "ns,\nof 1024"),
            ),
        ),
    ),
    pictures=(
        Picture(
            "work_precision",
            "points",
            "Error of the tip at the end of each motion over the time of a simulated second. Lower left is "
            "better. Dashed: 1e-3, 1e-6 and 1e-9.",
            {
                "x": "batch_us_per_s",
                "y": "error",
                "color": "method",
                "facet": "case",
                "log": "xy",
                "floor": 1e-16,
                "levels": (1e-3, 1e-6, 1e-9),
                "labels": {
                    "batch_us_per_s": "time per simulated second, one of 1024 [µs]",
                    "error": "error of the tip [m, rad]",
                },
            },
        ),
        Picture(
            "estimates",
            "estimates",
            "Estimated global error over the true one, of adaptive integration with smaller and smaller "
            "tolerances: on the diagonal the estimate is exact.",
            {
                "x": "error",
                "y": "estimate",
                "color": "case",
                "log": "xy",
                "floor": 1e-16,
                "labels": {
                    "error": "true error of pose and angles [rad, m]",
                    "estimate": "estimated error [rad, m]",
                },
            },
        ),
        Picture(
            "formulations",
            "formulations",
            "Accelerations: error over time, filled in float64, empty in float32.",
            {
                "x": "batch_ns",
                "y": "largest_error",
                "color": "formulation",
                "marker": "precision",
                "log": "xy",
                "floor": 1e-16,
                "join": False,
                "labels": {
                    "batch_ns": "time per call, one of 1024 [ns]",
                    "largest_error": "largest relative error",
                },
            },
        ),
    ),
    packages=("mpmath", "pin", "scipy"),
)
