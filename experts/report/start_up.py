"""The time that a new process needs before it computes: imports, and kernels cached or compiled."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import dq_space_arm_env
from dq_space_arm_env import Scene

IMPORT, MAKE, LINEARIZE = "import", "gymnasium.make, reset, step", "first linearization"
EMPTY, WARM = "empty cache", "warm cache"

# Each prints its duration in s; the scene comes as JSON on the standard input.
_IMPORT = """
import time
start = time.perf_counter()
import dq_space_arm_env
print(time.perf_counter() - start)
"""
_MAKE = """
import time
import dq_space_arm_env
start = time.perf_counter()
import gymnasium
env = gymnasium.make("DQSpaceArm-v0", scene=dq_space_arm_env.Scene.model_validate_json(input()))
env.reset(seed=0)
env.step(env.action_space.sample())
print(time.perf_counter() - start)
"""
_LINEARIZE = """
import time
import dq_space_arm_env
start = time.perf_counter()
kernels = dq_space_arm_env.compile_scene(dq_space_arm_env.Scene.model_validate_json(input()))
kernels.linearize(kernels.layout.initial_state, [0.0] * kernels.n_u)
print(time.perf_counter() - start)
"""


def measure_start_up(scene: Scene, repeats: int) -> dict[str, list[float]]:
    """Time new processes, after Python itself has started.

    Args:
        scene: The scene.
        repeats: Processes of each kind; a third as many, at least one, where kernels are compiled.

    Returns:
        Durations in s: of the import alone; then, after it, of making an environment with its reset and first
        step, and of a first linearization, each with the kernel in the cache and with an empty cache.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = {IMPORT: [_seconds(_IMPORT, scene, folder) for _ in range(repeats)]}
    for name, program in ((MAKE, _MAKE), (LINEARIZE, _LINEARIZE)):
        compiled = []
        for _ in range(max(1, repeats // 3)):
            with tempfile.TemporaryDirectory() as folder:
                compiled.append(_seconds(program, scene, folder))
                if len(compiled) == 1:  # its kernels are as good as any
                    found[f"{name}, {WARM}"] = [_seconds(program, scene, folder) for _ in range(repeats)]
        found[f"{name}, {EMPTY}"] = compiled
    return found


def _seconds(program: str, scene: Scene, cache: str) -> float:
    return float(new_process(program, cache, scene.model_dump_json()))


def new_process(program: str, cache: str, text: str = "") -> str:
    """Run a program in a new process with a cache of its own.

    Args:
        program: Python code; it finds the package that this process has.
        cache: Folder of its compiled kernels.
        text: What it reads from the standard input, a line.

    Returns:
        What it prints.
    """
    root = str(Path(dq_space_arm_env.__file__).parent.parent)
    paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    result = subprocess.run(
        [sys.executable, "-P", "-c", program],
        input=text + "\n",
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env={**os.environ, "DQ_SPACE_ARM_CACHE": cache, "PYTHONPATH": paths},
    )
    return result.stdout
