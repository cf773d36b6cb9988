"""Imports, compiled programs and times of a new process, stage by stage."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from statistics import median

import dq_space_arm_env
from scripts.benchmarks.harness import Row, claim

OPTIONAL = ("matplotlib", "numba", "pygame", "rich", "scipy", "stable_baselines3", "torch")
"""Modules that neither the package nor an environment may load."""

IMPORT, MAKE = "import dq_space_arm_env", "gymnasium.make, reset, step"
STEP, WRENCHES = "first kernels.step", "first kernels.reaction_wrenches"
LINEARIZE = "first kernels.linearize"

# Each stage: what it is called, and its code.
_STAGES = (
    (IMPORT, "import dq_space_arm_env"),
    (
        MAKE,
        """
import gymnasium
env = gymnasium.make("DQSpaceArm-v0", scene="paper")
env.reset(seed=0)
env.step(env.action_space.sample())
""",
    ),
    (
        STEP,
        """
kernels = dq_space_arm_env.compile_scene(dq_space_arm_env.load_scene("paper"))
x, u = kernels.layout.initial_state, [0.0] * kernels.n_u
kernels.step(x, u)
""",
    ),
    (WRENCHES, "kernels.reaction_wrenches(x, u)"),
    (LINEARIZE, "kernels.linearize(x, u)"),
)

_PROGRAM = """
import json, os, sys, time
from pathlib import Path
cache, stages, found, names = Path(os.environ["DQ_SPACE_ARM_CACHE"]), json.loads(input()), [], {}
for stage in stages:
    modules, kernels = set(sys.modules), set(cache.glob("scene.*"))
    start = time.perf_counter()
    exec(stage, names)
    seconds = time.perf_counter() - start
    added = set(cache.glob("scene.*")) - kernels
    found.append({
        "seconds": seconds,
        "modules": sorted(set(sys.modules) - modules),
        "kernels": sorted(path.name[6:].rpartition("-")[0] for path in added),
    })
print(json.dumps(found))
"""


def process_rows(repeats: int, *, derivatives: bool) -> Iterator[Row]:
    """Stages of new processes that use scene `paper`, with an empty cache and with the kernels in it.

    An empty cache is tried a third as often, at least once. A stage lists what it loads and compiles besides
    the stages before it; no stage may load a module of `OPTIONAL`.
    """
    stages = _STAGES if derivatives else _STAGES[:-1]
    codes = json.dumps([code for _, code in stages])
    compiled, cached = [], []
    for _ in range(max(1, repeats // 3)):
        with tempfile.TemporaryDirectory() as folder:
            compiled.append(json.loads(new_process(_PROGRAM, folder, codes)))
            if len(compiled) == 1:  # its kernels are as good as any
                cached = [json.loads(new_process(_PROGRAM, folder, codes)) for _ in range(repeats)]
    homes = packages_distributions()
    for cache, processes in (("empty", compiled), ("warm", cached)):
        known: set[str] = set()
        for index, (title, _) in enumerate(stages):
            found = processes[0][index]
            seconds = [process[index]["seconds"] for process in processes]
            tops = {name.partition(".")[0] for name in found["modules"]}
            packages = {home.lower() for top in tops for home in homes.get(top, ())} - {"dq-space-arm"}
            optional = ", ".join(name for name in OPTIONAL if name in tops)
            yield {
                "table": "processes",
                "stage": title,
                "cache": cache,
                "best_s": min(seconds),
                "median_s": median(seconds),
                "modules": len(found["modules"]),
                "imports": ", ".join(sorted(packages - known)),
                "compiles": ", ".join(found["kernels"]),
            }
            count = len(optional.split(", ")) if optional else 0
            yield claim(
                "processes", title, f"{cache} cache", count, 0, unit="optional modules", note=optional
            )
            known |= packages


def new_process(program: str, cache: str, text: str = "") -> str:
    """Run a program in a new process with a cache of its own."""
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
