"""The training environment: small actions, held for several time steps, and scaled rewards."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

ERRORS = ("attitude_error", "position_error", "angular_velocity_error", "velocity_error")
"""Of the tip at the end, in the order of the tolerances; velocities where success asks for them."""


class HeldActions(VecEnvWrapper):
    """Holds each action for several time steps: dozens of decisions per episode instead of a thousand.

    Rewards of the held steps are added up and scaled. On the goal environment, where a reward is that of
    being somewhere, the last one counts alone, since hindsight recomputes it. `cost_power` raises the mean
    cost of a step to a power: with 1/2 the quadratic cost grows like the error, so that the last centimeters,
    a thousandth of a maneuver's cost, are worth the effort. `success_reward` pays for an episode that ends in
    success; `end_error_cost` charges the final errors beyond what the scene does, whose optimum ends just
    outside the tolerances for some starts. The action space shrinks to the agent's part of the environment's;
    the actions are still the environment's, so a policy trained here flies there.

    A copy whose episode ends during a hold starts the next one with the rest of the hold; these steps do not
    count for the episode that ended.
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
        tolerances: Sequence[float | None] = (),
        add_rewards: bool = True,
    ) -> None:
        space = spaces.Box(-action_scale, action_scale, dtype=np.float32)
        super().__init__(venv, action_space=space)
        self.repeat, self.add_rewards = repeat, add_rewards
        self.reward_scale, self.cost_power = reward_scale, cost_power
        self.success_reward, self.end_error_cost = success_reward, end_error_cost
        self.tolerances, self.action_scale = tolerances, action_scale
        self._actions: NDArray[Any] | None = None

    def around(self, venv: VecEnv) -> "HeldActions":
        """Wrap another environment in the same way."""
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
        return self.venv.reset()

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
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
                scaled[i] += self._final_reward(infos[i])
        return observations, scaled, done, infos

    def _final_reward(self, info: Mapping[str, Any]) -> float:
        limits = zip(ERRORS, self.tolerances, strict=False)
        errors = sum((info[name] / limit) ** 2 for name, limit in limits if limit is not None)
        # Bounded, or a few stray flights would dominate the critic.
        charged = self.end_error_cost * float(errors / (1.0 + errors))
        return self.success_reward * float(info["is_success"]) - charged

    def _scaled(self, rewards: NDArray[np.float64]) -> NDArray[np.float32]:
        if self.cost_power != 1.0:
            mean_cost = np.maximum(-rewards / self.repeat, 0.0)
            rewards = -self.repeat * mean_cost**self.cost_power
        return (self.reward_scale * rewards).astype(np.float32)


def action_limits(venv: VecEnv) -> NDArray[np.float32]:
    """Upper bounds of the actions, shape (n_u,)."""
    return np.asarray(cast(spaces.Box, venv.action_space).high, dtype=np.float32)
