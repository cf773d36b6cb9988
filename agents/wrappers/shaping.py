"""Parts that single and vector wrappers share: checked arguments, smaller boxes, shaped rewards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, NoReturn, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.common.real_arrays import real_array
from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.parameters import CONTROL_UNITS

ERRORS = ("attitude_error", "position_error", "angular_velocity_error", "velocity_error")
"""Of the tip at the end, in the order of the tolerances; velocities where success asks for them."""
HeldReward = Literal["sum", "last"]


def check_repeat(repeat: int, reward: str, discount: float) -> None:
    """Raise ValueError or TypeError unless these are arguments of `RepeatAction`."""
    if isinstance(repeat, bool) or not isinstance(repeat, int | np.integer) or repeat < 1:
        raise ValueError(f"repeat: {repeat!r}, should be a whole number of time steps, at least 1")
    if reward not in get_args(HeldReward):
        raise ValueError(f"reward: {reward!r}, should be 'sum' or 'last'")
    _check_number("discount", discount)
    if not 0.0 < discount <= 1.0:
        raise ValueError(f"discount: {discount!r}, should be above 0 and at most 1")


def _check_number(name: str, value: Any) -> None:
    """Raise TypeError for what is not one real number."""
    if real_array(name, value).shape:
        raise TypeError(f"{name}: {value!r}, should be one number")


def refuse_relabeling(*arguments: Any, **named: Any) -> NoReturn:
    """Stand in for the `compute_reward` inside a wrapper whose rewards it does not know."""
    raise ValueError(
        "compute_reward: it gives the reward of one time step, not sums or shaped rewards: leave ShapeReward "
        "out, and hold actions by RepeatAction(env, n, reward='last')"
    )


def held_metadata(metadata: dict[str, Any], repeat: int) -> dict[str, Any]:
    """Metadata of an environment whose pictures, one for each decision, are `repeat` time steps apart."""
    if "render_fps" not in metadata:
        return metadata
    return {**metadata, "render_fps": metadata["render_fps"] / repeat}


def shrunk(space: spaces.Space[Any], scene: Any, scale: ArrayLike | Mapping[str, float]) -> spaces.Box:
    """The box of an environment's actions with its bounds multiplied by `scale`, see `ShrinkActionSpace`."""
    if not isinstance(space, spaces.Box):
        raise TypeError(f"action space: {space}, should be a Box, whose bounds can be scaled")
    if isinstance(scale, Mapping) and not isinstance(scene, Scene):
        raise ValueError(
            f"scale: {scale!r}, should be numbers for an environment without a scene's actuators"
        )
    factors = (
        action_scale(scale, scene) if isinstance(scale, Mapping) else real_array("scale", scale, np.float32)
    )
    if factors.shape not in ((), space.shape) or not ((factors > 0.0) & (factors <= 1.0)).all():
        raise ValueError(
            f"scale: {scale!r}, should be numbers above 0 and at most 1: one, one for each of the "
            f"{space.shape[0]} actions, or a mapping by actuator"
        )
    return spaces.Box(space.low * factors, space.high * factors, dtype=np.float32)


def action_scale(scale: Mapping[str, float], scene: Scene) -> NDArray[np.float32]:
    """Expand the scale of each actuator to its inputs, shape (n_u,), fractions of the limits."""
    layout = StateLayout.of(scene)
    values, own = np.ones(layout.n_u, dtype=np.float32), actuators(scene)
    for name, value in scale.items():
        if name not in CONTROL_UNITS:
            close = did_you_mean(str(name), own)
            raise ValueError(f"scale: no actuator is named {name!r}; {close}choose from {', '.join(own)}")
        if name not in own:
            raise ValueError(f"scale: scene {scene.name!r} has no {name}; choose from {', '.join(own)}")
        _check_number(f"scale of {name}", value)
        values[getattr(layout.control, name)] = value
    return values


def actuators(scene: Scene) -> list[str]:
    """Names of the actuators that a scene has."""
    control = StateLayout.of(scene).control
    return [name for name in CONTROL_UNITS if (part := getattr(control, name)).stop > part.start]


class Shaping(NamedTuple):
    """Settings of `ShapeReward`, and its formulas."""

    scale: float
    power: float
    success_reward: float
    end_error_cost: float
    tolerances: Sequence[float | None]  # of ERRORS; None for those that do not count

    @classmethod
    def checked(
        cls,
        scene: Any,
        *,
        scale: float,
        power: float,
        success_reward: float,
        end_error_cost: float,
    ) -> Shaping:
        """Check the arguments of `ShapeReward`; ValueError or TypeError for those that are wrong."""
        ends = {"success_reward": success_reward, "end_error_cost": end_error_cost}
        for name, value in {"scale": scale, "power": power, **ends}.items():
            _check_number(name, value)
        if not (np.isfinite(scale) and scale > 0.0):
            raise ValueError(f"scale: {scale!r}, should be a positive number")
        if not 0.0 < power <= 1.0:
            raise ValueError(f"power: {power!r}, should be above 0 and at most 1, the reward itself")
        for name, value in ends.items():
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: {value!r}, should be a number of at least 0")
        tolerances: tuple[float | None, ...] = ()
        if end_error_cost:
            if not isinstance(scene, Scene):
                raise ValueError(
                    f"end_error_cost: {end_error_cost!r}, should be 0 for an environment without a scene, "
                    "whose tolerances it needs"
                )
            wanted = scene.success
            tolerances = (
                wanted.attitude_error_deg,
                wanted.position_error,
                wanted.angular_velocity_error_deg,
                wanted.velocity_error,
            )
        return cls(scale, power, success_reward, end_error_cost, tolerances)

    def steps_left(self, env: Any) -> int | NDArray[np.int64] | None:
        """Time steps that the episodes of an environment still have; None where nothing depends on them."""
        if self.power == 1.0 or not isinstance(scene := getattr(env, "scene", None), Scene):
            return None
        left: int | NDArray[np.int64] = scene.simulation.steps - env.elapsed_steps
        return left

    def of_steps(self, rewards: ArrayLike, steps: ArrayLike) -> NDArray[np.float32]:
        """Power and scale of rewards, shape (B,), of so many time steps each."""
        values = np.asarray(rewards)
        if self.power != 1.0:
            # sign(r) n |r / n|^p, with the mean r / n of the n steps.
            values = np.sign(values) * steps * np.abs(values / steps) ** self.power
        return np.asarray(self.scale * values, dtype=np.float32)

    def of_ends(self, info: Mapping[str, Any]) -> NDArray[np.float32]:
        """Rewards of the ends of episodes, shape (B,), from columns of their last infos."""
        if "is_success" not in info:
            raise ValueError(
                f"success_reward: {self.success_reward!r}, should be 0: the environment's info has no "
                "is_success at the end of an episode"
            )
        earned = self.success_reward * np.asarray(info["is_success"], dtype=np.float64)
        if self.end_error_cost:
            limits = zip(ERRORS, self.tolerances, strict=True)
            squares = ((np.asarray(info[name]) / limit) ** 2 for name, limit in limits if limit is not None)
            errors = np.asarray(sum(squares, start=np.zeros(earned.shape)))
            # e / (1 + e) is bounded: a few stray flights would dominate the critic.
            earned = earned - self.end_error_cost * (errors / (1.0 + errors))
        return np.asarray(earned, dtype=np.float32)

    @property
    def counts_ends(self) -> bool:
        """Whether the end of an episode changes its reward."""
        return bool(self.success_reward or self.end_error_cost)
