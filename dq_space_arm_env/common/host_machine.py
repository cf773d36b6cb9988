"""The processor that this process runs on, for which code is compiled."""

import os
from dataclasses import dataclass
from functools import cache

import llvmlite.binding as llvm


@dataclass(frozen=True)
class Machine:
    """A processor, as LLVM describes it."""

    cpu: str
    features: str  # instruction sets
    lanes: int  # doubles in the widest vector register
    fused: bool  # whether it has fused multiply-add


@cache
def host_machine() -> Machine:
    """Describe the processor that this process runs on."""
    features = llvm.get_host_cpu_features()
    triple = llvm.get_process_triple()
    if triple.startswith(("x86_64", "amd64", "i686")):
        lanes = 8 if features.get("avx512f") else 4 if features.get("avx") else 2
        fused = bool(features.get("fma"))
    else:  # 64-bit Arm and the like: 128-bit vectors, fused multiply-add is part of the base instruction set
        lanes, fused = 2, True
    return Machine(llvm.get_host_cpu_name(), features.flatten(), lanes, fused)


def processors() -> int:
    """Count the processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(affinity(0)) if affinity else os.cpu_count() or 1
