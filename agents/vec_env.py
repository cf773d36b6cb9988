"""The native vector environment as a `VecEnv` of Stable-Baselines3, episode statistics included."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium import Wrapper, spaces
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from dq_space_arm_env import DQSpaceArmVectorEnv, Scene

Observations = NDArray[np.float32]
Info = dict[str, Any]


class DQSpaceArmVecEnv(VecEnv, EzPickle):
    """`num_envs` copies of `DQSpaceArm-v0` for the algorithms of Stable-Baselines3.

    Given the same seeds and actions it returns what `DummyVecEnv` returns over as many single environments in
    a `Monitor`, but steps all copies in one call of machine code. It needs neither `Monitor` nor
    `VecMonitor`. The differences:

    - Observations and their space are float32 whatever the scene's precision: networks compute in float32
      anyway, and buffers, which take the space's type, need half the memory. Bounds are rounded as well, so
      rounded observations stay within them.
    - Infos are empty except at the end of an episode: a hundred dictionaries of a dozen entries would take
      longer than the physics, and no algorithm reads them. At its end an episode's info holds every entry of
      `DQSpaceArmEnv`'s, `terminal_observation`, `episode` (return "r", length "l", seconds since this object
      was made "t") and `TimeLimit.truncated`.
    - `TimeLimit.truncated` is always False. The time left is observed and the terminal cost is part of the
      task, so the time limit is a true end: no value beyond it could be estimated.

    A pickled or deep-copied environment is rebuilt from its arguments, like a `DQSpaceArmEnv`; running
    episodes and seeds are not copied.

    Attributes:
        vector_env: The underlying `DQSpaceArmVectorEnv`.
    """

    observation_space: spaces.Box

    def __init__(
        self, num_envs: int = 64, scene: Scene | str | Path = "paper", seed: int | None = None, **kwargs: Any
    ) -> None:
        """Load a scene, and compile its step or take it from the cache.

        Args:
            num_envs: Number of copies.
            scene: Name of a shipped scene, path of a YAML file, or a scene.
            seed: Seed s, for seeds s, s + 1, ... of the copies at the first reset; an algorithm with a seed
                sets its own.
            **kwargs: Other arguments of `DQSpaceArmVectorEnv`, except the autoreset mode.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If `DQSpaceArmVectorEnv` rejects an argument.
        """
        EzPickle.__init__(self, num_envs, scene, seed, **kwargs)
        self.vector_env = DQSpaceArmVectorEnv(
            num_envs, scene, autoreset_mode=AutoresetMode.SAME_STEP, **kwargs
        )
        self._given = frozenset(dir(self.vector_env))
        observation_space = _in_single_precision(cast(spaces.Box, self.vector_env.single_observation_space))
        VecEnv.__init__(self, num_envs, observation_space, self.vector_env.single_action_space)
        self._actions: NDArray[Any] | None = None
        self._start_time = time.time()
        self._step_count = 0
        self._first_steps = np.zeros(num_envs, dtype=np.int64)  # _step_count when each episode started
        self._returns = np.zeros(num_envs)
        if seed is not None:
            self.seed(seed)

    def set_options(self, options: list[Info] | Info | None = None) -> None:
        """Set the options of the next reset only.

        Args:
            options: As for `DQSpaceArmEnv.reset`, one dictionary for all copies or one for each. In one for
                all, "initial_state" may also have shape (num_envs, n_x), units of `kernels.layout.state`, and
                "target" shape (num_envs, 8), which is faster than a dictionary for each.

        Raises:
            ValueError: If the number of dictionaries is wrong, or one has a "reset_mask".
        """
        each = options if isinstance(options, list) else [options or {}] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(
                f"options: {len(each)} dictionaries, should be {self.num_envs}, one for each copy"
            )
        if any("reset_mask" in one for one in each):
            raise ValueError("options: reset_mask: a reset here is of all copies, leave it out")
        super().set_options(each)

    def reset(self) -> Observations:
        """Start new episodes of all copies, with the seeds and options set since the last reset.

        Returns:
            Observations, shape (num_envs, n_obs), units as in `DQSpaceArmEnv`; infos are in `reset_infos`.

        Raises:
            ValueError: If an option is wrong.
        """
        observations = np.empty((self.num_envs, *self.observation_space.shape), dtype=np.float32)
        for options, mask in self._groups_of_options():
            seen, info = self.vector_env.reset(seed=self._seeds, options={**options, "reset_mask": mask})
            observations[mask] = seen[mask]
            copies = np.flatnonzero(mask)
            self._begin_episodes(copies, info)
        self._reset_seeds()
        self._reset_options()
        return observations

    def _begin_episodes(self, copies: NDArray[np.intp], info: Info) -> None:
        """Keep the infos of a reset of some copies, and restart their statistics."""
        for i, single_info in zip(copies.tolist(), _single_infos(info, copies), strict=True):
            self.reset_infos[i] = single_info
        self._returns[copies] = 0.0
        self._first_steps[copies] = self._step_count

    def _groups_of_options(self) -> Iterator[tuple[Info, NDArray[np.bool_]]]:
        """Pairs of options and a mask of the copies that share them."""
        # By identity: one dictionary for all copies repeats in the list, and arrays do not compare.
        keys = np.array([id(options) if options else 0 for options in self._options])
        _, firsts = np.unique(keys, return_index=True)
        for first in firsts:
            yield self._options[first], keys == keys[first]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Set the actions of the next `step_wait`.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].
        """
        self._actions = actions

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[Info]]:
        """Apply the actions for one time step; copies whose episode ends start the next one at once.

        Returns:
            Observations, shape (num_envs, n_obs), of the new episode where one ended; rewards and ends of
            episodes, shape (num_envs,); infos, see the class.

        Raises:
            ResetNeeded: Before the first reset.
            RuntimeError: Before the first `step_async`.
            ValueError: If the actions have a wrong shape or a NaN.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        # The environment never truncates: terminated is done.
        observations, rewards, dones, _, info = self.vector_env.step(self._actions)
        self._step_count += 1
        self._returns += rewards
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        if "final_info" in info:
            self._end_episodes(np.flatnonzero(dones), info, infos)
        return observations.astype(np.float32, copy=False), rewards.astype(np.float32), dones, infos

    def _end_episodes(self, copies: NDArray[np.intp], info: Info, infos: list[Info]) -> None:
        """Fill the infos of copies whose episode ended, and start the next one."""
        elapsed = round(time.time() - self._start_time, 6)
        returns = self._returns[copies].tolist()
        lengths = (self._step_count - self._first_steps[copies]).tolist()
        last_infos = _single_infos(info["final_info"], copies)
        for k, i in enumerate(copies.tolist()):
            infos[i] = last_infos[k]
            infos[i]["TimeLimit.truncated"] = False
            infos[i]["terminal_observation"] = info["final_obs"][i].astype(np.float32)
            infos[i]["episode"] = {"r": round(returns[k], 6), "l": lengths[k], "t": elapsed}
        self._begin_episodes(copies, info)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copy the running episodes with their statistics, to `set_state` it later or in another process.

        Returns:
            Arrays by name, see `DQSpaceArmVectorEnv.get_state`.

        Raises:
            ResetNeeded: Before the first reset.
        """
        lengths = self._step_count - self._first_steps
        return {**self.vector_env.get_state(), "returns": self._returns.copy(), "lengths": lengths}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `get_state` was called.

        Args:
            state: Arrays of an environment with the same scene and `num_envs`.

        Raises:
            ValueError: If an array is missing, or has another shape or type.
        """
        for name in ("returns", "lengths"):
            if name not in state or state[name].shape != (self.num_envs,):
                raise ValueError(f"state: {name} is missing, or not of shape ({self.num_envs},)")
        self.vector_env.set_state(state)
        self._returns[:] = state["returns"]
        self._first_steps = self._step_count - state["lengths"].astype(np.int64)

    def close(self) -> None:
        """Close the vector environment; closing twice is harmless."""
        self.vector_env.close()

    def get_images(self) -> list[NDArray[np.uint8]] | list[None]:
        """Draw every copy, RGB, shape (height, width, 3); without a render mode, warn and return None."""
        if self.render_mode is None:
            warnings.warn('There is nothing to render: use render_mode="rgb_array".', stacklevel=2)
            return [None] * self.num_envs
        return list(self.vector_env.render() or ())

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Read an attribute of the vector environment, which all copies share, once per copy in `indices`.

        Spaces are those of one copy, as in this class.
        """
        home = self if attr_name in ("observation_space", "action_space") else self.vector_env
        return [getattr(home, attr_name)] * len(self._checked(indices))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of your own on the vector environment, for all copies; `indices` must be all.

        What the environment is made with cannot be changed.
        """
        self._require_all(indices, f"attribute {attr_name!r}")
        if attr_name in self._given:
            raise AttributeError(
                f"attribute {attr_name!r} is fixed at construction: make another environment"
            )
        setattr(self.vector_env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the vector environment once for all copies; `indices` must be all.

        `reset` and `step` are refused: they would bypass the episode statistics.
        """
        self._require_all(indices, f"method {method_name!r}")
        if method_name in ("reset", "step"):
            raise ValueError(
                f"method {method_name!r} would bypass the episode statistics: "
                f"call that of {type(self).__name__}"
            )
        return [getattr(self.vector_env, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Report True for `Monitor`, whose statistics the infos contain, and False for other wrappers.

        `evaluate_policy` then takes returns from there, which are right even where `VecNormalize` changes
        rewards.
        """
        return [wrapper_class is Monitor] * len(self._checked(indices))

    def _checked(self, indices: int | Iterable[int] | None) -> list[int]:
        """Copies by number; negative ones count from the end."""
        copies = range(self.num_envs)
        return [copies[i] for i in self._get_indices(indices)]

    def _require_all(self, indices: int | Iterable[int] | None, what: str) -> None:
        copies = self._checked(indices)
        if len(set(copies)) != self.num_envs:
            raise ValueError(
                f"{what} is shared by all {self.num_envs} copies and cannot be set for {copies} alone: "
                "leave indices out"
            )


def _in_single_precision(space: spaces.Box) -> spaces.Box:
    """The box with its bounds rounded to float32."""
    return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)


def _single_infos(info: Info, copies: NDArray[np.intp]) -> list[Info]:
    """Infos of some copies as Python numbers, from the vector environment's arrays."""
    names = [name for name in info if not name.startswith(("_", "final_"))]
    columns = (
        _single_infos(each, copies) if isinstance(each := info[name], dict) else each[copies].tolist()
        for name in names
    )
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
