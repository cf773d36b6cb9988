"""The native vector environment of goals: many `DQSpaceArmGoal-v0` stepped by one call of machine code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.environment.goal_rewards import (
    Comparison,
    ComputesRewards,
    GoalRewards,
    Observation,
    RewardType,
    show_goals,
)
from dq_space_arm_env.environment.saved_states import PicklesEpisodes, scene_to_copy
from dq_space_arm_env.environment.specification import goal_observation_space
from dq_space_arm_env.environment.sub_environments import Rows, StepResult, SubEnvironments
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.scene import Scene
from dq_space_arm_env.task.step_report import FLAGS, report_names

Array = NDArray[Any]
Mask = NDArray[np.bool_]

_SUCCESS, _DIVERGED = FLAGS.index("is_success"), FLAGS.index("diverged")


class DQSpaceArmGoalVectorEnv(ComputesRewards, DQSpaceArmVectorEnv):
    """`num_envs` sub-environments, bit-equal to single `DQSpaceArmGoalEnv` with the same seeds and actions.

    `gymnasium.make_vec("DQSpaceArmGoal-v0", num_envs=1024)` creates it. Spaces, reward and episode ends are
    those of `DQSpaceArmGoalEnv`, observations dictionaries of arrays of shape (num_envs, n); what is said of
    seeds, options, `info`, pictures and autoreset modes in `DQSpaceArmVectorEnv` holds here too. In the mode
    `SAME_STEP` each of `final_obs` is a dictionary. `compute_reward` takes goals of any number of steps.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scene: Scene | Mapping[str, Any] | str | Path = "random-target",
        reward_type: RewardType = "sparse",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **kwargs: Any,
    ) -> None:
        """Load a scene and compile its step, or take it from the cache.

        Args:
            num_envs: Number of sub-environments.
            scene: Name of a shipped scene, path of a YAML file, its content as a mapping, or a scene.
            reward_type: "sparse" or "dense".
            autoreset_mode: What follows the end of an episode.
            **kwargs: Other arguments of `DQSpaceArmVectorEnv`, by name.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If `DQSpaceArmGoalEnv` or `DQSpaceArmVectorEnv` refuses an argument.
        """
        self.reward_type = reward_type
        super().__init__(num_envs, scene, autoreset_mode, **kwargs)
        copied = scene_to_copy(scene, self.scene)
        PicklesEpisodes.__init__(self, num_envs, copied, reward_type, autoreset_mode, **kwargs)
        self._seen = None  # a state that is shown again gives the same bits

    def _make_observation_space(self) -> spaces.Space[Any]:
        return goal_observation_space(self.kernels)

    def _make_sub_environments(self) -> SubEnvironments:
        self._goals = GoalRewards(self.kernels, self.reward_type)
        return _GoalSubEnvironments(self.kernels, self.num_envs, self._goals)

    def _show_again(self, rows: Rows, result: StepResult) -> None:
        """Do nothing: goal sub-environments that are observed show all their states."""

    def step(self, actions: ArrayLike) -> tuple[Observation, Array, Mask, Mask, dict[str, Any]]:
        """Apply an action to every sub-environment for one time step.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].

        Returns:
            Observations, rewards, terminated (always False), truncated, info.

        Raises:
            ResetNeeded: Before the first reset, and with autoreset disabled when an episode is over.
            TypeError: If the actions are masked, or not of real numbers.
            ValueError: If the actions have a wrong shape or a NaN; nothing has moved then.
        """
        observations, rewards, ended, never, info = super().step(actions)
        return observations, rewards, never, ended, info


class _GoalSubEnvironments(SubEnvironments):
    """Sub-environments that show goals, with the rewards of these."""

    def __init__(self, kernels: Kernels, count: int, goals: GoalRewards) -> None:
        super().__init__(kernels, count)
        self._goals = goals
        names = report_names(kernels.scene)
        self._errors = names.index("attitude_error"), names.index("position_error")

    def observe(self, rows: Rows, result: StepResult | None = None) -> StepResult:
        """Observe without a step, see the super class; a new result shows the states of other rows too."""
        if result is None:
            plain = super().observe(rows)
            result = plain._replace(observation=self._shown())
        else:
            super().observe(rows, result)  # writes the observation that goals replace
            for name, part in self._shown(rows).items():
                result.observation[name][rows] = part
        self._judge(rows, result)
        return result

    def _shown(self, rows: Rows | slice = slice(None)) -> Observation:
        return show_goals(self._kernels, self.x[rows], self.stage_parameters(rows))

    def observe_states(self, x: Array) -> Observation:
        """Observations of other states, shape (count, n_x), at the present times."""
        return show_goals(self._kernels, x.astype(self.x.dtype, copy=False), self.stage_parameters())

    def step(self, actions: ArrayLike, resetting: Rows) -> StepResult:
        """Step all sub-environments, see the super class."""
        result = super().step(actions, resetting)._replace(observation=self._shown())
        comparison = self._judge(slice(None), result)
        result.report[0] = self._goals.of(comparison, result.flags[_DIVERGED])
        return result

    def _judge(self, rows: Rows | slice, result: StepResult) -> Comparison:
        """Make errors and success agree with the reward about the goal, to the last bit."""
        goals = (result.observation[name][rows] for name in ("achieved_goal", "desired_goal"))
        comparison = self._goals.compare(*goals)
        for row, error in zip(self._errors, comparison[:2], strict=True):
            result.report[row, rows] = error
        result.flags[_SUCCESS, rows] = comparison.is_success & ~result.flags[_DIVERGED, rows]
        return comparison
