"""Penalties of a scene's constraints in the cost of episodes, with one multiplier per row for all of them.

The slopes of an episode's cost are then those of the augmented Lagrangian of `task.augmented_lagrangian`. A
policy has to keep to a row from all starts: dual ascent lets the price of a violation rise while too many
episodes have one, however large, and else fall slowly. Since the penalty is a barrier inside, a higher price
keeps flights at a larger distance. Rates of controls, and what is exact at the end, have no penalty, nor have
the torques of motors at speed, to which environments clip.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import Kernels, Scene
from dq_space_arm_env.scene.constraint_rows import n_multipliers, path_rows, penalized_rows
from dq_space_arm_env.scene.constraints import TorqueSpeed

Array = NDArray[Any]

LEAST = 0.01  # price at first, and at least: one that had vanished would come back too late
STIFFNESS = 5.0  # penalty of a row, relative to one over its tolerance
CHARGED = 0.5  # violation that counts, relative to the tolerance: flights between decisions keep within it
ALLOWED = 0.005  # share of the episodes that may violate a row, over the number of those with a price above
MOST = 0.1  # share beyond which a price rises no faster
NEAR = 5.0  # tolerances; where few episodes come so near, a price falls as fast as it rises
RATE = 0.5  # of change of a price's logarithm in an update, for all episodes


def priced_rows(scene: Scene) -> NDArray[np.bool_]:
    """Which of `penalized_rows` have a price: not the torques to which environments clip by themselves."""
    clipped = {each.name for each in scene.constraints if isinstance(each, TorqueSpeed)}
    return np.array([row.name.partition(":")[0] not in clipped for row in penalized_rows(scene)], np.bool_)


class Penalties:
    """Penalties of B episodes of K decisions.

    Attributes:
        parameters: Those of the penalized programs, shape (K + 1, B, n_p + 2 m).
        prices: Of the rows along the path, shape (m,): what a violation by the tolerance costs at first order
            if it lasts all the episode, relative to a cost.
        cost: That cost; multipliers are proportional to it.
    """

    def __init__(self, kernels: Kernels, decisions: int, count: int, last_weight: float) -> None:
        """Prepare for so many decisions and episodes; the end counts in the cost with a weight."""
        scene, rows = kernels.scene, penalized_rows(kernels.scene)
        self._kernels, self._last_weight = kernels, last_weight
        self._tolerances = np.array([row.tolerance for row in rows])
        self._at_end = np.array([not row.has_input for row in rows])
        self._is_penalized = np.array([not row.is_rate for row in path_rows(scene)])
        self._priced = priced_rows(scene)
        self.prices, self.cost = np.where(self._priced, LEAST, 0.0), 0.0
        m = n_multipliers(scene)
        self.parameters = np.zeros((decisions + 1, count, kernels.n_p + 2 * m), kernels.dtype)
        self._multipliers, self._penalties = np.split(self.parameters[..., kernels.n_p :], 2, axis=-1)

    def prepare(self, parameters: Array, emphasis: float) -> None:
        """Take the scene's parameters of each decision and the end, (K + 1, B, n_p), and the end's emphasis.

        The emphasis multiplies all of the terminal cost but the base's velocity: here, not the penalties.
        """
        self.parameters[..., : self._kernels.n_p] = parameters
        m, at_end, penalties = len(self.prices), self._at_end, STIFFNESS / self._tolerances
        multipliers = self.prices / self._tolerances * (self.cost / self._kernels.scene.simulation.steps)
        self._multipliers[:-1, :, :m], self._penalties[:-1, :, :m] = multipliers, penalties
        # Those of success, which come after the path's, stay zero.
        n_end = int(at_end.sum())
        self._multipliers[-1, :, :n_end] = multipliers[at_end] * (self._last_weight / emphasis)
        self._penalties[-1, :, :n_end] = penalties[at_end]

    def follow(self, states: Array, inputs: Array, parameters: Array) -> None:
        """Let the prices follow what episodes violate after each decision's step.

        Args:
            states: Shape (K + 1, B, n_x).
            inputs: Shape (K + 1, B, n_u).
            parameters: Shape (K + 1, B, n_p).
        """
        kernels, rows = self._kernels, len(inputs[:-1]) * inputs.shape[1]
        after, held, given = (
            np.reshape(each, (rows, each.shape[-1])) for each in (states[1:], inputs[:-1], parameters[1:])
        )
        residuals = kernels.constraints(after, held, given if kernels.n_p else None)
        shape = len(inputs) - 1, -1, len(self.prices)
        worst = (residuals[:, self._is_penalized] / self._tolerances).reshape(shape).max(axis=0)
        violating = np.minimum((worst > CHARGED).mean(axis=0), MOST)
        near = np.minimum((worst > -NEAR).mean(axis=0) / MOST, 1.0)
        allowed = ALLOWED / max(1, int((self.prices > LEAST).sum()))
        factors = np.exp(RATE * (violating - MOST + near * (MOST - allowed)))
        self.prices[:] = np.where(self._priced, np.maximum(self.prices * factors, LEAST), 0.0)
