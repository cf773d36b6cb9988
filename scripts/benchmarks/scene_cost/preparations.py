"""Times until the expert's solver of a scene is ready for the first time, and from the cache."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence

from scripts.benchmarks.harness import Row
from scripts.benchmarks.scene_cost.processes import new_process

_PROGRAM = """
import json, os, time
request = json.loads(input())

def cpu():  # of this process and those that it has waited for
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system

if request["alone"]:
    from dq_space_arm_env.common.worker_process import become_worker
    become_worker()  # one of several, which starts no others
from experts import BoxDDP
from experts.problems.arm_problem import ArmProblem

found = {}
class Timed(ArmProblem):
    def kernel(self, name, *, batched=False):
        before = cpu()
        kernel = super().kernel(name, batched=batched)
        found["kernels_cpu_s"] = found.get("kernels_cpu_s", 0.0) + cpu() - before
        return kernel

wall, before = time.perf_counter(), cpu()
BoxDDP(Timed(request["scene"]), max_iterations=1).solve()
found["wall_s"], found["cpu_s"] = time.perf_counter() - wall, cpu() - before
print(json.dumps(found))
"""


def preparation_rows(names: Sequence[str]) -> Iterator[Row]:
    """One iteration of a solve of each scene in a new process, with an empty and with a full cache.

    By one process alone, which also tells how its CPU time divides, and with the help of another.
    """
    for name in names:
        row: dict[str, Row] = {"empty": {}, "warm": {}}
        for alone in (True, False):
            with tempfile.TemporaryDirectory() as folder:
                for cache in row:
                    request = json.dumps({"scene": name, "alone": alone})
                    found = json.loads(new_process(_PROGRAM, folder, request))
                    if alone:
                        kernels = found["kernels_cpu_s"]
                        row[cache] |= {"kernels_cpu_s": kernels, "rest_cpu_s": found["cpu_s"] - kernels}
                        row[cache] |= {"alone_wall_s": found["wall_s"]}
                    else:
                        row[cache] |= {"cpu_s": found["cpu_s"], "wall_s": found["wall_s"]}
        for cache, times in row.items():
            yield {"table": "preparations", "title": name, "cache": cache, **times}
