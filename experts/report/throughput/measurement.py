"""Everything that is measured of a scene: times, times beside a busy process, and errors."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from dq_space_arm_env import Scene
from experts.report.throughput.agreement import Agreement, agreements
from experts.report.throughput.environments import MAKE_VEC, environment_cases
from experts.report.throughput.kernels import VECTOR, kernel_cases, sample_states
from experts.report.throughput.peers import peers_of
from experts.report.throughput.timing import ENVIRONMENT, FLOAT64, Case, Effort, Subject, Timing, time_cases
from experts.report.throughput.variants import PLAIN

TRAINING_COPIES = 1024
"""Copies of an environment in training; the batch at which engines are compared."""
# Shorter samples may fall between two turns of the scheduler.
_SHARED_SAMPLE_SECONDS = 0.1

# Ends with the process that started it, however that one ends.
_BUSY = """
import os
parent = os.getppid()
print(flush=True)
while os.getppid() == parent:
    for _ in range(100_000):
        pass
"""


@dataclass(frozen=True)
class SceneThroughput:
    """What is measured of a scene.

    Attributes:
        scene: Its name.
        integrator: Name of its integrator.
        dt: Its time step, s.
        timings: All times.
        busy_timings: Those of large batches in float64, on one thread and on two, while another process
            keeps a core busy.
        agreements: All errors.
        notes: What is left out.
    """

    scene: str
    integrator: str
    dt: float
    timings: list[Timing]
    busy_timings: list[Timing]
    agreements: list[Agreement]
    notes: list[str]


def measure_scene(scene: Scene, effort: Effort) -> SceneThroughput:
    """Time kernels, environments and the installed peers on one scene.

    Args:
        scene: The scene.
        effort: How much to measure.

    Returns:
        Times and errors.
    """
    kernels = PLAIN.compile(scene)
    peers, notes = peers_of(kernels)
    cases = [*kernel_cases(scene, effort.batch_sizes), *environment_cases(scene, effort.batch_sizes)]
    for peer in peers:
        cases += peer.cases(*sample_states(kernels, TRAINING_COPIES))
    timings = time_cases(cases, effort)
    shared = [case for case in cases if _is_shared(case.subject, scene, effort.batch_sizes)]
    return SceneThroughput(
        scene=scene.name,
        integrator=scene.simulation.integrator,
        dt=scene.simulation.dt,
        timings=timings,
        busy_timings=_time_beside_busy_process(shared, effort),
        agreements=agreements(scene, peers),
        notes=notes,
    )


def _is_shared(subject: Subject, scene: Scene, batch_sizes: Sequence[int]) -> bool:
    """Whether a case is timed beside a busy process too: large batches in float64."""
    return (
        subject.what == ENVIRONMENT
        and subject.way in (VECTOR, MAKE_VEC)
        and subject.precision == FLOAT64
        and subject.integrator == scene.simulation.integrator
        and subject.batch in (TRAINING_COPIES, max(batch_sizes))
    )


def _time_beside_busy_process(cases: Sequence[Case], effort: Effort) -> list[Timing]:
    with busy_process():
        return time_cases(cases, replace(effort, sample_seconds=_SHARED_SAMPLE_SECONDS))


@contextmanager
def busy_process() -> Iterator[subprocess.Popen[bytes]]:
    """Let another process, of ordinary priority and bound to no core, compute all the time.

    Yields:
        The process; it ends with the context.
    """
    with subprocess.Popen([sys.executable, "-c", _BUSY], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()  # it has begun
        try:
            yield process
        finally:
            process.kill()
