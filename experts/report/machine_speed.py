"""What this machine does in a second, beside a reference: `dq-space-arm info --speed`."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import numpy as np

from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, compile_scene
from dq_space_arm_env.common.tables import Row
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.report.timing import time_in_turns

SCENE = "paper"
COPIES = 1024
_REPEATS, _SAMPLE_SECONDS = 7, 0.05
_SOLVES = 3
REFERENCE = {
    "environment's step": 2.4e-6,
    f"step of {COPIES} environments, each": 1.8e-7,
    f"integration step of {COPIES} states, each": 1.4e-7,
    f"its derivatives for {COPIES} states, each": 1.4e-6,
    "iteration of the expert": 1.2e-2,
    "the paper's maneuver, solved": 1.7e-1,
}
"""Times of one run on one core of an AMD EPYC (virtual machine, Linux, Python 3.11, 2026), s."""


def machine_speed() -> Iterator[Row]:
    """Measure one core on the scene `paper`, compiled before.

    Yields:
        Rows: what is `measured`, `seconds` here (best sample), `reference_seconds`, their `ratio`,
        and how many a second.
    """
    for (measured, reference), seconds in zip(REFERENCE.items(), _measure(), strict=True):
        ratio = seconds / reference
        facts = {"seconds": seconds, "reference_seconds": reference, "ratio": ratio}
        yield {"measured": measured, **facts, "per_second": 1.0 / seconds}


def _measure() -> list[float]:
    """Seconds of each entry of `REFERENCE`."""
    kernels = compile_scene(SCENE)
    single, vector = DQSpaceArmEnv(SCENE), DQSpaceArmVectorEnv(COPIES, SCENE)
    single.reset(seed=0)
    vector.reset(seed=0)
    action, actions = np.zeros(kernels.n_u, np.float32), np.zeros((COPIES, kernels.n_u), np.float32)
    x, u = vector.states, np.zeros((COPIES, kernels.n_u))

    def fly() -> None:
        if single.step(action)[2]:
            single.reset()

    runs = (
        fly,
        lambda: vector.step(actions),
        lambda: kernels.step(x, u),
        lambda: kernels.linearize(x, u),
    )
    times = [sample.best_ns * 1e-9 for sample in time_in_turns(runs, _REPEATS, _SAMPLE_SECONDS)]
    solver, solves = BoxDDP(SCENE), []
    for _ in range(_SOLVES):
        begun = perf_counter()
        solution = uninterrupted(solver.solve())
        solves.append(perf_counter() - begun)
    best = min(solves)
    each = [times[0], *(time / COPIES for time in times[1:])]
    return [*each, best / solution.iterations, best]
