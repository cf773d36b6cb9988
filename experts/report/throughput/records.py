"""The measurements in JSON's types, with the rates that follow from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from experts.report.peak import Peak
from experts.report.throughput.measurement import SceneThroughput
from experts.report.throughput.ratios import ratios
from experts.report.throughput.scene_costs import SceneCost
from experts.report.throughput.timing import Timing


def share_of_peak(timing: Timing, peaks: Mapping[str, Peak]) -> float | None:
    """How much of its threads' cores a kernel uses.

    Args:
        timing: Its time.
        peaks: Peak of a core for each precision.

    Returns:
        Operations per ns over the peak of as many cores as there are threads; None if they are not known.
    """
    rate = timing.operations_per_ns
    return None if rate is None else rate / (timing.threads * peaks[timing.precision].operations_per_ns)


def timing_record(timing: Timing, peaks: Mapping[str, Peak]) -> dict[str, Any]:
    """A time with its rates.

    Args:
        timing: The time.
        peaks: Peak of a core for each precision.

    Returns:
        Its fields, states per second, operations per ns, and share of the peak.
    """
    return {
        **asdict(timing),
        "states_per_second": timing.states_per_second,
        "operations_per_ns": timing.operations_per_ns,
        "share_of_peak": share_of_peak(timing, peaks),
    }


def scene_record(result: SceneThroughput, peaks: Mapping[str, Peak]) -> dict[str, Any]:
    """What is measured of a scene.

    Args:
        result: It.
        peaks: Peak of a core for each precision.

    Returns:
        Its fields, and the ratios.
    """
    return {
        "scene": result.scene,
        "integrator": result.integrator,
        "dt": result.dt,
        "timings": [timing_record(timing, peaks) for timing in result.timings],
        "timings_beside_busy_process": [timing_record(timing, peaks) for timing in result.busy_timings],
        "agreements": [asdict(agreement) for agreement in result.agreements],
        "ratios": [{**asdict(ratio), "speed": ratio.speed} for ratio in ratios(result)],
        "notes": result.notes,
    }


def cost_records(costs: Sequence[SceneCost], peaks: Mapping[str, Peak]) -> list[dict[str, Any]]:
    """What scenes cost.

    Args:
        costs: It.
        peaks: Peak of a core for each precision.

    Returns:
        The fields of each scene.
    """
    return [
        {
            name: timing_record(value, peaks) if isinstance(value, Timing) else value
            for name, value in vars(cost).items()
        }
        for cost in costs
    ]
