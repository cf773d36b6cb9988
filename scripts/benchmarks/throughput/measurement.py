"""Times of kernels and environments of a scene, alone and beside a busy process, and those of its peers."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from dq_space_arm_env import Scene, load_scene
from experts.report.part_costs import moving_states
from scripts.benchmarks.effort import Effort, Sampling
from scripts.benchmarks.harness import Row, note, one_by_one, select
from scripts.benchmarks.peers import peers_of
from scripts.benchmarks.peers.mujoco_peer import WRAPPED, MujocoPeer
from scripts.benchmarks.peers.pinocchio_peer import PinocchioPeer
from scripts.benchmarks.subjects import (
    COMPARED_INTEGRATORS,
    DYNAMICS,
    ENVIRONMENT,
    FLOAT64,
    GOALS,
    GRADIENT,
    JACOBIANS,
    MAKE,
    MAKE_VEC,
    OURS,
    PLAIN,
    SCALAR,
    STEP,
    SYNCHRONOUS,
    SYNCHRONOUS_COPIES,
    VECTOR,
    Subject,
    environment_cases,
    episodes_case,
    fastest,
    function_cases,
    goal_cases,
    kernel_cases,
    time_cases,
)
from scripts.benchmarks.throughput.agreement import agreements
from scripts.benchmarks.throughput.peak import measure_peak

TRAINING_COPIES = 1024  # copies of an environment in training; the batch at which engines are compared
_SHARED_SAMPLE_SECONDS = 0.1  # shorter samples may fall between two turns of the scheduler

# Ends with the process that started it, however that one ends.
_BUSY = """
import os
parent = os.getppid()
print(flush=True)
while os.getppid() == parent:
    for _ in range(100_000):
        pass
"""


def measure(effort: Effort) -> Iterator[Row]:
    """Measure the peak of a core, and then scene by scene."""
    peaks = list(measure_peak(effort.kernel_timing.repeats))
    yield from peaks
    rates = {row["precision"]: row["operations_per_ns"] for row in peaks}
    for name in effort.scenes or ("paper",):
        yield from one_by_one(f"scene {name}", measure_scene(load_scene(name), effort, rates))


def measure_scene(scene: Scene, effort: Effort, peaks: Mapping[str, float]) -> Iterator[Row]:
    """Time kernels, environments and the installed peers on one scene, and compare their results."""
    kernels = PLAIN.compile(scene)
    peers, notes = peers_of(kernels)
    yield from map(note, notes)
    sizes = effort.batch_sizes
    cases = [
        *kernel_cases(scene, sizes),
        *function_cases(scene, sizes),
        *environment_cases(scene, sizes),
        *goal_cases(scene, (SYNCHRONOUS_COPIES, TRAINING_COPIES)),
        episodes_case(scene),
    ]
    for peer in peers:
        cases += peer.cases(*moving_states(kernels, TRAINING_COPIES))
    timings = [_row(scene, timing, peaks) for timing in time_cases(cases, effort.kernel_timing)]
    yield from timings
    shared = [case for case in cases if _is_shared(case.subject, scene, effort.batch_sizes)]
    with busy_process():
        busy = time_cases(shared, Sampling(effort.kernel_timing.repeats, _SHARED_SAMPLE_SECONDS))
    yield from threads(timings, [_row(scene, timing, peaks) for timing in busy])
    yield from ratios(scene, timings)
    yield from agreements(scene, peers)


def _row(scene: Scene, timing: Row, peaks: Mapping[str, float]) -> Row:
    """A timing with its use of the core, and the label of its curve."""
    rate = None if timing["operations"] is None else timing["operations"] / timing["best_ns"]
    share = None if rate is None else rate / peaks[timing["precision"]] / timing["threads"]
    way = timing["way"].removeprefix("gymnasium.").removeprefix("vector ").partition(",")[0]
    label = f"{timing['engine']}, {way}"
    if timing["engine"] == OURS:
        label = f"{way}, {timing['precision']} x {timing['threads']}"
    panel = f"{timing['integrator']} {timing['what']}".strip()
    labels = {"table": "timings", "scene": scene.name, "panel": panel, "label": label}
    return {**labels, **timing, "operations_per_ns": rate, "share_of_peak": share}


def _is_shared(subject: Subject, scene: Scene, batch_sizes: Sequence[int]) -> bool:
    """Whether a case is timed beside a busy process too: large batches in float64."""
    return (
        subject.what == ENVIRONMENT
        and subject.way in (VECTOR, MAKE_VEC)
        and subject.precision == FLOAT64
        and subject.integrator == scene.simulation.integrator
        and subject.batch in (TRAINING_COPIES, max(batch_sizes))
    )


@contextmanager
def busy_process() -> Iterator[subprocess.Popen[bytes]]:
    """Let another process, of ordinary priority and bound to no core, compute all the time."""
    with subprocess.Popen([sys.executable, "-c", _BUSY], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()  # it has begun
        try:
            yield process
        finally:
            process.kill()


def threads(alone: Sequence[Row], beside: Sequence[Row]) -> Iterator[Row]:
    """Median ns on one thread and on two, on an idle machine and beside a busy process."""
    for busy in select(beside, threads=1):
        same = {key: busy[key] for key in ("scene", "panel", "engine", "way", "batch", "precision")}
        row: Row = {"table": "threads", **same}
        for name, timings in (("alone", alone), ("beside", beside)):
            one, two = (select(timings, threads=count, **same)[0]["median_ns"] for count in (1, 2))
            row |= {f"{name}_one_ns": one, f"{name}_two_ns": two, f"{name}_speed": one / two}
        yield row


def ratios(scene: Scene, timings: Sequence[Row]) -> Iterator[Row]:
    """Our time and the fastest peer's for the same work, both in float64 and on one thread."""
    for what, ours, theirs in _pairs(timings):
        if ours is not None and theirs is not None:
            yield {
                "table": "ratios",
                "scene": scene.name,
                "what": f"{theirs['integrator']} {what}".strip(),
                "ours": _way(ours),
                "ours_ns": ours["best_ns"],
                "theirs": f"{theirs['engine']}: {_way(theirs)}",
                "theirs_ns": theirs["best_ns"],
                "speed": theirs["best_ns"] / ours["best_ns"],
            }


