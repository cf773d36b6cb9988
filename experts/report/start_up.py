"""The time that a new process needs before it simulates: imports, and kernels cached or compiled."""

import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import dq_space_arm_env
from dq_space_arm_env import Scene

_START_UP = """
import time
start = time.perf_counter()
import dq_space_arm_env
imported = time.perf_counter()
import gymnasium
env = gymnasium.make("DQSpaceArm-v0", scene=dq_space_arm_env.Scene.model_validate_json(input()))
env.reset(seed=0)
env.step(env.action_space.sample())
print(imported - start, time.perf_counter() - imported)
"""


def measure_start_up(scene: Scene, repeats: int) -> dict[str, list[float]]:
    """Time new processes: import, then making an environment, its reset and its first step.

    Args:
        scene: The scene.
        repeats: Processes that find the kernel in the cache, after the one that compiles it.

    Returns:
        Durations in s: "import", "make, warm cache" and, one number, "make, empty cache".
    """
    root = str(Path(dq_space_arm_env.__file__).parent.parent)
    with tempfile.TemporaryDirectory() as folder:
        paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "DQ_SPACE_ARM_CACHE": folder, "PYTHONPATH": paths}
        start = partial(
            subprocess.run,
            [sys.executable, "-c", _START_UP],
            input=scene.model_dump_json() + "\n",
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        runs = [[float(part) for part in start().stdout.split()] for _ in range(1 + repeats)]
    warm = runs[1:]
    return {
        "import": [imported for imported, _ in warm],
        "make, warm cache": [made for _, made in warm],
        "make, empty cache": [runs[0][1]],
    }
