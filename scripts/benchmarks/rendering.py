"""Pictures of the environment: steps with a picture each, as RecordVideo takes them.

The baseline is Gymnasium's CartPole-v1, whose flat pictures pygame draws, if it is installed. Times are
processor time of this process, to which other processes add nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np

import dq_space_arm_env  # noqa: F401 - registers the environment
from dq_space_arm_env.common.tables import Column
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Row, Table, note, time_column

BASELINE = "CartPole-v1"
SIZE: dict[str, Any] = {"width": 640, "height": 480}  # pixels; CartPole's are 600 x 400
_STEPS_PER_SAMPLE = 5


def measure(effort: Effort) -> Iterator[Row]:
    """Time each scene, and the baseline first."""
    environments: dict[str, gymnasium.Env[Any, Any]] = {}
    if find_spec("pygame") is not None:
        environments[BASELINE] = gymnasium.make(BASELINE, render_mode="rgb_array")
    else:
        yield note(f"{BASELINE} is left out: pygame is not installed (pip install pygame-ce).")
    for name in effort.scenes or ("paper",):
        environments[name] = gymnasium.make("DQSpaceArm-v0", scene=name, render_mode="rgb_array", **SIZE)
    baseline = None
    for name, env in environments.items():
        row = measure_pictures(name, env, effort.pictures)
        baseline = row["best_ms"] if name == BASELINE else baseline
        yield {**row, "of_baseline": None if baseline is None else baseline / row["best_ms"]}


def measure_pictures(name: str, env: gymnasium.Env[Any, Any], samples: int) -> Row:
    """Time steps with random actions, each with its picture; an episode that ends is followed by another."""
    env.reset(seed=0)
    env.action_space.seed(0)
    picture: Any = env.render()
    durations = []
    for _ in range(max(samples, 1)):
        begin = time.process_time()
        for _ in range(_STEPS_PER_SAMPLE):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
            env.render()
        durations.append(1e3 * (time.process_time() - begin) / _STEPS_PER_SAMPLE)
    env.close()
    best = min(durations)
    size = {"width": picture.shape[1], "height": picture.shape[0]}
    times = {"best_ms": best, "median_ms": float(np.median(durations)), "pictures_per_s": 1e3 / best}
    return {"table": "pictures", "name": name, **size, **times}


BENCHMARK = Benchmark(
    "rendering",
    "Pictures",
    "A step and its picture: processor time, best and median of the samples.",
    measure,
    tables=(
        Table(
            "pictures",
            "A step and its picture",
            (
                "name",
                "width",
                "height",
                time_column("best_ms", "ms, best"),
                time_column("median_ms", "median"),
                Column("pictures_per_s", "pictures/s", ".0f"),
                Column("of_baseline", f"of {BASELINE}'s rate", ".2f"),
            ),
        ),
    ),
    packages=("pygame-ce",),
)