def _way(timing: Row) -> str:
    size = f", {timing['batch']:,}" if timing["batch"] > 1 else ""
    return f"{timing['way']}{size}"


def _pairs(timings: Sequence[Row]) -> Iterator[tuple[str, Row | None, Row | None]]:
    ours = select(timings, engine=OURS, precision=FLOAT64, threads=1)
    for peer in (PinocchioPeer.name, MujocoPeer.name):
        theirs = select(timings, engine=peer, what=DYNAMICS)
        single = fastest(ours, what=DYNAMICS, way=SCALAR, batch=1)
        yield "dynamics, one state", single, fastest(theirs, batch=1)
        batches = [timing for timing in theirs if timing["batch"] > 1]
        yield "dynamics, batch", fastest(ours, what=DYNAMICS, way=VECTOR), fastest(batches)
    yield "gradient, and Jacobians", fastest(ours, what=GRADIENT), fastest(ours, what=JACOBIANS)
    goals = select(ours, what=GOALS)
    for batch in (SYNCHRONOUS_COPIES, TRAINING_COPIES):
        many = fastest(goals, way=MAKE_VEC, batch=batch)
        yield f"{batch:,} goal environments", many, fastest(goals, way=SYNCHRONOUS)
    for name in COMPARED_INTEGRATORS:
        theirs = select(timings, engine=MujocoPeer.name, integrator=name)
        own = select(ours, integrator=name)
        in_c = fastest(theirs, what=STEP)
        yield "step, batch", fastest(own, what=STEP, way=VECTOR, batch=TRAINING_COPIES), in_c
        vector = select(own, what=ENVIRONMENT, way=MAKE_VEC)
        yield f"{TRAINING_COPIES:,} environments", fastest(vector, batch=TRAINING_COPIES), in_c
        few = fastest(vector, batch=SYNCHRONOUS_COPIES)
        yield f"{SYNCHRONOUS_COPIES} environments", few, fastest(theirs, way=SYNCHRONOUS)
        yield "one environment", fastest(own, way=MAKE), fastest(theirs, way=WRAPPED)
