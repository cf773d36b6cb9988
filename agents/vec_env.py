"""Gymnasium's vector environments, native and wrapped, as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

import copy
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import Wrapper, spaces
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv, VectorRewardWrapper
from gymnasium.wrappers.vector import DictInfoToList, NormalizeReward, RescaleAction
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from agents.wrappers.vector import RepeatAction, ShapeReward, chain
from agents.wrappers.vector_infos import Info, single_infos
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene

Observations = NDArray[np.float32] | dict[str, NDArray[np.float32]]


class SB3VecEnv(VecEnv):
    """A vector environment of Gymnasium, with its wrappers, for the algorithms of Stable-Baselines3.

    Given the same seeds and actions it returns what `DummyVecEnv` returns over as many single environments in
    a `Monitor`, but steps all copies in one call. It needs neither `Monitor` nor `VecMonitor`. The
    differences:

    - Observations and their space are float32 whatever the environment's precision: networks compute in
      float32 anyway, and buffers, which take the space's type, need half the memory. Bounds are rounded as
      well, so rounded observations stay within them.
    - Infos are empty except at the end of an episode, unless you ask for those of every step: a hundred
      dictionaries of a dozen entries take longer than the physics, and no algorithm reads them. At its end an
      episode's info holds every entry of the environment's, `terminal_observation`, `episode` (return "r",
      length "l", seconds since this object was made "t") and `TimeLimit.truncated`.
    - The action space notes how `RescaleAction` inside maps actions: models that Stable-Baselines3 saves then
      fly without the wrapper, as `evaluate` and `export_policy` read it there.
    - Returns and lengths are those of the environment inside `agents.wrappers.vector.ShapeReward` and
      `RepeatAction`: they show rewards that are not shaped, and time steps, as a `Monitor` inside does.
      Gymnasium's wrappers of rewards count as part of the environment unless they are around one of these.

    Attributes:
        vector_env: The vector environment.
    """

    def __init__(
        self, vector_env: VectorEnv[Any, Any, Any], seed: int | None = None, *, step_infos: bool = False
    ) -> None:
        """Adapt a vector environment.

        Args:
            vector_env: The environment, in autoreset mode `SAME_STEP`.
            seed: Seed s, for seeds s, s + 1, ... of the copies at the first reset; an algorithm with a seed
                sets its own.
            step_infos: Whether infos are given at every step.

        Raises:
            TypeError: If infos are lists, as `DictInfoToList` makes them.
            ValueError: If the autoreset mode is another one.
        """
        mode = vector_env.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"vector_env: autoreset mode {mode}, should be AutoresetMode.SAME_STEP, as algorithms "
                "expect: give it to gymnasium.make_vec as autoreset_mode"
            )
        self.vector_env = vector_env
        self._chain = chain(vector_env)
        if any(isinstance(env, DictInfoToList) for env in self._chain):
            raise TypeError("vector_env: in DictInfoToList, whose work this class does itself: leave it out")
        self._given = frozenset(name for env in self._chain for name in dir(env))
        self._repeater = next((env for env in reversed(self._chain) if isinstance(env, RepeatAction)), None)
        space = _in_single_precision(vector_env.single_observation_space)
        VecEnv.__init__(self, vector_env.num_envs, space, _noted_actions(self._chain))
        # Recorders read how fast pictures follow.
        self.metadata = {**vector_env.metadata, **vars(self)["metadata"]}
        self._actions: NDArray[Any] | None = None
        self._step_infos = step_infos
        self._start_time = time.time()
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
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
            Observations, shape (num_envs, n_obs) or arrays by name, units as in the environment; infos are
            in `reset_infos`.

        Raises:
            ValueError: If an option is wrong.
        """
        begin: Any = self.vector_env.reset  # Gymnasium's own take a list of seeds too
        for options, mask in self._groups_of_options():
            # The last reset returns the observations of all copies.
            observations, info = begin(seed=self._seeds, options={**options, "reset_mask": mask})
            self._begin_episodes(np.flatnonzero(mask), info)
        self._reset_seeds()
        self._reset_options()
        seen: Observations = _single(observations)
        return seen

    def _begin_episodes(self, copies: NDArray[np.intp], info: Info) -> None:
        """Keep the infos of a reset of some copies, and restart their statistics."""
        for i, single_info in zip(copies.tolist(), single_infos(info, copies), strict=True):
            self.reset_infos[i] = single_info
        self._returns[copies] = 0.0
        self._lengths[copies] = 0

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
            actions: Actions of all copies, shape (num_envs, n_u), units of the action space.
        """
        self._actions = actions

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[Info]]:
        """Apply the actions; copies whose episode ends start the next one at once.

        Returns:
            Observations, shape (num_envs, n_obs) or arrays by name, of the new episode where one ended;
            rewards and ends of episodes, shape (num_envs,); infos, see the class.

        Raises:
            ResetNeeded: Before the first reset.
            RuntimeError: Before the first `step_async`.
            ValueError: If the actions have a wrong shape or a NaN.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        observations, rewards, terminated, truncated, info = self.vector_env.step(self._actions)
        dones = terminated | truncated
        self._returns += self._unshaped(rewards)
        self._lengths += 1 if self._repeater is None else self._repeater.steps_taken
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        if self._step_infos:
            going = np.flatnonzero(~dones)
            for i, single_info in zip(going.tolist(), single_infos(info, going), strict=True):
                infos[i] = {**single_info, "TimeLimit.truncated": False}
        if dones.any():
            self._end_episodes(np.flatnonzero(dones), truncated & ~terminated, info, infos)
        return _single(observations), rewards.astype(np.float32), dones, infos

    def _unshaped(self, rewards: NDArray[Any]) -> NDArray[Any]:
        """Rewards of the environment inside the innermost wrapper that changes them."""
        if self._repeater is not None:
            return self._repeater.collected
        shapers = (env for env in reversed(self._chain) if isinstance(env, ShapeReward))
        return next((env.unshaped for env in shapers), rewards)

    def _end_episodes(
        self, copies: NDArray[np.intp], truncated: NDArray[np.bool_], info: Info, infos: list[Info]
    ) -> None:
        """Fill the infos of copies whose episode ended, and start the next one."""
        elapsed = round(time.time() - self._start_time, 6)
        returns, lengths = self._returns[copies].tolist(), self._lengths[copies].tolist()
        last_infos = single_infos(info["final_info"], copies)
        for k, i in enumerate(copies.tolist()):
            infos[i] = last_infos[k]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i])
            infos[i]["terminal_observation"] = _single(info["final_obs"][i])
            infos[i]["episode"] = {"r": round(returns[k], 6), "l": lengths[k], "t": elapsed}
        self._begin_episodes(copies, info)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copy the running episodes with their statistics, to `set_state` it later or in another process.

        Returns:
            Arrays by name, see `DQSpaceArmVectorEnv.get_state`.

        Raises:
            AttributeError: If the environment cannot save states.
            ResetNeeded: Before the first reset.
        """
        home: Any = self.vector_env.unwrapped
        return {**home.get_state(), "returns": self._returns.copy(), "lengths": self._lengths.copy()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `get_state` was called.

        Args:
            state: Arrays of an environment with the same scene and `num_envs`.

        Raises:
            ValueError: If an array is missing, or has another shape or type.
        """
        for name in ("returns", "lengths"):
            values = np.asarray(state.get(name))
            if values.shape != (self.num_envs,) or values.dtype.kind not in "fiu":
                raise ValueError(f"state: {name} is missing, or not numbers of shape ({self.num_envs},)")
        home: Any = self.vector_env.unwrapped
        home.set_state(state)
        self._returns[:], self._lengths[:] = state["returns"], state["lengths"]

    def close(self) -> None:
        """Close the vector environment; closing twice is harmless."""
        self.vector_env.close()

    def get_images(self) -> list[NDArray[np.uint8]] | list[None]:
        """Draw every copy, RGB, shape (height, width, 3); without a render mode, warn and return None."""
        if self.render_mode is None:
            warnings.warn('There is nothing to render: use render_mode="rgb_array".', stacklevel=2)
            return [None] * self.num_envs
        pictures: Any = self.vector_env.render()
        return list(pictures or ())

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Read an attribute of the vector environment, which all copies share, once per copy in `indices`.

        Wrappers that lack it pass it on, and Gymnasium's own vector environments to their copies. Spaces are
        those of one copy, as in this class.
        """
        copies = self._checked(indices)
        if call := self._call_of_copies(attr_name):
            values = call("get_wrapper_attr", attr_name)
            return [values[i] for i in copies]
        home = self if attr_name in ("observation_space", "action_space") else self._home(attr_name)
        return [getattr(home, attr_name)] * len(copies)

    def _home(self, attr_name: str) -> Any:
        """The outermost wrapper with an attribute, or the environment."""
        return next((env for env in self._chain if hasattr(env, attr_name)), self.vector_env.unwrapped)

    def _call_of_copies(self, attr_name: str) -> Any:
        """`call` of Gymnasium's `SyncVectorEnv` or `AsyncVectorEnv` if only their copies have it, or None."""
        call = getattr(self.vector_env.unwrapped, "call", None)
        if call is None or any(hasattr(env, attr_name) for env in self._chain):
            return None
        # Asked first: a copy in another process ends with an error.
        return call if all(call("has_wrapper_attr", attr_name)) else None

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of your own on the vector environment, for all copies; `indices` must be all.

        What the environment is made with cannot be changed.
        """
        self._require_all(indices, f"attribute {attr_name!r}")
        if attr_name in self._given:
            raise AttributeError(
                f"attribute {attr_name!r} is fixed at construction: make another environment"
            )
        setattr(self.vector_env.unwrapped, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the vector environment once for all copies; `indices` must be all.

        Some alone may be asked for `compute_reward`, which depends on none of them, and which is refused in
        wrappers that change rewards. `reset` and `step` are refused: they would bypass the episode
        statistics.
        """
        if method_name != "compute_reward":
            self._require_all(indices, f"method {method_name!r}")
        if method_name in ("reset", "step"):
            raise ValueError(
                f"method {method_name!r} would bypass the episode statistics: "
                f"call that of {type(self).__name__}"
            )
        changing = [env for env in self._chain if isinstance(env, VectorRewardWrapper | NormalizeReward)]
        if method_name == "compute_reward" and changing:
            raise ValueError(
                f"method 'compute_reward' gives rewards without {type(changing[0]).__name__}: leave it out"
            )
        copies = self._checked(indices)
        if call := self._call_of_copies(method_name):
            results = call(method_name, *method_args, **method_kwargs)
            return [results[i] for i in copies]
        method = getattr(self._home(method_name), method_name)
        return [method(*method_args, **method_kwargs)] * len(copies)

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


