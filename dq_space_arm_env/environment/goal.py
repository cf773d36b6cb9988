"""The environment `DQSpaceArmGoal-v0`: the maneuver of `DQSpaceArm-v0` with the target as a goal, for hindsight experience replay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.goal_rewards import (
    Comparison,
    ComputesRewards,
    GoalRewards,
    Observation,
    RewardType,
    show_goals,
)
from dq_space_arm_env.environment.reset_options import checked_options, given_start, saved_state
from dq_space_arm_env.environment.saved_states import PicklesEpisodes, checked_state, scene_to_copy
from dq_space_arm_env.environment.specification import PlainSpec, goal_observation_space
from dq_space_arm_env.scene import Scene

Array = NDArray[Any]


class DQSpaceArmGoalEnv(ComputesRewards, gymnasium.Env[Observation, NDArray[Any]], PicklesEpisodes):
    """
    ## Description

    The spacecraft of `DQSpaceArm-v0` in the form that goal-conditioned agents and hindsight experience replay (HER; Andrychowicz et al., NeurIPS 2017) expect:
    the tip of the arm has to reach a pose, the goal, and the reward can be recomputed for any other goal. A scene defines robot, limits, the spread of start and target,
    tolerances, weights and the time step. The interface is that of Gymnasium-Robotics' multi-goal environments. The tables show scene `random-target`.

    ## Action Space

    That of `DQSpaceArm-v0`: a `Box(-1, 1, (12,), float32)`, inputs as fractions of their limits.

    ## Observation Space

    A `Dict` of three boxes of the scene's precision, float64. A goal is a pose, a unit dual quaternion of 8 numbers in every scene; of a planar pose four are zero.
    A simulation whose numbers grow toward the bound of 1e6 counts as diverged.

    | Key             | Shape | Meaning                                                            | Min  | Max |
    |-----------------|-------|--------------------------------------------------------------------|------|-----|
    | `observation`   | (23,) | the state, independent of the goal                                 | -1e6 | 1e6 |
    | `achieved_goal` | (8,)  | pose of the tip q_{G/I}: real part, then dual part in m            | -1, -1e6 | 1, 1e6 |
    | `desired_goal`  | (8,)  | pose of the target q_{D/I} of the episode, likewise                | -1, -1e6 | 1, 1e6 |

    `observation` has the entries of `env.unwrapped.kernels.layout.state`:

    | Num   | Observation                                                           | Min  | Max | Unit  |
    |-------|-----------------------------------------------------------------------|------|-----|-------|
    | 0-3   | pose of the base q_{e0/I}, real part                                  | -1   | 1   | -     |
    | 4-7   | the same, dual part                                                   | -1e6 | 1e6 | m     |
    | 8-10  | angles of joints 1 to 3, not wrapped                                  | -1e6 | 1e6 | rad   |
    | 11-13 | wrist angles psi, theta, phi, not wrapped                             | -1e6 | 1e6 | rad   |
    | 14-16 | angular velocity of the base, base axes                               | -1e6 | 1e6 | rad/s |
    | 17-19 | velocity of the base's center of mass, base axes                      | -1e6 | 1e6 | m/s   |
    | 20-22 | rates of joints 1 to 3                                                | -1e6 | 1e6 | rad/s |

    In a scene with phases the number of the phase, from 0, follows. Where the target moves, its twist in its own axes comes last, 6 entries in rad/s and m/s, and
    `desired_goal` is its pose now. A relabeled goal stands for a target that passes there; velocities count in no reward of this environment, nor in its `is_success`.

    q and -q are the same pose. At reset the sign of `achieved_goal`, and with it that of the base's pose, is chosen such that its real part has a non-negative product
    with that of `desired_goal`; it is then carried along by continuity. Rewards do not depend on the sign of either goal.

    ## Rewards

    | `reward_type` | Reward of a step                                                                                              |
    |---------------|---------------------------------------------------------------------------------------------------------------|
    | `"sparse"`    | 0 if the tip is within the scene's tolerances of the goal after the step (3 deg and 0.1 m), else -1           |
    | `"dense"`     | -(q_{G/I} - q_{D/I})' W (q_{G/I} - q_{D/I}) after the step, weight 15: the paper's pose cost, the smaller over both signs |

    With the scene's `cost.pose_error: relative` the dense reward squares q_{D/G} - 1, likewise. Its weights are the scene's at all times: goals alone do not tell
    what phases or parameters make of them.

    `compute_reward(achieved_goal, desired_goal, info)` returns the reward for other goals, single ones (8,) or batches (B, 8); for those of a step and its `info` it
    returns the reward of that step, bit for bit. Effort is not part of the reward, as it could not be computed from goals.

    `info` has the keys of `DQSpaceArm-v0`, the terms of the paper's cost included; `is_success` tells whether the tip is within the tolerances.

    ## Starting State

    As in `DQSpaceArm-v0`, with the same seeds and options. If the target has a spread, the goal of an episode is drawn, or given by
    `options={"target": q}`; otherwise it is always the scene's target. HER relabels with achieved goals in either case.

    ## Episode End

    Nothing terminates an episode: the goal has to be reached and held, and success does not end it. Scenes with `other_tips`, or with a
    constraint that has `terminates: true`, are refused.

    1. Truncation: the scene's number of steps (1000) is reached. In `DQSpaceArm-v0` that is the end of the task; here the time left is not observed and there is no
       terminal cost, so a step has the same value at any time, and algorithms should bootstrap.
    2. Truncation: the simulation diverged. The observation shows the last sound state, `info["diverged"]` is true, and the reward is that of a whole episode
       spent there: the dense reward times the number of steps, or -1000 if sparse. Diverging therefore never pays, with or without bootstrapping.
       Recomputed without `info`, HER's default, the reward of a diverged step is that of any other; this is no loophole, since a truncated
       transition bootstraps from the last sound state.

    ## Arguments

    | Parameter     | Type                     | Default           | Description                                             |
    |---------------|--------------------------|-------------------|---------------------------------------------------------|
    | `scene`       | **str, Path, dict or Scene** | `"random-target"` | name of a shipped scene, path of a YAML file, its content as a mapping, or a `Scene` |
    | `reward_type` | **str**                  | `"sparse"`        | `"sparse"` or `"dense"`                                 |
    | `render_mode`, `width`, `height`, `default_camera_config` | | | as in `DQSpaceArm-v0`                         |

    ```python
    >>> import gymnasium
    >>> import dq_space_arm_env
    >>> env = gymnasium.make("DQSpaceArmGoal-v0", reward_type="sparse")
    >>> observation, info = env.reset(seed=0)
    >>> {key: value.shape for key, value in observation.items()}
    {'observation': (23,), 'achieved_goal': (8,), 'desired_goal': (8,)}
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    >>> reward, info["is_success"]
    (-1.0, False)

    ```

    With the goal at the tip, the same step would have been a success:

    ```python
    >>> env.unwrapped.compute_reward(observation["achieved_goal"], observation["achieved_goal"], info)
    0.0

    ```

    ## Vectorized environment

    `DQSpaceArmGoalVectorEnv` steps many sub-environments together, bit-equal to single environments with the same seeds.

    ```python
    >>> venv = gymnasium.make_vec("DQSpaceArmGoal-v0", num_envs=3)
    >>> observations, infos = venv.reset(seed=0)
    >>> observations["desired_goal"].shape
    (3, 8)

    ```

    ## Version History

    * v0: Initial version.
    """

    spec = PlainSpec()
    metadata: dict[str, Any] = DQSpaceArmEnv.metadata

    def __init__(
        self,
        scene: Scene | Mapping[str, Any] | str | Path = "random-target",
        reward_type: RewardType = "sparse",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        default_camera_config: Mapping[str, Any] | None = None,
    ) -> None:
        """Load a scene and compile its step, or take it from the cache.

        Args:
            scene: Name of a shipped scene, path of a YAML file, its content as a mapping, or a scene.
            reward_type: "sparse" or "dense".
            render_mode: None, "rgb_array" or "human".
            width: Width of the pictures, pixels.
            height: Height of the pictures, pixels.
            default_camera_config: Any of "azimuth" and "elevation" [deg], "distance" [m] and "lookat", shape (3,), m.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If the reward type or the render mode is unknown, `DQSpaceArmEnv` refuses the scene, it has other tips,
                or a constraint of it terminates episodes.
        """
        self._env = DQSpaceArmEnv(scene, render_mode, width, height, default_camera_config)
        self.scene, self.kernels = self._env.scene, self._env.kernels
        picture = width, height, default_camera_config
        PicklesEpisodes.__init__(self, scene_to_copy(scene, self.scene), reward_type, render_mode, *picture)
        self.reward_type, self.render_mode = reward_type, render_mode
        self._goals = GoalRewards(self.kernels, reward_type)
        self.metadata = self._env.metadata
        self.action_space = self._env.action_space
        self.observation_space: spaces.Space[Any] = goal_observation_space(self.kernels)
        self._truncated = False

    @property
    def state(self) -> Array:
        """The state, shape (n_x,), see `DQSpaceArmEnv.state`."""
        return self._env.state

    @property
    def parameters(self) -> Array:
        """Parameters of this episode, shape (n_p,), see `DQSpaceArmEnv.parameters`."""
        return self._env.parameters

    @property
    def elapsed_steps(self) -> int:
        """Time steps that this episode has taken, see `DQSpaceArmEnv.elapsed_steps`."""
        return self._env.elapsed_steps

    @property
    def episode_scene(self) -> Scene:
        """The scene of this episode, see `DQSpaceArmEnv.episode_scene`."""
        return self._env.episode_scene

    @property
    def _begun(self) -> bool:
        return self._env._begun

    def get_state(self) -> dict[str, Array]:
        """Copy what all later steps and resets depend on.

        Returns:
            Arrays by name, see `DQSpaceArmEnv.get_state`.
        """
        self._env.np_random = self.np_random  # a copy, or a caller, may have given this one another
        return {**self._env.get_state(), "truncated": np.array(self._truncated)}

    def set_state(self, state: Mapping[str, Array]) -> None:
        """Go on where `get_state` was called, see `DQSpaceArmEnv.set_state`.

        Args:
            state: What `get_state` returned, arrays of its shapes, or a row of a vector environment's.

        Raises:
            ValueError: If an array is missing, has another shape or type, or is not finite.
        """
        given, expected = state, {"truncated": np.array(True)}
        if (
            isinstance(state, Mapping) and "over" in state
        ):  # all that vector environments keep: nothing else ends
            given = {"truncated": state["over"], **state}
        truncated = checked_state(given, expected, self.scene.simulation.steps)["truncated"]
        self._env.set_state(state)
        self.np_random, self._truncated = self._env.np_random, bool(truncated)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the random start and goal; None keeps the generator.
            options: As for `DQSpaceArmEnv.reset`; {"target": q} with q of shape (8,) sets the goal.

        Returns:
            Observation and info.

        Raises:
            ValueError: If an option is wrong.
        """
        given = checked_options(options)
        saved = saved_state(given)
        if saved is None:
            given_start(self.kernels, given)  # if it is refused, nothing has changed
            self._truncated = False
        else:
            if seed is not None:
                seeding.np_random(seed)  # if it is refused, nothing has changed
            self.set_state(saved)
        super().reset(seed=seed)
        self._env.np_random = self.np_random
        _, info = self._env.reset(options=options)
        self._env.np_random = self.np_random  # not that of the state, if there is a seed
        observation = self._observe()
        return observation, self._judged(info, self._compare_goals(observation))

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action for one time step.

        Args:
            action: Inputs as fractions of their limits, shape (n_u,); clipped to [-1, 1].

        Returns:
            Observation, reward, terminated (always False), truncated, info.

        Raises:
            ResetNeeded: Before the first reset, and after the end of an episode.
            TypeError: If the action is masked, or not of real numbers.
            ValueError: If the action has a wrong shape or a NaN.
        """
        _, _, self._truncated, _, info = self._env.step(action)
        observation = self._observe()
        comparison = self._compare_goals(observation)
        reward = float(self._goals.of(comparison, info["diverged"]))
        return observation, reward, False, self._truncated, self._judged(info, comparison)

    def _observe(self) -> Observation:
        return show_goals(self.kernels, self._env.state, self._env.stage_parameters)

    def _compare_goals(self, observation: Observation) -> Comparison:
        return self._goals.compare(observation["achieved_goal"], observation["desired_goal"])

    def _judged(self, info: dict[str, Any], comparison: Comparison) -> dict[str, Any]:
        """Make `info` agree with the reward about the goal, to the last bit."""
        info["attitude_error"] = float(comparison.attitude_error)
        info["position_error"] = float(comparison.position_error)
        info["is_success"] = bool(comparison.is_success) and not info["diverged"]
        return info

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> bool:
        """Tell whether a step terminates the episode, which none does.

        Args:
            achieved_goal: Poses of the tip after the step, shape (8,) or (B, 8).
            desired_goal: Goals, shape (8,) or (B, 8).
            info: The step's info.

        Returns:
            False.
        """
        return False

    def compute_truncated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> bool:
        """Tell whether the latest step truncated the episode, whatever the goals.

        Args:
            achieved_goal: Poses of the tip after the step, shape (8,) or (B, 8).
            desired_goal: Goals, shape (8,) or (B, 8).
            info: The step's info.

        Returns:
            True after the scene's number of steps and after a divergence.
        """
        return self._truncated

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the present state, see `DQSpaceArmEnv.render`.

        Returns:
            Picture of shape (height, width, 3), uint8, or None for render mode "human".
        """
        return self._env.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._env.close()
