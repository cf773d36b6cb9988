"""What goal environments show, and the rewards of goals: alike for one environment and for many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.kernels import Kernels
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene import Scene

Array = NDArray[Any]
Observation = dict[str, Array]
Info = Mapping[str, Any]
RewardType = Literal["sparse", "dense"]


class Comparison(NamedTuple):
    """Distances of achieved from desired goals: arrays of the shape of the batch, () for a single pair."""

    attitude_error: Array  # deg
    position_error: Array  # m
    pose_cost: Array
    is_success: NDArray[np.bool_]


def show_goals(kernels: Kernels, x: Array, parameters: Array) -> Observation:
    """Observations of states (..., n_x) with the parameters (..., n_p) of their stages."""
    layout = kernels.layout
    seen = layout.goal_observation(x, parameters)
    goals = {"achieved_goal": kernels.tip_pose(x), "desired_goal": layout.target_with(parameters)}
    return {"observation": seen, **goals}


def _check_scene(scene: Scene) -> None:
    """Raise ValueError for a scene whose task is not one goal."""
    if scene.other_tips:
        raise ValueError(
            f"scene {scene.name!r} has tips besides the main one, and a goal is the pose of one tip: use "
            "DQSpaceArm-v0, or leave other_tips out"
        )
    if ending := [each.name for each in scene.constraints if each.terminates]:
        raise ValueError(
            f"constraint {ending[0]!r} of scene {scene.name!r} terminates episodes; where every step "
            "costs 1, ending early would pay: set terminates: false"
        )


class GoalRewards:
    """Compares goals in machine code, bit-equal for a pair alone and in a batch."""

    def __init__(self, kernels: Kernels, reward_type: RewardType) -> None:
        if reward_type not in get_args(RewardType):
            kinds = " and ".join(get_args(RewardType))
            raise ValueError(f"reward_type: {reward_type!r} is unknown; choose from {kinds}")
        _check_scene(kernels.scene)
        self._kernels, self._dense = kernels, reward_type == "dense"
        self._kernel = kernels.kernel("environment_goal")
        self._idle: list[KernelCall] = []  # threads never share one

    def compare(self, achieved: ArrayLike, desired: ArrayLike) -> Comparison:
        """Compare goals, shape (8,) or (B, 8)."""
        goals = [real_array("goals", goal, self._kernels.dtype) for goal in (achieved, desired)]
        if any(goal.shape[-1:] != (8,) for goal in goals):
            shapes = " and ".join(str(goal.shape) for goal in goals)
            raise ValueError(f"goals: shapes {shapes}, should be (8,) or (B, 8)")
        pairs = np.broadcast_arrays(*goals)
        batch = pairs[0].shape[:-1]
        rows = [np.ascontiguousarray(goal).reshape(-1, 8) for goal in pairs]
        errors, cost, success = np.empty((*batch, 2)), np.empty(batch), np.empty(batch, dtype=np.bool_)
        try:  # `pop` and `append` are atomic
            call = self._idle.pop()
        except IndexError:
            call = KernelCall(self._kernel, {})
        call.place(achieved=rows[0], desired=rows[1], errors=errors, cost=cost, is_success=success)
        call(len(rows[0]), self._kernels.threads)
        self._idle.append(call)
        return Comparison(errors[..., 0], errors[..., 1], cost, success)

    def of(self, comparison: Comparison, diverged: bool | NDArray[np.bool_]) -> Array:
        """Rewards of steps, of the shape of the batch."""
        steps = float(self._kernels.scene.simulation.steps)
        if self._dense:
            return np.where(diverged, steps, 1.0) * -comparison.pose_cost
        return np.where(diverged, -steps, np.where(comparison.is_success, 0.0, -1.0))


class ComputesRewards:
    """The reward of any goal, for environments that have `GoalRewards`."""

    _goals: GoalRewards

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: Info | Sequence[Info] | NDArray[Any] | None = None,
    ) -> float | Array:
        """Compute the reward of steps for any achieved and desired goals.

        Args:
            achieved_goal: Poses of the tip after the step, shape (8,) or (B, 8), real part dimensionless,
                dual part m.
            desired_goal: Goals, shape (8,) or (B, 8), real part dimensionless, dual part m.
            info: The step's info, one dictionary or a sequence of shape (B,); only "diverged" is read, False
                by default.

        Returns:
            Reward, dimensionless, a float or shape (B,).

        Raises:
            TypeError: If a goal is masked, or not of real numbers.
            ValueError: If the goals have wrong or different shapes, one is not finite or has a real part of
                zero, or there are not as many infos as goals.
        """
        comparison, diverged = self._goals.compare(achieved_goal, desired_goal), _diverged(info)
        _check_poses(comparison, achieved_goal=achieved_goal, desired_goal=desired_goal)
        if np.shape(diverged) not in ((), comparison.pose_cost.shape):
            shapes = (
                f"{np.shape(diverged)}, should be one dictionary or of shape {comparison.pose_cost.shape}"
            )
            raise ValueError(f"info: of shape {shapes}, as the goals are")
        rewards = self._goals.of(comparison, diverged)
        return rewards if rewards.ndim else float(rewards)


def _check_poses(comparison: Comparison, **goals: ArrayLike) -> None:
    """Raise ValueError for goals, shape (..., 8), that are no poses, as zeros of a buffer are none."""
    given = {name: np.asarray(values) for name, values in goals.items()}
    # Zeros have the attitude of any other goal; to look closer only then costs batches little.
    if comparison.attitude_error.all() and all(np.isfinite(rows).all() for rows in given.values()):
        return
    for name, rows in given.items():
        if not (np.isfinite(rows).all() and rows[..., :4].any(axis=-1).all()):
            raise ValueError(
                f"{name}: {shortened(rows)}, should be poses: finite numbers, with a real part other than 0"
            )


def _diverged(info: Info | Sequence[Info] | NDArray[Any] | None) -> bool | NDArray[np.bool_]:
    """Whether simulations diverged according to their infos."""
    if info is None:
        return False
    if isinstance(info, Mapping):
        return np.asarray(info.get("diverged", False), dtype=np.bool_)
    try:
        return np.array([bool(entry.get("diverged", False)) for entry in info])
    except (AttributeError, TypeError) as error:
        raise ValueError(f"info: {shortened(info)}, should be a dictionary, or one for each goal") from error
