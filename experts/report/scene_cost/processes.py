"""What a new process loads and compiles, stage by stage: nothing that nobody asked for."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import packages_distributions
from typing import Any

from experts.report.start_up import new_process

OPTIONAL = ("matplotlib", "numba", "pygame", "rich", "scipy", "stable_baselines3", "torch")
"""What neither the package nor an environment needs, by name of the module."""

IMPORT, MAKE = "import dq_space_arm_env", "gymnasium.make, reset, step"
STEP, WRENCHES = "first kernels.step", "first kernels.reaction_wrenches"

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
)

_PROGRAM = """
import json, os, sys, time
from pathlib import Path
cache, stages, found, names = Path(os.environ["DQ_SPACE_ARM_CACHE"]), json.loads(input()), [], {}
for stage in stages:
    modules, kernels = set(sys.modules), set(cache.glob("*.kernel"))
    start = time.perf_counter()
    exec(stage, names)
    seconds = time.perf_counter() - start
    found.append({
        "seconds": seconds,
        "modules": sorted(set(sys.modules) - modules),
        "kernels": sorted(path.name.rpartition("-")[0] for path in set(cache.glob("*.kernel")) - kernels),
    })
print(json.dumps(found))
"""


@dataclass(frozen=True)
class ProcessStage:
    """What a stage of a new process takes, besides what the stages before it have loaded and compiled.

    Attributes:
        title: The stage.
        cached: Whether its kernels were in the cache; False: the cache was empty when the process began.
        seconds: Durations in several processes, s.
        modules: How many modules it loads.
        packages: Third-party distributions whose first modules it loads, in lower case, without this one.
        optional: Those of `OPTIONAL` that it loads; there should be none.
        kernels: Names of the programs that it compiles.
    """

    title: str
    cached: bool
    seconds: tuple[float, ...]
    modules: int
    packages: tuple[str, ...]
    optional: tuple[str, ...]
    kernels: tuple[str, ...]


def measure_processes(repeats: int) -> list[ProcessStage]:
    """Run new processes that use scene `paper`, with an empty cache and with the kernels in it.

    Args:
        repeats: Processes with the kernels in the cache; a third as many, at least one, with an empty cache.

    Returns:
        The stages with an empty cache, then those with the kernels in it.
    """
    stages = json.dumps([code for _, code in _STAGES])
    compiled, cached = [], []
    for _ in range(max(1, repeats // 3)):
        with tempfile.TemporaryDirectory() as folder:
            compiled.append(json.loads(new_process(_PROGRAM, folder, stages)))
            if len(compiled) == 1:  # its kernels are as good as any
                cached = [json.loads(new_process(_PROGRAM, folder, stages)) for _ in range(repeats)]
    homes = packages_distributions()
    return [*_stages(compiled, homes, cached=False), *_stages(cached, homes, cached=True)]


def _stages(
    processes: Sequence[Sequence[Mapping[str, Any]]], homes: Mapping[str, list[str]], *, cached: bool
) -> Iterable[ProcessStage]:
    """Stages of processes of one kind; they load and compile the same."""
    known: set[str] = set()
    for index, (title, _) in enumerate(_STAGES):
        found = processes[0][index]
        tops = {name.partition(".")[0] for name in found["modules"]}
        packages = {home.lower() for top in tops for home in homes.get(top, ())} - {"dq-space-arm"}
        yield ProcessStage(
            title=title,
            cached=cached,
            seconds=tuple(process[index]["seconds"] for process in processes),
            modules=len(found["modules"]),
            packages=tuple(sorted(packages - known)),
            optional=tuple(name for name in OPTIONAL if name in tops),
            kernels=tuple(found["kernels"]),
        )
        known |= packages
