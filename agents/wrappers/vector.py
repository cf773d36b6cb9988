"""Wrappers of vector environments: actions that are held and small, rewards that are shaped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv, VectorRewardWrapper, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from agents.wrappers.shaping import (
    HeldReward,
    Shaping,
    check_repeat,
    held_metadata,
    refuse_relabeling,
    shrunk,
)
from agents.wrappers.vector_infos import Info, Rows, merged, single_infos, with_rows

Mask = NDArray[np.bool_]
Result = tuple[Any, NDArray[Any], Mask, Mask, Info]
Env = VectorEnv[Any, Any, Any]


def chain(env: Env) -> list[Env]:
    """A vector environment with its wrappers, from the outermost in."""
    return [env, *chain(env.env)] if isinstance(env, VectorWrapper) else [env]


class _Finished(NamedTuple):
    """Sub-environments whose decision has ended before the others', as they were then."""

    rows: Rows
    observations: Any
    terminated: Mask
    truncated: Mask
    info: Info
    state: Mapping[str, NDArray[Any]]  # of `get_state`


class RepeatAction(VectorWrapper[Any, Any, Any, Any, Any]):
    """Holds each action for several time steps: dozens of decisions per episode instead of a thousand.

    Bit-equal to single environments in `agents.wrappers.RepeatAction`, in every autoreset mode: where an
    episode ends during a hold, its decision ends, and the sub-environment waits for the others.

    Attributes:
        repeat: Number of time steps for which an action is held.
        steps_taken: Number of time steps of the last decision in each sub-environment, shape (num_envs,);
            fewer where its episode ended, 0 where the step was a reset.
        collected: Sum of the rewards of these time steps, of whatever reward the decision has; not shaped
            where `ShapeReward` is inside.
        largest_cost: Largest constraint cost of these time steps, `info["cost"]`, dimensionless, shape
            (num_envs,); 0 where the step was a reset, and without constraints.
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
        """Wrap a vector environment.

        Args:
            env: The vector environment, which has to save and restore states (`get_state`, `set_state`), as
                those of this package do; inside other wrappers than those of actions and rewards.
            repeat: Number of time steps for which an action is held.
            reward: "sum" of the rewards of these steps; or the "last" one alone, on the goal environment,
                where hindsight recomputes the reward of being somewhere.
            discount: Factor of rewards from one time step to the next within a sum, in (0, 1].
            step_infos: Whether `info` holds those of all time steps of a decision, "step_infos", a list of
                dictionaries for each sub-environment; slow, for they are made one by one.

        Raises:
            TypeError: If the environment cannot save and restore states, or is in a wrapper that cannot; or
                if the discount is no number.
            ValueError: If an argument is out of range.
        """
        check_repeat(repeat, reward, discount)
        super().__init__(env)
        _check_restorable(env)
        self._shaper = next((each for each in reversed(chain(env)) if isinstance(each, ShapeReward)), None)
        self.repeat, self.steps_taken = int(repeat), np.zeros(env.num_envs, dtype=np.int64)
        self.collected, self.largest_cost = np.zeros(env.num_envs), np.zeros(env.num_envs)
        self._sum, self._discount, self._step_infos = reward == "sum", discount, step_infos
        if self._sum and self.repeat > 1:
            self.compute_reward = refuse_relabeling
        self.metadata = held_metadata(env.metadata, self.repeat)

    def step(self, actions: Any) -> Result:
        """Hold actions, see `gymnasium.vector.VectorEnv.step`."""
        home: Any = self.env.unwrapped
        mode, none = self.env.metadata["autoreset_mode"], np.zeros(self.num_envs, dtype=np.bool_)
        # In this mode the first step of those that are over is their reset.
        resetting = home.get_state()["over"] if mode is AutoresetMode.NEXT_STEP else none
        total, collected, largest = np.zeros((3, self.num_envs))
        taken, resting, weight = np.zeros(self.num_envs, np.int64), none, 1.0
        finished: list[_Finished] = []
        infos: list[list[Info]] = [[] for _ in range(self.num_envs)]
        moves = actions
        for step in range(self.repeat):
            observations, rewards, terminated, truncated, info = self.env.step(moves)
            total = np.where(resting, total, total + weight * rewards.astype(float) if self._sum else rewards)
            plain = rewards if self._shaper is None else self._shaper.unshaped
            collected = np.where(resting, collected, collected + plain)
            weight *= self._discount
            if "cost" in info:  # of a scene with constraints
                cost = _constraint_cost(info, terminated | truncated)
                largest = np.where(resting | resetting, largest, np.maximum(largest, cost))
            taken += ~(resting | resetting)
            if self._step_infos:
                _collect(infos, info, ~(resting | resetting), terminated | truncated)
            over = (terminated | truncated | resetting if step == 0 else terminated | truncated) & ~resting
            if step == self.repeat - 1 or (over | resting).all():
                break
            if over.any():
                rows = np.flatnonzero(over)
                state = home.get_state(rows)
                finished.append(_Finished(rows, observations, terminated, truncated, info, state))
                resting = resting | over
                # That of a reset does not matter, so it may be NaN; those that wait would fly with it.
                moves = np.where(resting[:, None], 0.0, actions)
                if mode is AutoresetMode.DISABLED:  # for the others to go on
                    home.reset(options={"reset_mask": over})
        for each in finished:
            observations = with_rows(observations, each.observations, each.rows)
            terminated = with_rows(terminated, each.terminated, each.rows)
            truncated = with_rows(truncated, each.truncated, each.rows)
            info = merged(info, each.info, each.rows)
            home.set_state(each.state, each.rows)
        self.steps_taken, self.collected, self.largest_cost = taken, collected, largest
        if self._step_infos:
            info = _with_step_infos(info, infos, taken > 0, terminated | truncated, mode)
        return observations, total, terminated, truncated, info


def _check_restorable(env: Env) -> None:
    """Raise TypeError where a sub-environment could not wait for the others."""
    if not hasattr(env.unwrapped, "get_state"):
        raise TypeError(
            f"{type(env.unwrapped).__name__} has no get_state(), which holding actions in it needs: wrap "
            "each of its environments in agents.wrappers.RepeatAction"
        )
    for each in chain(env)[:-1]:
        if not isinstance(each, VectorActionWrapper | VectorRewardWrapper | ShrinkActionSpace | ShapeReward):
            raise TypeError(
                f"{type(each).__name__} inside RepeatAction would count the steps in which an episode that "
                "has ended waits for the others: put it around RepeatAction"
            )


def _constraint_cost(info: Info, over: Mask) -> Any:
    """Constraint costs of a time step, shape (num_envs,); where an episode ended, those of its end."""
    cost, final = info["cost"], info.get("final_info", {}).get("cost")
    return cost if final is None else np.where(over, final, cost)


def _collect(infos: list[list[Info]], info: Info, moving: Mask, over: Mask) -> None:
    """Append the infos of a time step to those of the sub-environments that moved."""
    ended = over if "final_info" in info else np.zeros_like(over)
    for rows, source in (
        (np.flatnonzero(moving & ~ended), info),
        (np.flatnonzero(moving & ended), info.get("final_info", {})),
    ):
        for row, each in zip(rows.tolist(), single_infos(source, rows), strict=True):
            infos[row].append(each)


def _with_step_infos(
    info: Info, infos: list[list[Info]], moved: Mask, over: Mask, mode: AutoresetMode
) -> Info:
    """Add the infos of all time steps to the info of a decision, or to that of an episode's end."""
    column = np.empty(len(infos), dtype=object)
    column[:] = infos
    ended = over if mode is AutoresetMode.SAME_STEP else np.zeros_like(over)
    info = {**info, **_masked(column, moved & ~ended)}
    if ended.any():
        info["final_info"] = {**info["final_info"], **_masked(column, ended)}
    return info


