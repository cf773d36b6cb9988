"""The environment as an agent practices in it: actions held for several time steps, small, rewards scaled."""

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class HeldActions(VecEnvWrapper):
    """Holds each action for some time steps, so that a decision is one of dozens, not of a thousand.

    Rewards of the steps are added up and scaled, or, where a reward is that of being somewhere, as on the
    goal environment, the last one stands for all: it is what hindsight recomputes. Of the mean cost of a step
    a power may be taken: with 1/2 the quadratic cost becomes one that grows like the error, so that the last
    centimeters, a thousandth of the cost of a maneuver, are worth an agent's while. An episode that ends in
    success may be rewarded for it, and the errors at the end may cost more than the scene charges: its
    optimum ends just outside the tolerances for some starts. The action space shrinks
    to the part of the environment's that the agent is meant to use; what it holds are still the environment's
    actions, so a policy that was trained here flies there.

    A copy whose episode ends while an action is held begins the next one, and the rest of the hold is its
    first steps; they are not counted for the episode that has ended.
    """

    def __init__(
        self,
        venv: VecEnv,
        *,
        repeat: int,
        action_scale: NDArray[np.float32],
        reward_scale: float = 1.0,
        cost_power: float = 1.0,
        success_reward: float = 0.0,
        end_error_cost: float = 0.0,
        tolerances: tuple[float, float] = (math.inf, math.inf),
        add_rewards: bool = True,
    ) -> None:
        """Wrap an environment.

        Args:
            venv: The environment, its actions fractions of limits.
            repeat: Time steps for which an action is held.
            action_scale: Largest action of each input, shape (n_u,), fraction of its limit.
            reward_scale: Factor of rewards.
            cost_power: Power of the mean cost of the steps, in (0, 1]; rewards are minus costs.
            success_reward: Reward of an episode that ends in success, not scaled.
            end_error_cost: What it costs to end far off, not scaled; e^2 / (1 + e^2) of it are charged, e^2
                the sum of the squares of angle and distance over their tolerances.
            tolerances: Of success, for angle and distance, deg and m.
            add_rewards: Whether rewards are added up, or the last one counts.
        """
        space = spaces.Box(-action_scale, action_scale, dtype=np.float32)
        super().__init__(venv, action_space=space)
        self.repeat, self.add_rewards = repeat, add_rewards
        self.reward_scale, self.cost_power = reward_scale, cost_power
        self.success_reward, self.end_error_cost = success_reward, end_error_cost
        self.tolerances, self.action_scale = tolerances, action_scale
        self._actions: NDArray[Any] | None = None

    def around(self, venv: VecEnv) -> "HeldActions":
        """Wrap another environment in the same way.

        Args:
            venv: The environment.

        Returns:
            The wrapped one.
        """
        return HeldActions(
            venv,
            repeat=self.repeat,
            action_scale=self.action_scale,
            reward_scale=self.reward_scale,
            cost_power=self.cost_power,
            success_reward=self.success_reward,
            end_error_cost=self.end_error_cost,
            tolerances=self.tolerances,
            add_rewards=self.add_rewards,
        )

    def reset(self) -> VecEnvObs:
        """Begin new episodes of all copies.

        Returns:
            Observations, shape (num_envs, n_obs), units as in `DQSpaceArmEnv`.
        """
        return self.venv.reset()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions that `step_wait` holds.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u).
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Hold the actions.

        Returns:
            Observations, shape (num_envs, n_obs), after the last step; rewards, and whether an episode ended,
            shape (num_envs,); infos, empty but at the end of an episode.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        total = np.zeros(self.num_envs)
        done = np.zeros(self.num_envs, dtype=np.bool_)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for _ in range(self.repeat):
            self.venv.step_async(self._actions)
            observations, rewards, ended, step_infos = self.venv.step_wait()
            total = np.where(done, total, total + rewards if self.add_rewards else rewards)
            for i in np.flatnonzero(ended & ~done):
                infos[i] = step_infos[i]
            done |= ended
        scaled = self._scaled(total)
        if self.success_reward or self.end_error_cost:
            for i in np.flatnonzero(done):
                scaled[i] += self._reward_at_the_end(infos[i])
        return observations, scaled, done, infos

    def _reward_at_the_end(self, info: Mapping[str, Any]) -> float:
        angle, distance = self.tolerances
        errors = (info["attitude_error"] / angle) ** 2 + (info["position_error"] / distance) ** 2
        # Bounded, or the few flights that go astray would be all that a critic learns.
        charged = self.end_error_cost * float(errors / (1.0 + errors))
        return self.success_reward * float(info["is_success"]) - charged

    def _scaled(self, rewards: NDArray[np.float64]) -> NDArray[np.float32]:
        if self.cost_power != 1.0:
            mean_cost = np.maximum(-rewards / self.repeat, 0.0)
            rewards = -self.repeat * mean_cost**self.cost_power
        return (self.reward_scale * rewards).astype(np.float32)


def action_limits(venv: VecEnv) -> NDArray[np.float32]:
    """Largest action of each input.

    Args:
        venv: An environment whose action space is a symmetric box.

    Returns:
        Shape (n_u,), fractions of limits.
    """
    return np.asarray(cast(spaces.Box, venv.action_space).high, dtype=np.float32)
