"""The ways to run one scene: in float64 or float32, on one thread or two.

This module alone says how a precision and a number of threads are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium

from dq_space_arm_env import Kernels, Scene, compile_scene
from experts.report.throughput.timing import FLOAT32, FLOAT64


@dataclass(frozen=True)
class Variant:
    """A way to run a scene.

    Attributes:
        precision: Name of the floating-point type.
        threads: Number of threads.
    """

    precision: str = FLOAT64
    threads: int = 1

    def scene(self, scene: Scene, integrator: str | None = None) -> Scene:
        """The scene in this precision, with another integrator if one is named."""
        changes = {"precision": self.precision, "integrator": integrator or scene.simulation.integrator}
        return scene.replace(simulation={**scene.simulation.model_dump(), **changes})

    def compile(self, scene: Scene) -> Kernels:
        """The scene's kernels."""
        return compile_scene(self.scene(scene), threads=self.threads)

    def make_vec(
        self, scene: Scene, num_envs: int, integrator: str
    ) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """The scene's vector environment."""
        return gymnasium.make_vec(
            "DQSpaceArm-v0", num_envs=num_envs, scene=self.scene(scene, integrator), threads=self.threads
        )


PLAIN = Variant()
VARIANTS = (PLAIN, Variant(FLOAT32), Variant(threads=2), Variant(FLOAT32, 2))