def _masked(column: NDArray[Any], mask: Mask) -> Info:
    """An entry of an info: None where the mask is False."""
    shown = column.copy()
    shown[~mask] = None
    return {"step_infos": shown, "_step_infos": mask}


class ShrinkActionSpace(VectorWrapper[Any, Any, Any, Any, Any]):
    """Shrinks the action space to the agent's part of the environment's.

    See `agents.wrappers.ShrinkActionSpace`; `gymnasium.wrappers.vector.RescaleAction(env, -1, 1)` around
    it maps [-1, 1] to the box.
    """

    def __init__(self, env: Env, scale: ArrayLike | Mapping[str, float]) -> None:
        """Wrap a vector environment.

        Args:
            env: The vector environment.
            scale: Largest actions as fractions of the environment's, above 0 and at most 1: one number, an
                array of shape (n_u,), or a mapping by actuator, see `agents.wrappers.ShrinkActionSpace`.

        Raises:
            TypeError: If the action space is no box, or the scale not of numbers.
            ValueError: If the scale is out of range, or names an actuator that the scene lacks.
        """
        super().__init__(env)
        scene = getattr(env.unwrapped, "scene", None)
        self.single_action_space = shrunk(env.single_action_space, scene, scale)
        self.action_space = batch_space(self.single_action_space, env.num_envs)


class ShapeReward(VectorWrapper[Any, Any, Any, Any, Any]):
    """Shapes rewards for learners, see `agents.wrappers.ShapeReward`; rewards are float32.

    Time steps of a decision are those of the vector `RepeatAction` inside. Single environments of Gymnasium's
    vector environments that repeat actions have to be in `agents.wrappers.ShapeReward` themselves.

    Attributes:
        unshaped: Rewards of the last decisions as the environment inside gave them, shape (num_envs,).
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
        """Wrap a vector environment.

        Args:
            env: The vector environment.
            scale: Factor of rewards.
            power: Exponent of the mean reward of a time step, above 0 and at most 1; signs are kept.
            success_reward: Reward for ending an episode in success.
            end_error_cost: Cost of ending far off the target, half of it where one error equals its tolerance
                and the others are zero.

        Raises:
            TypeError: If an argument is no number.
            ValueError: If an argument is out of range, or `end_error_cost` is asked for without a scene.
        """
        super().__init__(env)
        self.unshaped = np.zeros(env.num_envs)
        self.compute_reward = refuse_relabeling
        self._repeater = next((each for each in chain(env) if isinstance(each, RepeatAction)), None)
        self._shaping = Shaping.checked(
            getattr(env.unwrapped, "scene", None),
            scale=scale,
            power=power,
            success_reward=success_reward,
            end_error_cost=end_error_cost,
        )

    def step(self, actions: Any) -> Result:
        """Take a step whose rewards are shaped, see `gymnasium.vector.VectorEnv.step`."""
        left = self._shaping.steps_left(self.env.unwrapped)
        observations, self.unshaped, terminated, truncated, info = self.env.step(actions)
        # A step that was a reset has no time steps, and no reward.
        steps: Any = 1 if self._repeater is None else np.maximum(self._repeater.steps_taken, 1)
        if left is not None:
            diverged = info.get("final_info", info).get("diverged", False)
            steps = np.where(terminated | (truncated & diverged), left, steps)
        shaped = self._shaping.of_steps(self.unshaped, steps)
        if self._shaping.counts_ends and (ended := terminated | truncated).any():
            shaped[ended] += self._shaping.of_ends(info.get("final_info", info))[ended]
        return observations, shaped, terminated, truncated, info
