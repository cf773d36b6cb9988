"""Wrappers of single environments: actions that are held and small, rewards that are shaped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from agents.wrappers.shaping import (
    HeldReward,
    Shaping,
    check_repeat,
    held_metadata,
    refuse_relabeling,
    shrunk,
)

Env = gymnasium.Env[Any, Any]
Result = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class RepeatAction(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Holds each action for several time steps: dozens of decisions per episode instead of a thousand.

    A decision ends early with its episode, terminated or truncated as the time step that ends it. Its `info`
    is that of its last time step.

    Attributes:
        repeat: Number of time steps for which an action is held.
        steps_taken: Number of time steps of the last decision; fewer where its episode ended.
        largest_cost: Largest constraint cost of these time steps, `info["cost"]`, dimensionless; 0 without
            constraints.
    """

    def __init__(
        self,
        env: Env,
        repeat: int,
        reward: HeldReward = "sum",
        *,
        discount: float = 1.0,
        step_infos: bool = False,
    ) -> None:
        """Wrap an environment.

        Args:
            env: The environment.
            repeat: Number of time steps for which an action is held.
            reward: "sum" of the rewards of these steps; or the "last" one alone, on the goal environment,
                where hindsight recomputes the reward of being somewhere.
            discount: Factor of rewards from one time step to the next within a sum, in (0, 1]. A learner
                then discounts decisions by its power of `repeat`.
            step_infos: Whether `info` holds those of all time steps of the decision as a list, "step_infos".

        Raises:
            TypeError: If the discount is no number.
            ValueError: If an argument is out of range.
        """
        check_repeat(repeat, reward, discount)
        RecordConstructorArgs.__init__(
            self, repeat=int(repeat), reward=reward, discount=discount, step_infos=step_infos
        )
        gymnasium.Wrapper.__init__(self, env)
        self.repeat, self.steps_taken, self.largest_cost = int(repeat), 0, 0.0
        self._sum, self._discount, self._step_infos = reward == "sum", discount, step_infos
        if self._sum and self.repeat > 1:
            self.compute_reward = refuse_relabeling
        self.metadata = held_metadata(env.metadata, self.repeat)

    def step(self, action: Any) -> Result:
        """Hold an action, see `gymnasium.Env.step`."""
        total, weight, infos = 0.0, 1.0, []
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total = total + weight * float(reward) if self._sum else float(reward)
            weight *= self._discount
            infos.append(info)
            if terminated or truncated:
                break
        self.steps_taken = len(infos)
        self.largest_cost = max(each.get("cost", 0.0) for each in infos)
        if self._step_infos:
            info = {**info, "step_infos": infos}
        return observation, total, terminated, truncated, info


class ShrinkActionSpace(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Shrinks the action space to the agent's part of the environment's.

    Thrusters are expensive: a random force of some newtons costs more in a second than the whole maneuver,
    and an agent free to try it learns only to leave it alone. Actions remain the environment's: a policy
    trained here flies without the wrapper, and actions outside the smaller box are not clipped.
    `gymnasium.wrappers.RescaleAction(env, -1, 1)` around it maps [-1, 1] to the box.
    """

    def __init__(self, env: Env, scale: ArrayLike | Mapping[str, float]) -> None:
        """Wrap an environment.

        Args:
            env: The environment.
            scale: Largest actions as fractions of the environment's, above 0 and at most 1: one number, an
                array of shape (n_u,), or a mapping from actuators ("base_force", "base_torque",
                "joint_torque", "wrist_rate", "wheel_torque", "thruster_force") to numbers, 1 by default.

        Raises:
            TypeError: If the action space is no box, or the scale not of numbers.
            ValueError: If the scale is out of range, or names an actuator that the scene lacks.
        """
        plain = dict(scale) if isinstance(scale, Mapping) else np.asarray(scale).tolist()
        RecordConstructorArgs.__init__(self, scale=plain)
        gymnasium.Wrapper.__init__(self, env)
        self.action_space = shrunk(env.action_space, getattr(env.unwrapped, "scene", None), scale)


class ShapeReward(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Shapes rewards for learners.

    The reward r of a decision of n time steps, those that the `RepeatAction` inside has taken, becomes
    s n sign(r) |r / n|^p, with the scale s and the power p: with 1/2 the quadratic cost grows like the error,
    so that the last centimeters, a thousandth of a maneuver's cost, are worth the effort. Where an episode
    ends early, which the environment charges for all remaining steps, n counts these too. Terms at the end of
    an episode are not scaled: `success_reward` pays for success; `end_error_cost` charges the final errors
    beyond what the scene does, whose optimum ends just outside the tolerances for some starts. It is
    c e / (1 + e), where e adds up the squares of the final errors over the tolerances. Rewards are rounded to
    single precision.

    Attributes:
        unshaped: Reward of the last decision as the environment inside gave it.
    """

    def __init__(
        self,
        env: Env,
        scale: float = 1.0,
        power: float = 1.0,
        *,
        success_reward: float = 0.0,
        end_error_cost: float = 0.0,
    ) -> None:
        """Wrap an environment.

        Args:
            env: The environment.
            scale: Factor of rewards.
            power: Exponent of the mean reward of a time step, above 0 and at most 1; signs are kept.
            success_reward: Reward for ending an episode in success.
            end_error_cost: Cost of ending far off the target, half of it where one error equals its tolerance
                and the others are zero.

        Raises:
            TypeError: If an argument is no number.
            ValueError: If an argument is out of range, or `end_error_cost` is asked for without a scene.
        """
        settings: dict[str, Any] = {
            "scale": scale,
            "power": power,
            "success_reward": success_reward,
            "end_error_cost": end_error_cost,
        }
        RecordConstructorArgs.__init__(self, **settings)
        gymnasium.Wrapper.__init__(self, env)
        self.unshaped = 0.0
        self.compute_reward = refuse_relabeling
        self._shaping = Shaping.checked(getattr(env.unwrapped, "scene", None), **settings)

    def step(self, action: Any) -> Result:
        """Take a step whose reward is shaped, see `gymnasium.Env.step`."""
        left = self._shaping.steps_left(self.env.unwrapped)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.unshaped = float(reward)
        steps: int | NDArray[np.int64] = _steps_taken(self.env)[0]
        if left is not None and (terminated or info.get("diverged", False)):
            steps = left
        shaped = self._shaping.of_steps([self.unshaped], steps)
        if (terminated or truncated) and self._shaping.counts_ends:
            shaped += self._shaping.of_ends(info)
        return observation, float(shaped[0]), terminated, truncated, info


def _steps_taken(env: Env) -> tuple[int, int]:
    """Time steps of the last decision, and of one that no end of an episode has cut short."""
    if not isinstance(env, gymnasium.Wrapper):
        return 1, 1
    taken, whole = _steps_taken(env.env)
    if not isinstance(env, RepeatAction):
        return taken, whole
    # Of the decisions that one around them consists of, the last may be short.
    return (env.steps_taken - 1) * whole + taken, env.repeat * whole
