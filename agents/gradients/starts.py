"""Where episodes begin, with the parameters that they have on the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.configuration.schema import RESERVED_SEED
from dq_space_arm_env import DQSpaceArmVectorEnv, Kernels, Scene, compile_scene
from dq_space_arm_env.environment.disturbances import with_loads
from dq_space_arm_env.scene.parameters import CATCH

Array = NDArray[Any]


class Starts(NamedTuple):
    """States (n, n_x) that episodes begin at, and parameters of each decision and the end.

    Attributes:
        states: Shape (n, n_x).
        parameters: Of the start, shape (n, n_p).
        moving: Values of those that move along an episode, shape (K + 1, n, n_moving), and their indices.
        staged: Likewise of those that phases change, alike in all episodes, shape (K + 1, 1, n_staged).
    """

    states: Array
    parameters: Array
    moving: tuple[Array, list[int]]
    staged: tuple[Array, list[int]]

    @classmethod
    def draw(
        cls, scene: Scene, count: int, times: Array, seeds: Sequence[int], mass_factors: Sequence[float]
    ) -> tuple[Scene, Starts]:
        """Draw starts by seeds, and their parameters at some times; first the scene that has them."""
        environment = DQSpaceArmVectorEnv(count, scene)
        sequence = np.random.SeedSequence([RESERVED_SEED, *seeds])
        environment.reset(seed=int(sequence.generate_state(1)[0] >> 2))
        kernels, given = environment.kernels, environment.parameters
        if set(mass_factors) != {1.0}:
            scene, given = with_loads(scene, np.resize(mass_factors, count), given)
            kernels = compile_scene(scene)
        return scene, cls.of(kernels, environment.states, given, times)

    @classmethod
    def of(cls, kernels: Kernels, states: Array, given: Array, times: Array) -> Starts:
        """States (n, n_x) with parameters (n, n_p), and what these are at some times."""
        entries, rows = kernels.parameters, np.rint(times / kernels.scene.simulation.dt).astype(int)
        own = list(entries.moving) and [*entries.moving, *entries.indices(CATCH)]
        alike = [index for index in entries.staged if index not in own]

        def along(indices: list[int], starts: Array) -> tuple[Array, list[int]]:
            taken = [kernels.stage_parameters(start)[rows][:, indices] for start in starts if indices]
            return np.stack(taken, axis=1) if taken else np.empty((len(rows), 1, 0)), indices

        return cls(states, given, along(own, given), along(alike, given[:1]))

    def at(self, rows: Array) -> Array:
        """Parameters of each decision and the end of some episodes, (K + 1, B, n_p)."""
        (moving, own), (staged, alike) = self.moving, self.staged
        found = np.repeat(self.parameters[None, rows], len(moving), axis=0)
        if own:
            found[:, :, own] = moving[:, rows]
        found[:, :, alike] = staged
        return found
