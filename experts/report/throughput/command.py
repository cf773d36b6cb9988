"""The benchmark of kernels and environments as a command: what it prints and writes."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console

from dq_space_arm_env import Scene, list_scenes, load_scene
from experts.report.command import SUCCESS, Destination
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


def run(
    destination: Destination,
    *,
    scenes: Sequence[str] = (),
    all_scenes: bool = False,
    features: bool = False,
    quick: bool = False,
) -> int:
    """Measure; `throughput.json` and `throughput.png` hold the numbers.

    Args:
        destination: Where results go.
        scenes: Names or paths of scenes; paper if there are none.
        all_scenes: Whether to measure also what each shipped scene costs.
        features: Whether to measure also what each part of the first scene costs.
        quick: Whether to measure little.

    Returns:
        Exit status.

    Raises:
        SceneError: If a scene cannot be loaded.
    """
    console = destination.console()
    loaded = [load_scene(name) for name in scenes or ["paper"]]
    destination.folder.mkdir(parents=True, exist_ok=True)
    record, results = _measure(console, loaded, all_scenes=all_scenes, features=features, quick=quick)
    destination.save(console, "throughput", record, lambda: _picture(results))
    return SUCCESS


def _measure(
    console: Console, scenes: Sequence[Scene], *, all_scenes: bool, features: bool, quick: bool
) -> tuple[dict[str, Any], list[SceneThroughput]]:
    """Measure and print, part by part; the record for the file, and the scenes' results for the picture."""
    effort = QUICK if quick else Effort()
    peaks = measure_peak(effort.repeats)
    print_peaks(console, peaks)
    results = []
    for scene in scenes:
        results.append(measure_scene(scene, effort))
        print_scene(console, results[-1], peaks)

    compared = {scene.name: scene for scene in scenes}
    if all_scenes:
        compared |= {name: load_scene(name) for name in list_scenes()}
    costs = measure_costs(compared, effort, environments=True)
    print_scene_costs(console, costs, peaks)

    feature_costs = []
    if features:
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
