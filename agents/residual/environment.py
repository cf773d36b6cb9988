"""Correcting plans as a vector environment for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from agents.configuration.residual import Mismatch
from agents.plans import FloatArray, Followed, Plans
from agents.residual.controllers import Sight, corrected
from agents.residual.worlds import Disturbance, Disturbances, Worlds
from dq_space_arm_env import Scene
from experts.demonstrations import Demonstrations

Info = dict[str, Any]


class ResidualVecEnv(VecEnv):
    """Copies of an episode in which a plan flies with its gains, and the actions correct it.

    Each episode begins where a demonstration does, whose plan is followed; the world has other masses than
    the plan, measurements are noisy, and there are pushes. A twin of each copy, in the same world, with the
    same noise and the same pushes, is left to the plan with its gains alone: the reward of a step is what it
    costs the twin minus what it costs the copy. So much of the luck cancels, and a policy that corrects
    nothing has rewards of zero.

    An action is a correction, in fractions of limits, within `action_space`; observations are those of
    `Sight`. Episodes of all copies begin and end together. At its end an episode's info has `episode`, as of
    SB3's `Monitor`, `cost` and `twin_cost`.
    """

    observation_space: spaces.Box
    action_space: spaces.Box
    render_mode: None = None

    def __init__(
        self,
        demonstrations: Demonstrations,
        scene: Scene,
        copies: int,
        *,
        mismatch: Mismatch,
        action_scale: NDArray[np.float32],
        memory: float,
        full_authority: float,
        cost_power: float = 1.0,
        seed: int | None = None,
    ) -> None:
        """Make the copies.

        Args:
            demonstrations: Plans that episodes follow, each chosen with equal probability.
            scene: The scene that they are for.
            copies: How many.
            mismatch: How worlds differ from the plans'; copies share the masses evenly.
            action_scale: Largest corrections, shape (n_u,), fractions of limits.
            memory: Time over which deviations are averaged, s.
            full_authority: Size of the averaged deviation at which corrections count in full.
            cost_power: Power of the cost of a step in rewards.
            seed: Of everything random; None for an unpredictable one.

        Raises:
            ValueError: If the scene has no masses that could be others.
        """
        factors = np.resize(np.array(mismatch.mass_factors), copies)
        # In one batch, which is faster: the copies, and after them their twins.
        self._worlds = Worlds(scene, np.tile(factors, 2).tolist())
        self._plans, self._scene, self._mismatch = Plans.of(demonstrations), scene, mismatch
        self._scale, self._power = np.asarray(action_scale, dtype=np.float64), cost_power
        self._sight = Sight(scene, memory, full_authority)
        self._rng = np.random.default_rng(seed)
        self._actions: NDArray[Any] | None = None
        size = Sight.size(self._worlds.kernels)
        super().__init__(
            copies,
            spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32),
            spaces.Box(-action_scale, action_scale, dtype=np.float32),
        )

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Renew the random generator.

        Args:
            seed: For all copies together.

        Returns:
            The seed for each copy.
        """
        self._rng = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def reset(self) -> NDArray[np.float32]:
        """Begin new episodes of all copies.

        Returns:
            Observations, shape (num_envs, n_obs).
        """
        mismatch, count = self._mismatch, self.num_envs
        chosen = self._rng.integers(len(self._plans.states), size=count)
        self._plans = self._plans.choose(np.tile(chosen, 2))
        noise, push = (largest * self._rng.random(count) for largest in (mismatch.noise, mismatch.push))
        self._disturbances = Disturbances(self._scene, noise, push, mismatch.pushes, self._rng)
        self._flight = self._worlds.begin(self._plans.starts)
        self._returns = np.zeros(count)
        self._sight.begin()
        return self._look()

    def _look(self) -> NDArray[np.float32]:
        """Let the present stage's disturbance happen to copies and twins, and see what plans ask for."""
        draw, stage, count = self._disturbances.draw(), self._flight.stage, self.num_envs
        measured = self._flight.measure(Disturbance(*(np.tile(part, (2, 1)) for part in draw)))
        followed = self._plans.follow(self._worlds.kernels, stage, measured)
        self._uncorrected: FloatArray = followed.action
        return self._sight(stage, measured[:count], Followed(*(part[:count] for part in followed)))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the corrections of the step that `step_wait` makes.

        Args:
            actions: Fractions of limits, shape (num_envs, n_u); clipped to the action space.
        """
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[Info]]:
        """Fly one time step; after the last one the next episodes begin at once.

        Returns:
            Observations, shape (num_envs, n_obs), of new episodes where they ended; rewards and whether
            episodes ended, shape (num_envs,); infos, empty but at the end.

        Raises:
            RuntimeError: Before the first `step_async`.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        count, actions = self.num_envs, self._uncorrected.copy()
        actions[:count] = corrected(actions[:count], self._actions, self._scale, self._sight.authority())
        cost = self._flight.act(actions) ** self._power
        rewards = cost[count:] - cost[:count]
        self._returns += rewards
        over = self._flight.stage == self._scene.simulation.steps
        infos: list[Info] = [{} for _ in range(self.num_envs)]
        if over:
            self._describe(infos)
        observations = self.reset() if over else self._look()
        return observations, rewards.astype(np.float32), np.full(self.num_envs, over), infos

    def _describe(self, infos: list[Info]) -> None:
        success, length = self._flight.is_success(), self._scene.simulation.steps
        for i, info in enumerate(infos):
            info["episode"] = {"r": float(self._returns[i]), "l": length, "t": 0.0}
            info["cost"], info["twin_cost"] = self._flight.cost[[i, i + self.num_envs]].tolist()
            info["is_success"] = bool(success[i])
            info["TimeLimit.truncated"] = False

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Read an attribute, which all copies share.

        Args:
            attr_name: Its name.
            indices: Copies that are asked, all by default.

        Returns:
            The attribute, for each copy that is asked.

        Raises:
            AttributeError: If there is no such attribute.
        """
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute, for all copies.

        Args:
            attr_name: Its name.
            value: Its value.
            indices: All copies, the default.

        Raises:
            ValueError: If only some copies are meant.
        """
        self._require_all(indices)
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once, for all copies.

        Args:
            method_name: Its name.
            *method_args: Positional arguments.
            indices: All copies, the default.
            **method_kwargs: Named arguments.

        Returns:
            What it returned, for each copy.

        Raises:
            ValueError: If only some copies are meant.
        """
        self._require_all(indices)
        return [getattr(self, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Tell whether copies are in a wrapper of Gymnasium.

        Args:
            wrapper_class: Its class.
            indices: Copies that are asked, all by default.

        Returns:
            False for each.
        """
        return [False] * len(list(self._get_indices(indices)))

    def _require_all(self, indices: VecEnvIndices) -> None:
        if isinstance(indices, Iterable) and len(set(indices)) == self.num_envs:
            return
        if indices is not None:
            raise ValueError(f"copies {indices}: all {self.num_envs} share what they have, leave indices out")
