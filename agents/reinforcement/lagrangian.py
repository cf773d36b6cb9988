"""Lagrangian of a scene's constraints: rewards that charge violations, at a price that dual ascent finds.

After Ray, Achiam & Amodei ("Benchmarking safe exploration in deep reinforcement learning", 2019): the learner
maximizes (r - m c) / (1 + m), with the reward r of a decision, its constraint cost c and the multiplier m.
The cost is log(1 + v) for the largest violation v during the decision, `info["cost"]`, which is relative to
the tolerance: continuous, at first linear, and the larger the deeper, so that a path through an obstacle has
a way out; of a violation a hundred times the tolerance it is 4.6, so that no flight dominates the critic.

What is limited is the share of episodes in which v exceeds 1 at a step, as `evaluate` counts it: the cost
stands in for that share where the policy is improved, and the multiplier follows the share itself (a proxy
Lagrangian, Cotter et al., JMLR 2019). It rises exponentially, from a price so small that the task is learned
first: a price that is high from the start teaches to stay away from obstacles and target alike.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn, VecEnvWrapper

from agents.vec_env import SB3VecEnv

MOST = 0.1  # excess of the share over its limit beyond which the multiplier rises no faster


class Lagrangian(VecEnvWrapper):
    """Charges the violations of constraints in the rewards of held actions.

    Attributes:
        multiplier: Price m of a decision that violates, in units of the rewards; at least 0.
        violating_episodes: Share of the episodes with a violation, of those before the last ascent.
    """

    def __init__(self, venv: SB3VecEnv, limit: float, initial: float, learning_rate: float) -> None:
        """Charge violations in copies whose actions are held by `agents.wrappers.vector.RepeatAction`.

        Args:
            venv: The copies, of a scene with constraints.
            limit: Share of the episodes that may violate.
            initial: Multiplier at first, and at least.
            learning_rate: Growth of the multiplier's logarithm per ascent, over the excess of the share.
        """
        super().__init__(venv)
        self.limit, self.initial, self.learning_rate = limit, initial, learning_rate
        self.multiplier, self.violating_episodes = initial, 0.0
        self._violated = np.zeros(self.num_envs, dtype=np.bool_)  # in the running episodes
        self._ended = self._violating = 0  # episodes since the last ascent

    def reset(self) -> VecEnvObs:
        """Start new episodes, which do not violate yet; those that ended before do not count."""
        self._violated[:] = False
        self._ended = self._violating = 0
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Return what the copies do, with rewards (r - m c) / (1 + m), shape (num_envs,)."""
        observations, rewards, dones, infos = self.venv.step_wait()
        largest: NDArray[np.float64] = self.venv.get_attr("largest_cost", 0)[0]
        charged = (rewards - self.multiplier * np.log1p(largest)) / (1.0 + self.multiplier)
        self._violated |= largest > 1.0
        self._ended += int(dones.sum())
        self._violating += int((dones & self._violated).sum())
        self._violated &= ~dones
        return observations, charged.astype(np.float32), dones, infos

    def ascend(self) -> None:
        """Let the multiplier follow the episodes that have ended since the last call, if any."""
        if not self._ended:
            return
        self.violating_episodes = self._violating / self._ended
        excess = min(self.violating_episodes - self.limit, MOST)
        self.multiplier = max(self.initial, self.multiplier * math.exp(self.learning_rate * excess))
        self._ended = self._violating = 0

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copy the running episodes, see `SB3VecEnv.get_state`, with multiplier and counts."""
        venv: Any = self.venv
        return {
            **venv.get_state(),
            "multiplier": np.array([self.multiplier, self.violating_episodes]),
            "violated": self._violated.copy(),
            "violating": np.array([self._ended, self._violating]),
        }

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `get_state` was called.

        Args:
            state: Its arrays.

        Raises:
            KeyError, ValueError: If an array is missing, or has another shape or type.
        """
        venv: Any = self.venv
        self.multiplier, self.violating_episodes = map(float, state["multiplier"])
        self._ended, self._violating = map(int, state["violating"])
        self._violated[:] = state["violated"]
        venv.set_state(state)