class DQSpaceArmVecEnv(SB3VecEnv, EzPickle):
    """`num_envs` copies of `DQSpaceArm-v0` for the algorithms of Stable-Baselines3, see `SB3VecEnv`.

    `TimeLimit.truncated` is always False. The time left is observed and the terminal cost is part of the
    task, so the time limit is a true end: no value beyond it could be estimated.

    A pickled or deep-copied environment is rebuilt from its arguments; running episodes and seeds are not
    copied.

    Attributes:
        vector_env: The underlying `DQSpaceArmVectorEnv`.
    """

    observation_space: spaces.Box
    vector_env: DQSpaceArmVectorEnv

    def __init__(
        self,
        num_envs: int = 64,
        scene: Scene | str | Path = "paper",
        seed: int | None = None,
        *,
        step_infos: bool = False,
        **kwargs: Any,
    ) -> None:
        """Load a scene, and compile its step or take it from the cache.

        Args:
            num_envs: Number of copies.
            scene: Name of a shipped scene, path of a YAML file, or a scene.
            seed: Seed s, for seeds s, s + 1, ... of the copies at the first reset; an algorithm with a seed
                sets its own.
            step_infos: Whether infos are given at every step.
            **kwargs: Other arguments of `DQSpaceArmVectorEnv`, except the autoreset mode.

        Raises:
            SceneError: If the scene cannot be loaded.
            ValueError: If `DQSpaceArmVectorEnv` rejects an argument.
        """
        native = DQSpaceArmVectorEnv(num_envs, scene, autoreset_mode=AutoresetMode.SAME_STEP, **kwargs)
        EzPickle.__init__(self, num_envs, native.scene, seed, step_infos=step_infos, **kwargs)
        SB3VecEnv.__init__(self, native, seed, step_infos=step_infos)


