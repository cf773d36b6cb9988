"""All that a folder of demonstrations follows from: scene, number of problems, seed, and the code."""

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
from experts.arm_problem import in_double_precision

FORMAT = 1
"""Version of the files; to be raised when they change."""
SHARD_SIZE = 32
"""Problems of a shard by default: some seconds of work, and some ten megabytes."""
PACKAGES = ("casadi", "llvmlite", "numba", "numpy", "safetensors")
"""Packages whose version may change the bytes of a demonstration."""


@dataclass(frozen=True)
class Settings:
    """What to generate; equal settings give equal files on equal processors.

    Attributes:
        scene: The scene, in double precision.
        n: Number of problems.
        seed: Seed of the data set.
        shard_size: Problems of a shard; the last one may have fewer.
    """

    scene: Scene
    n: int
    seed: int
    shard_size: int

    @classmethod
    def of(cls, scene: Scene | str | Path, n: int, seed: int, shard_size: int) -> Self:
        """Check and complete what a user asks for.

        Args:
            scene: A scene, the name of a shipped one, or a path to a YAML file.
            n: Number of problems.
            seed: Seed of the data set.
            shard_size: Problems of a shard.

        Returns:
            The settings.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If a number is out of range; if the scene draws a target or masses, draws nothing at
                all, or is refused by the environment.
        """
        for name, value, least in (("n", n, 1), ("seed", seed, 0), ("shard_size", shard_size, 1)):
            if value < least:
                raise ValueError(f"{name}: {value}, should be at least {least}")
        resolved = in_double_precision(load_scene(scene))
        if DQSpaceArmVectorEnv(1, resolved).parameters.size:
            raise ValueError(
                f"scene {resolved.name!r} draws more than the start for each episode, and the expert's "
                "machine code has target and masses as constants: every problem would be compiled anew, for "
                "some ten seconds. Take a scene whose spread has no target, masses or inertias"
            )
        if n > 1 and not any(resolved.spread.model_dump().values()):
            raise ValueError(
                f"scene {resolved.name!r} has no spread, so all {n} problems would be the same: give it a "
                "spread, or take n = 1"
            )
        return cls(resolved, n, seed, shard_size)

    @property
    def n_shards(self) -> int:
        """Number of shards."""
        return -(-self.n // self.shard_size)

    def problems(self, shard: int) -> range:
        """Numbers of the problems of a shard.

        Args:
            shard: Number of the shard, from 0.

        Returns:
            The numbers, in [0, n).
        """
        return range(shard * self.shard_size, min((shard + 1) * self.shard_size, self.n))

    def problem_seed(self, problem: int) -> int:
        """Seed with which `env.reset(seed=...)` starts where a problem does.

        Args:
            problem: Number of the problem, in [0, n).

        Returns:
            The seed, 63 bits: no two of a million problems share one, and it fits into an int64.
        """
        sequence = np.random.SeedSequence(self.seed, spawn_key=(problem,))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))

    def record(self) -> dict[str, Any]:
        """Write the settings down, with the code that turns them into demonstrations.

        Returns:
            JSON values.
        """
        return {
            "format": FORMAT,
            "scene": self.scene.model_dump(mode="json", exclude_none=True),
            "problems": self.n,
            "seed": self.seed,
            "shard_size": self.shard_size,
            **software(),
        }

    def to_json(self) -> str:
        """The record as text."""
        return json.dumps(self.record(), indent=2) + "\n"


def software() -> dict[str, Any]:
    """Name the code that turns settings into demonstrations.

    Returns:
        JSON values: a hash of the source, and versions of packages.
    """
    return {
        "source": _source_hash(),
        "versions": {
            "dq-space-arm": dq_space_arm_env.__version__,
            **{package: version(package) for package in PACKAGES},
        },
    }


def differences(there: dict[str, Any], here: dict[str, Any], prefix: str = "") -> list[str]:
    """Name what two records of settings differ in.

    Args:
        there: What a folder says.
        here: What is asked for.
        prefix: Name of the part that the two records are.

    Returns:
        One phrase for each entry that differs.
    """
    found = []
    for key in sorted({*there, *here}):
        name, old, new = f"{prefix}{key}", there.get(key), here.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{name}.")
        elif old != new:
            found.append(f"{name} is {_short(old)} there and {_short(new)} here")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."


@cache
def _source_hash() -> str:
    """Hash of the code that demonstrations come from: environment and experts, but not what only shows."""
    digest = hashlib.sha256()
    for package, left_out in ((dq_space_arm_env, ()), (experts, ("replay", "report"))):
        folder = Path(str(package.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            if path.relative_to(folder).parts[0] not in left_out:
                digest.update(path.read_bytes())
    return digest.hexdigest()
