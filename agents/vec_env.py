"""The native vector environment behind Stable-Baselines3's `VecEnv`, statistics of episodes included."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Iterator
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

    It gives what `DummyVecEnv` gives over as many single environments in a `Monitor`, with the same seeds and
    actions, but steps all copies by one call of machine code. Neither `Monitor` nor `VecMonitor` is needed.
    Where it differs:

    - Observations and their space are float32, whatever the scene's precision. Networks compute in float32
      anyway, and buffers, which take the space's type, need half the memory. Rounding keeps order: what lies
      within the bounds still does when both are rounded.
    - Infos are empty except at the end of an episode: a hundred dictionaries of a dozen entries would take
      longer than the physics, and no algorithm reads them. At its end an episode's info has every entry of
      `DQSpaceArmEnv`'s, `terminal_observation`, `episode` (return "r", length "l", seconds since this object
      was made "t") and `TimeLimit.truncated`.
    - `TimeLimit.truncated` is False always. The time left is observed and the terminal cost is part of the
      task, so the end of the time is an end of the task: nothing follows whose value could be estimated.

    A pickled or deep-copied environment is made anew from the arguments, like a `DQSpaceArmEnv`: its episodes
    and seeds do not travel.

    Attributes:
        vector_env: The environment that does the work.
    """

    observation_space: spaces.Box

    def __init__(
        self, num_envs: int = 64, scene: Scene | str | Path = "paper", seed: int | None = None, **kwargs: Any
    ) -> None:
        """Load a scene and compile what a step needs (or take it from the cache).

        Args:
            num_envs: Number of copies.
            scene: Name of a shipped scene, path of a YAML file, or a scene.
            seed: Seed s for seeds s, s + 1, ... of the copies at the first reset. An algorithm that is given
                a seed sets its own.
            **kwargs: Further arguments of `DQSpaceArmVectorEnv`, except the autoreset mode.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If `DQSpaceArmVectorEnv` refuses an argument.
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
        self._first_steps = np.zeros(num_envs, dtype=np.int64)  # value of _step_count where an episode began
        self._returns = np.zeros(num_envs)
        if seed is not None:
            self.seed(seed)

    def set_options(self, options: list[Info] | Info | None = None) -> None:
        """Set the options of the next reset, of that one only.

        Args:
            options: As for `DQSpaceArmEnv.reset`, one dictionary for all copies or one for each. In one for
                all, "initial_state" may also have shape (num_envs, n_x), units of `kernels.layout.state`, and
                "target" shape (num_envs, 8); that is faster than a dictionary for each.

        Raises:
            ValueError: If the number of dictionaries is wrong, or one has a "reset_mask".
        """
        each = options if isinstance(options, list) else [options or {}] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(
                f"options: {len(each)} dictionaries, should be {self.num_envs}, one for each copy"
            )
        if any("reset_mask" in one for one in each):
            raise ValueError("options: reset_mask; here a reset is one of all copies, leave it out")
        super().set_options(each)

    def reset(self) -> Observations:
        """Begin new episodes of all copies, with the seeds and options that were set since the last reset.

        Returns:
            Observations, shape (num_envs, n_obs), units as in `DQSpaceArmEnv`. `reset_infos` has the infos.

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
        """Keep what a reset of some copies reports, and begin their statistics."""
        for i, single_info in zip(copies.tolist(), _single_infos(info, copies), strict=True):
            self.reset_infos[i] = single_info
        self._returns[copies] = 0.0
        self._first_steps[copies] = self._step_count

    def _groups_of_options(self) -> Iterator[tuple[Info, NDArray[np.bool_]]]:
        """Options, and a mask of the copies that have them: one pair where all copies have the same."""
        # A dictionary for all copies stands in the list many times; comparing would be no use for arrays.
        keys = np.array([id(options) if options else 0 for options in self._options])
        _, firsts = np.unique(keys, return_index=True)
        for first in firsts:
            yield self._options[first], keys == keys[first]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the step that `step_wait` makes.

        Args:
            actions: Inputs as fractions of their limits, shape (num_envs, n_u); clipped to [-1, 1].
        """
        self._actions = actions

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[Info]]:
        """Apply the actions for one time step; copies whose episode ends begin the next one at once.

        Returns:
            Observations, shape (num_envs, n_obs), of a new episode where one ended; rewards and whether an
            episode ended, shape (num_envs,); infos, see the class.

        Raises:
            ResetNeeded: Before the first reset.
            RuntimeError: Before the first `step_async`.
            ValueError: If the actions have a wrong shape or a NaN.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        # The environment never truncates: what terminated is what is done.
        observations, rewards, dones, _, info = self.vector_env.step(self._actions)
        self._step_count += 1
        self._returns += rewards
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        if "final_info" in info:
            self._end_episodes(np.flatnonzero(dones), info, infos)
        return observations.astype(np.float32, copy=False), rewards.astype(np.float32), dones, infos

    def _end_episodes(self, copies: NDArray[np.intp], info: Info, infos: list[Info]) -> None:
        """Fill the infos of copies whose episode ended, and begin the next one."""
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

    def close(self) -> None:
        """Close the vector environment; again is harmless."""
        self.vector_env.close()

    def get_images(self) -> list[NDArray[np.uint8]] | list[None]:
        """Draw the present state of every copy; with render mode None, warn that there is nothing to see.

        Returns:
            A picture for each copy, red, green, blue, shape (height, width, 3); None without a render mode.

        Raises:
            ResetNeeded: Before the first reset.
        """
        if self.render_mode is None:
            warnings.warn(
                'The environment draws nothing: make it with render_mode="rgb_array".', stacklevel=2
            )
            return [None] * self.num_envs
        return list(self.vector_env.render() or ())

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Read an attribute of the vector environment, which all copies share.

        Args:
            attr_name: Name of an attribute of `DQSpaceArmVectorEnv`, e.g. "scene". An observation or action
                space is that of one copy, as in this class.
            indices: Copies that are asked, all by default.

        Returns:
            The attribute, the same object for each copy that is asked.

        Raises:
            AttributeError: If there is no such attribute.
            IndexError: If there is no such copy.
        """
        home = self if attr_name in ("observation_space", "action_space") else self.vector_env
        return [getattr(home, attr_name)] * len(self._checked(indices))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Give the vector environment an attribute, for all copies.

        Args:
            attr_name: A name of your own; what an environment is made with stays as it is.
            value: Value of the attribute.
            indices: Copies that are addressed: all of them, the default.

        Raises:
            AttributeError: If the environment itself has an attribute of that name.
            ValueError: If some copies are not addressed.
        """
        self._require_all(indices, f"attribute {attr_name!r}")
        if attr_name in self._given:
            raise AttributeError(
                f"attribute {attr_name!r} is fixed when the environment is made: make another one"
            )
        setattr(self.vector_env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the vector environment once, for all copies together.

        Args:
            method_name: Name of a method of `DQSpaceArmVectorEnv`, other than `reset` and `step`.
            *method_args: Positional arguments.
            indices: Copies that are addressed: all of them, the default.
            **method_kwargs: Named arguments.

        Returns:
            What the method returned, the same object for each copy.

        Raises:
            AttributeError: If there is no such method.
            ValueError: If some copies are not addressed, or the method is `reset` or `step`, which would pass
                by the episodes' statistics.
        """
        self._require_all(indices, f"method {method_name!r}")
        if method_name in ("reset", "step"):
            raise ValueError(
                f"method {method_name!r} would pass by the episodes' statistics: "
                f"call that of {type(self).__name__}"
            )
        return [getattr(self.vector_env, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Tell whether the copies do what a wrapper does.

        Args:
            wrapper_class: Class of a wrapper.
            indices: Copies that are asked, all by default.

        Returns:
            True for `Monitor`, whose statistics the infos have: so `evaluate_policy` takes an episode's
            return from there, which is right even where `VecNormalize` changes rewards. False otherwise.
        """
        return [wrapper_class is Monitor] * len(self._checked(indices))

    def _checked(self, indices: int | Iterable[int] | None) -> list[int]:
        """Numbers of the copies that Stable-Baselines3 means; negative ones count from the end."""
        copies = range(self.num_envs)
        return [copies[i] for i in self._get_indices(indices)]

    def _require_all(self, indices: int | Iterable[int] | None, what: str) -> None:
        copies = self._checked(indices)
        if len(set(copies)) != self.num_envs:
            raise ValueError(
                f"{what} is shared by all {self.num_envs} copies and cannot be for copies {copies} alone: "
                "leave indices out"
            )


def _in_single_precision(space: spaces.Box) -> spaces.Box:
    """The box with its bounds rounded to float32."""
    return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)


def _single_infos(info: Info, copies: NDArray[np.intp]) -> list[Info]:
    """Infos of some copies, in Python's own numbers, from the vector environment's arrays."""
    names = [name for name in info if not name.startswith(("_", "final_"))]
    rows = zip(*(info[name][copies].tolist() for name in names), strict=True)
    return [dict(zip(names, row, strict=True)) for row in rows]
