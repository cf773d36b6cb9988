"""What the measurement is for: our time and the fastest peer's for the same work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.throughput.environments import MAKE, MAKE_VEC
from experts.report.throughput.kernels import SCALAR, VECTOR
from experts.report.throughput.measurement import TRAINING_COPIES, SceneThroughput
from experts.report.throughput.mujoco_peer import SYNCHRONOUS, SYNCHRONOUS_COPIES, WRAPPED, MujocoPeer
from experts.report.throughput.pinocchio_peer import PinocchioPeer
from experts.report.throughput.timing import (
    DYNAMICS,
    ENVIRONMENT,
    FLOAT64,
    OURS,
    STEP,
    Timing,
    fastest,
    select,
)


@dataclass(frozen=True)
class Ratio:
    """A peer's time and ours for the same thing, both in float64 and on one thread.

    Attributes:
        what: The thing.
        ours: Our time.
        theirs: The peer's.
    """

    what: str
    ours: Timing
    theirs: Timing

    @property
    def speed(self) -> float:
        """Our states per second over the peer's."""
        return self.theirs.best_ns / self.ours.best_ns


def ratios(result: SceneThroughput) -> list[Ratio]:
    """Compare our times with the peers'.

    Args:
        result: What is measured of a scene.

    Returns:
        The comparisons for which both times are there.
    """
    return [
        Ratio(what, ours, theirs)
        for what, ours, theirs in _pairs(result.timings)
        if ours is not None and theirs is not None
    ]


def _pairs(timings: list[Timing]) -> Iterator[tuple[str, Timing | None, Timing | None]]:
    ours = select(timings, engine=OURS, precision=FLOAT64, threads=1)
    for peer in (PinocchioPeer.name, MujocoPeer.name):
        theirs = select(timings, engine=peer, what=DYNAMICS)
        single = fastest(ours, what=DYNAMICS, way=SCALAR, batch=1)
        yield "dynamics, one state", single, fastest(theirs, batch=1)
        batches = [timing for timing in theirs if timing.batch > 1]
        yield "dynamics, batch", fastest(ours, what=DYNAMICS, way=VECTOR), fastest(batches)
    for name in COMPARED_INTEGRATORS:
        theirs = select(timings, engine=MujocoPeer.name, integrator=name)
        own = select(ours, integrator=name)
        in_c = fastest(theirs, what=STEP)
        yield "step, batch", fastest(own, what=STEP, way=VECTOR, batch=TRAINING_COPIES), in_c
        vector = select(own, what=ENVIRONMENT, way=MAKE_VEC)
        yield f"{TRAINING_COPIES:,} environments", fastest(vector, batch=TRAINING_COPIES), in_c
        yield (
            f"{SYNCHRONOUS_COPIES} environments",
            fastest(vector, batch=SYNCHRONOUS_COPIES),
            fastest(theirs, way=SYNCHRONOUS),
        )
        yield "one environment", fastest(own, way=MAKE), fastest(theirs, way=WRAPPED)
