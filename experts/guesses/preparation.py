"""What `GuidedDDP` finds before its first solve, kept on disk for the next process.

It follows from the problem, the settings and the source of solver and kernels; their hash names the file,
which is guarded like machine code. The numbers read are those written: no solution depends on whether there
is a file.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env.common.code_cache import cache_key, keep_code, read_code
from dq_space_arm_env.kernels.library import source_hash
from experts.ddp.solution import Solution
from experts.problems.arm_problem import ArmProblem

_NAME = "guided-ddp"
_ROOMS = ("ddp", "guesses", "native", "problems")  # of this package: what it follows from


class Preparation(NamedTuple):
    """How to solve a maneuver from any start."""

    coarsening: tuple[int, ...]  # steps in a long one, the longest first; empty without long steps
    second_order: str  # see `BoxDDP`
    library: tuple[Solution, ...]  # solutions in the longest steps


def preparation_key(problem: ArmProblem, settings: Mapping[str, Any]) -> str:
    """Hash all that a preparation follows from."""
    with problem.parameters.being(None):  # as it is prepared
        numbers = (problem.initial_state, problem.parameters.nominal, problem.control_upper)
    facts = [
        problem.scene.content_hash(),
        problem.integrator,
        problem.horizon,
        problem.time_step,
        problem.is_constrained,
        problem.reserve,
        dict(settings),
        *(np.asarray(array).tolist() for array in numbers),
    ]
    versions = (version("numpy"), version("numba"))
    return cache_key(json.dumps(facts, default=str), source_hash(), _source_hash(), *versions)


def read_preparation(key: str) -> Preparation | None:
    """Read what `keep_preparation` wrote; None if there is nothing, or it is damaged."""
    content = read_code(_NAME, key)
    if content is None:
        return None
    with np.load(BytesIO(content)) as arrays:
        solution = Solution.from_arrays(dict(arrays), _NAME)
    facts = solution.metadata["preparation"]
    return Preparation(tuple(facts["coarsening"]), facts["second_order"], (solution,))


def keep_preparation(key: str, preparation: Preparation) -> None:
    """Write a preparation for other processes, if it holds a solution."""
    if not preparation.library:
        return
    (solution,) = preparation.library
    facts = {"coarsening": preparation.coarsening, "second_order": preparation.second_order}
    kept = replace(solution, metadata={**solution.metadata, "preparation": facts})
    keep_code(_NAME, key, kept.to_bytes())


@cache
def _source_hash() -> str:
    """Hash of the source of the solver and its problems."""
    package, digest = Path(__file__).parent.parent, hashlib.sha256()
    for path in sorted(path for room in _ROOMS for path in (package / room).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
