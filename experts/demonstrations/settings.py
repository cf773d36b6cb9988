"""Settings of a data set, all that it follows from: scene, number of problems, seed, and the code."""

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np

import dq_space_arm_env
import experts
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmVectorEnv
from experts.problems.arm_problem import in_double_precision

FORMAT = 1
"""Version of the file format; raise it when the files change."""
SHARD_SIZE = 32
"""Default problems per shard: seconds of work, some ten megabytes."""
PRESENTATION = ("command_line", "figures", "report", "viewing")
"""Packages that do not affect demonstrations."""
PACKAGES = ("casadi", "llvmlite", "numba", "numpy", "safetensors")
"""Packages whose version may change the bytes of a demonstration."""


@dataclass(frozen=True)
class Settings:
    """What to generate; equal settings give equal files on equal processors."""

    scene: Scene  # in double precision
    n: int  # problems
    seed: int
    shard_size: int  # problems per shard; the last one may have fewer

    @classmethod
    def of(cls, scene: Scene | str | Path, n: int, seed: int, shard_size: int) -> Self:
        """Validate the request of a user."""
        for name, value, least in (("n", n, 1), ("seed", seed, 0), ("shard_size", shard_size, 1)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise ValueError(f"{name}: {value!r}, should be a whole number of at least {least}")
            if value < least:
                raise ValueError(f"{name}: {value}, should be at least {least}")
            if value >= 2**63:  # `settings.json` could not be read again
                raise ValueError(f"{name}: {value}, should be less than 2**63")
        n, seed, shard_size = int(n), int(seed), int(shard_size)  # `settings.json` has no NumPy
        resolved = in_double_precision(load_scene(scene))
        DQSpaceArmVectorEnv(1, resolved)  # refuses a scene without normalized actions
        if n > 1 and not any(resolved.spread.model_dump().values()):
            raise ValueError(
                f"scene {resolved.name!r} has no spread, so all {n} problems would be the same: give it a "
                "spread, or set n = 1"
            )
        return cls(resolved, n, seed, shard_size)

    @property
    def n_shards(self) -> int:
        return -(-self.n // self.shard_size)

    def problems(self, shard: int) -> range:
        """Return the numbers of a shard's problems."""
        return range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.n))

    def problem_seed(self, problem: int) -> int:
        """Return the 63-bit seed with which `env.reset(seed=...)` starts where a problem does."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(problem,))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))

    def record(self) -> dict[str, Any]:
        """Return the settings and the code that turns them into demonstrations, as JSON values."""
        return {
            "format": FORMAT,
            "scene": self.scene.model_dump(mode="json", exclude_none=True),
            "problems": self.n,
            "seed": self.seed,
            "shard_size": self.shard_size,
            **software(),
        }

    def to_json(self) -> str:
        return json.dumps(self.record(), indent=2) + "\n"


def software() -> dict[str, Any]:
    """Identify the code that turns settings into demonstrations: a hash, and versions of packages."""
    return {
        "source": source_hash(),
        "versions": {
            "dq-space-arm": dq_space_arm_env.__version__,
            **{package: version(package) for package in PACKAGES},
        },
    }


@cache
def source_hash(without: tuple[str, ...] = PRESENTATION) -> str:
    """Hash the code of environment and experts without some packages: what demonstrations come from."""
    digest = hashlib.sha256()
    for package in (dq_space_arm_env, experts):
        folder = Path(str(package.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            if path.relative_to(folder).parts[0] not in without:
                digest.update(path.read_bytes())
    return digest.hexdigest()