def _noted_actions(chain: list[VectorEnv[Any, Any, Any]]) -> spaces.Space[Any]:
    """The action space, with the factors from its actions to those of the environment as an attribute."""
    space: spaces.Space[Any] = chain[0].single_action_space
    mapping = [env for env in chain if isinstance(env, VectorActionWrapper)]
    if not mapping or not isinstance(space, spaces.Box):
        return space
    noted: Any = copy.copy(space)
    others = [type(env).__name__ for env in mapping if not isinstance(env, RescaleAction)]
    ends = np.stack([np.resize(end, (chain[0].num_envs, *space.shape)) for end in (space.low, space.high)])
    for env in mapping:
        ends = np.stack([env.actions(end).copy() for end in ends])
    low, high = ends[:, 0].astype(np.float64)
    symmetric = np.array_equal(space.low, -space.high) and np.allclose(low, -high, rtol=1e-6, atol=0.0)
    if others or not symmetric:
        noted.environment_scale = ", ".join(others) or "RescaleAction to another middle"
    else:
        noted.environment_scale = (high / space.high).tolist()
    result: spaces.Space[Any] = noted
    return result


def _in_single_precision(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """The space with the bounds of its boxes of floats rounded to float32."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({name: _in_single_precision(part) for name, part in space.items()})
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
    return space


def _single(observations: Any) -> Any:
    """Observations with their floats rounded to float32."""
    if isinstance(observations, dict):
        return {name: _single(part) for name, part in observations.items()}
    if np.issubdtype(observations.dtype, np.floating):
        return observations.astype(np.float32, copy=False)
    return observations
