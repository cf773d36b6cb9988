"""Time the compiled kernels and the environments, beside Pinocchio and MuJoCo if installed.

For each scene: forward dynamics and steps in ns per state with their share of the core's peak, environment
steps per second, float32 and two threads beside float64 and one, the other engines, and how far all results
are apart; then the time that a new process needs. The output folder gets throughput.json and, with the extra
`plots`, throughput.png. Everything at once: --all-scenes --features.
Every number is the best of several samples, with the median beside it: on a shared machine the best says what
the code can do, and a median far above it that the machine was busy.
Exit status: 0; 2 if the input is unusable; 130 if interrupted.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console

from dq_space_arm_env import Scene, list_scenes, load_scene
from experts.report.command import SUCCESS, guarded, parser_of, save, table_console
from experts.report.peak import measure_peak
from experts.report.provenance import provenance
from experts.report.start_up import measure_start_up
from experts.report.throughput.cost_tables import print_feature_costs, print_scene_costs, print_start_up
from experts.report.throughput.features import feature_variants
from experts.report.throughput.measurement import SceneThroughput, measure_scene
from experts.report.throughput.records import cost_records, scene_record
from experts.report.throughput.scene_costs import measure_costs
from experts.report.throughput.tables import print_peaks, print_scene
from experts.report.throughput.timing import QUICK, Effort


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    options = _parse(arguments)
    return guarded(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    console = table_console()
    scenes = [load_scene(name) for name in options.scene or ["paper"]]
    options.out.mkdir(parents=True, exist_ok=True)
    record, results = _measure(console, scenes, options)
    save(console, options, "throughput", record, lambda: _picture(results))
    return SUCCESS


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = parser_of(__doc__, "throughput")
    parser.add_argument(
        "--scene",
        action="append",
        help="name of a shipped scene, or path of a YAML file; repeatable (default: paper)",
    )
    parser.add_argument("--all-scenes", action="store_true", help="what each shipped scene costs")
    parser.add_argument("--features", action="store_true", help="what each part of the first scene costs")
    parser.add_argument("--quick", action="store_true", help="three batch sizes, short samples")
    return parser.parse_args(arguments)


def _measure(
    console: Console, scenes: Sequence[Scene], options: argparse.Namespace
) -> tuple[dict[str, Any], list[SceneThroughput]]:
    """Measure and print, part by part; the record for the file, and the scenes' results for the picture."""
    effort = QUICK if options.quick else Effort()
    peaks = measure_peak(effort.repeats)
    print_peaks(console, peaks)
    results = []
    for scene in scenes:
        results.append(measure_scene(scene, effort))
        print_scene(console, results[-1], peaks)

    compared = {scene.name: scene for scene in scenes}
    if options.all_scenes:
        compared |= {name: load_scene(name) for name in list_scenes()}
    costs = measure_costs(compared, effort, environments=True)
    print_scene_costs(console, costs, peaks)

    feature_costs = []
    if options.features:
        feature_costs = measure_costs(feature_variants(scenes[0]), effort, environments=False)
        print_feature_costs(console, feature_costs)

    start_up = measure_start_up(scenes[0], effort.repeats)
    print_start_up(console, scenes[0].name, start_up)
    record = {
        "effort": asdict(effort),
        "peaks": {name: asdict(peak) for name, peak in peaks.items()},
        "scenes": [scene_record(result, peaks) for result in results],
        "scene_costs": cost_records(costs, peaks),
        "feature_costs": cost_records(feature_costs, peaks),
        "start_up": {"scene": scenes[0].name, "unit": "s", "durations": start_up},
        **provenance("pin", "mujoco"),
    }
    return record, results


def _picture(results: Sequence[SceneThroughput]) -> bytes:
    from experts.report.figures.throughput import picture

    return picture(results)


if __name__ == "__main__":
    sys.exit(main())
