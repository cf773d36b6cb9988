"""Corrections of plans as a vector environment for Stable-Baselines3."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from agents.configuration.residual import Mismatch
from agents.evaluation.plans import FloatArray, Followed, Plans
from agents.residual.corrections import CorrectionObserver, corrected
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from dq_space_arm_env.environment.disturbances import Disturbances, with_loads
from experts.demonstrations import Demonstrations

Info = dict[str, Any]


class ResidualVecEnv(VecEnv):
    """Episodes in which a plan flies with its gains, and actions correct it.

    Each episode starts where a demonstration does, and follows its plan; masses differ from the plan's,
    measurements are noisy, and there are pushes. Each has a twin with the same masses, noise and pushes that
    flies the plan with its gains alone: the reward of a step is the cost of the twin minus the cost of the
    corrected flight. This cancels much of the luck, and a policy that corrects nothing has rewards of zero.

    An action is a correction, in fractions of limits, within `action_space`; observations are those of
    `CorrectionObserver`. All episodes begin and end together. At the end, an episode's info has `episode`, as
    of SB3's `Monitor`, `cost` and `twin_cost`.
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
        """Set up.

        Args:
            demonstrations: Plans that episodes follow, drawn with equal probability.
            scene: Their scene.
            copies: Number of episodes side by side.
            mismatch: Distribution of masses, noise and pushes; episodes share the masses evenly.
            action_scale: Largest corrections, shape (n_u,), fractions of limits.
            memory: Time constant of the averaged deviation, s.
            full_authority: Size of the averaged deviation at which corrections count in full.
            cost_power: Power of the cost of a step in rewards.
            seed: Seed of everything random; None for an unpredictable one.

        Raises:
            ValueError: If the scene has no masses to change.
        """
        # The corrected flights and, after them, their twins: one batch is faster.
        self._factors = np.tile(np.resize(np.array(mismatch.mass_factors), copies), 2)
        self._worlds = DQSpaceArmVectorEnv(2 * copies, with_loads(scene, self._factors)[0])
        self._plans, self._scene, self._mismatch = Plans.of(demonstrations), scene, mismatch
        self._scale, self._power = np.asarray(action_scale, dtype=np.float64), cost_power
        self._observer = CorrectionObserver(scene, memory, full_authority)
        self._rng = np.random.default_rng(seed)
        self._actions: NDArray[Any] | None = None
        size = CorrectionObserver.size(self._worlds.kernels)
        super().__init__(
            copies,
            spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32),
            spaces.Box(-action_scale, action_scale, dtype=np.float32),
        )

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Renew the random generator of all episodes."""
        self._rng = np.random.default_rng(seed)
        return [seed] * self.num_envs

    def reset(self) -> NDArray[np.float32]:
        """Begin new episodes; returns observations, shape (num_envs, n_obs)."""
        mismatch, count = self._mismatch, self.num_envs
        chosen = self._rng.integers(len(self._plans.states), size=count)
        self._plans = self._plans.choose(np.tile(chosen, 2))
        noise, push = self._rng.random((2, count))
        self._disturb(mismatch.noise * noise, mismatch.push * push)
        _, parameters = with_loads(self._scene, self._factors, self._plans.known)
        # What diverges restarts at the next step, in some other world, and is not counted.
        self._worlds.reset(options={"initial_state": self._plans.starts, "parameters": parameters})
        self._stage, self._cost, self._returns = 0, np.zeros(2 * count), np.zeros(count)
        self._flying, self._success = np.ones(2 * count, dtype=np.bool_), np.zeros(2 * count, dtype=np.bool_)
        self._observer.reset(self._plans.known[:count])
        return self._observe()

    def _disturb(self, noise: FloatArray, push: FloatArray) -> None:
        """Disturb the episodes from now on, standard deviations of shape (num_envs,)."""
        self._noise, self._push = noise, push
        self._disturbances = Disturbances(
            self._scene, self._rng, push=push, pushes=self._mismatch.pushes, measurement=noise
        )

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copy the running episodes, to `set_state` it later or in another process.

        Returns:
            Arrays by name.
        """
        own = {
            "chosen": self._plans.chosen,
            "noise": self._noise,
            "push": self._push,
            "stage": self._stage,
            "cost": self._cost,
            "returns": self._returns,
            "flying": self._flying,
            "success": self._success,
            "uncorrected": self._uncorrected,
            "average": self._observer.average,
            "generator": json.dumps(self._rng.bit_generator.state),
        }
        worlds = {f"worlds.{name}": array for name, array in self._worlds.get_state().items()}
        return {**worlds, **{name: np.array(value) for name, value in own.items()}}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `get_state` of an environment with the same arguments was called.

        Args:
            state: Arrays by name.

        Raises:
            KeyError: If an array is missing.
            ValueError: If an array has a wrong shape or type.
        """
        prefix = "worlds."
        self._worlds.set_state(
            {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}
        )
        self._rng.bit_generator.state = json.loads(str(state["generator"]))
        self._plans = self._plans.choose(state["chosen"])
        self._disturb(state["noise"], state["push"])
        self._stage = int(state["stage"])
        self._cost, self._returns = state["cost"].copy(), state["returns"].copy()
        self._flying, self._success = state["flying"].copy(), state["success"].copy()
        self._uncorrected = state["uncorrected"].copy()
        self._observer.reset(self._plans.known[: self.num_envs])
        self._observer.average = state["average"].copy()

    def _observe(self) -> NDArray[np.float32]:
        """Disturb flights and twins alike, and compute the plans' actions."""
        draw, count, kernels = self._disturbances.draw(), self.num_envs, self._worlds.kernels
        assert draw.push is not None
        assert draw.measurement is not None
        self._worlds.perturb(np.tile(draw.push, (2, 1)))
        measured = kernels.retract(self._worlds.states, np.tile(draw.measurement, (2, 1)))
        followed = self._plans.follow(kernels, self._stage, measured)
        self._uncorrected = followed.action
        few = Followed(*(part[:count] for part in followed))
        return self._observer(self._stage, measured[:count], few)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Set the corrections of the next step, fractions of limits, clipped to the action space."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[Info]]:
        """Fly one time step; after the last one the next episodes begin at once.

        Raises:
            RuntimeError: Before the first `step_async`.
        """
        if self._actions is None:
            raise RuntimeError("call step_async() before step_wait()")
        count, actions = self.num_envs, self._uncorrected.copy()
        actions[:count] = corrected(actions[:count], self._actions, self._scale, self._observer.authority())
        charged = self._charged(actions)
        rewards = charged[count:] - charged[:count]
        self._returns += rewards
        over = self._stage == self._scene.simulation.steps
        infos: list[Info] = [{} for _ in range(count)]
        if over:
            self._describe(infos)
        observations = self.reset() if over else self._observe()
        return observations, rewards.astype(np.float32), np.full(count, over), infos

    def _charged(self, actions: FloatArray) -> FloatArray:
        """Fly a time step, and give its costs as they count in rewards, shape (2 num_envs,)."""
        _, rewards, terminated, _, info = self._worlds.step(actions)
        cost, ending = np.where(self._flying, -rewards, 0.0), self._flying & terminated
        self._cost += cost
        left: Any = 1
        if ending.any():
            self._success |= ending & info["is_success"]
            self._flying &= ~terminated
            # A flight that diverges is charged at once for all steps that are left.
            left = np.where(ending, self._scene.simulation.steps - self._stage, 1)
        self._stage += 1
        return np.asarray(left * (cost / left) ** self._power)

    def _describe(self, infos: list[Info]) -> None:
        for i, info in enumerate(infos):
            steps = self._scene.simulation.steps
            info["episode"] = {"r": float(self._returns[i]), "l": steps, "t": 0.0}
            info["cost"], info["twin_cost"] = self._cost[[i, i + self.num_envs]].tolist()
            info["is_success"] = bool(self._success[i])
            info["TimeLimit.truncated"] = False

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute, which all episodes share."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all episodes."""
        self._require_all(indices)
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once, for all episodes."""
        self._require_all(indices)
        return [getattr(self, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """No episode has a Gymnasium wrapper."""
        return [False] * len(list(self._get_indices(indices)))

    def _require_all(self, indices: VecEnvIndices) -> None:
        if isinstance(indices, Iterable) and len(set(indices)) == self.num_envs:
            return
        if indices is not None:
            raise ValueError(
                f"indices: {indices}, should be left out: all {self.num_envs} episodes share attributes"
            )
