"""Corrections of plans as a vector environment of Gymnasium."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from agents.configuration.schema import Mismatch
from agents.demonstrations import fingerprint
from agents.evaluation.plans import FloatArray, Followed, Plans
from agents.residual.corrections import CorrectionObserver, corrected
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene
from dq_space_arm_env.environment.disturbances import Disturbances, displaced, with_loads
from experts.demonstrations import Demonstrations

Info = dict[str, Any]
Mask = NDArray[np.bool_]


class ResidualVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """Episodes in which a plan flies with its gains, and actions correct it.

    Each episode starts where a demonstration does, and follows its plan; masses differ from the plan's,
    measurements are noisy, and there are pushes. Each has a twin with the same masses, noise and pushes that
    flies the plan with its gains alone: the reward of a step is the cost of the twin minus the cost of the
    corrected flight. This cancels much of the luck, and a policy that corrects nothing has rewards of zero.

    An action is a correction, in fractions of limits, within `action_space`; observations are those of
    `CorrectionObserver`. All episodes begin and end together, and the next ones begin in the same step. At
    the end, an episode's info has `cost`, `twin_cost` and `is_success`; it is empty before.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

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
        self._origin = f"{demonstrations.manifest['settings_sha256']} {fingerprint(demonstrations)}"
        self._plans, self._scene, self._mismatch = Plans.of(demonstrations), scene, mismatch
        self._scale, self._power = np.asarray(action_scale, dtype=np.float64), cost_power
        self._observer = CorrectionObserver(scene, memory, full_authority)
        self._rng, self._seed = np.random.default_rng(seed), seed
        self.num_envs = copies
        size = CorrectionObserver.size(self._worlds.kernels)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)
        self.single_action_space = spaces.Box(-action_scale, action_scale, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, copies)
        self.action_space = batch_space(self.single_action_space, copies)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """Begin new episodes, all together.

        Args:
            seed: Seed of everything random, or a sequence whose first number is; None keeps the generator.
            options: None, or a "reset_mask" that is True for all.

        Returns:
            Observations, shape (num_envs, n_obs), and an empty info.

        Raises:
            ValueError: If an option is another one.
        """
        asked = dict(options or {})
        if not np.all(asked.pop("reset_mask", True)) or asked:
            raise ValueError(f"options: {options}, should be None: all episodes begin together, at random")
        first = seed if seed is None or isinstance(seed, int | np.integer) else seed[0]
        if first is not None:
            self._rng, self._seed = np.random.default_rng(first), first
        return self._begin(), {}

    def _begin(self) -> NDArray[np.float32]:
        """Draw plans, masses and disturbances, and observe."""
        mismatch, count = self._mismatch, self.num_envs
        chosen = self._rng.integers(len(self._plans.states), size=count)
        self._plans = self._plans.choose(np.tile(chosen, 2))
        noise, push = self._rng.random((2, count))
        self._disturb(mismatch.noise * noise, mismatch.push * push)
        _, parameters = with_loads(self._scene, self._factors, self._plans.known)
        # What diverges restarts at the next step, in some other world, and is not counted, but observed.
        start = {"initial_state": self._plans.starts, "parameters": parameters}
        self._worlds.reset(seed=self._seed, options=start)
        self._seed = None  # the next episodes keep the generators
        self._stage, self._cost = 0, np.zeros(2 * count)
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
            "plans": self._origin,
            "chosen": self._plans.chosen,
            "noise": self._noise,
            "push": self._push,
            "stage": self._stage,
            "cost": self._cost,
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
            ValueError: If an array has a wrong shape or type, or the state is of episodes with other plans.
        """
        origin = str(state.get("plans", self._origin))  # earlier states do not tell
        if origin != self._origin:
            raise ValueError(f"plans: of demonstrations {origin}, should be of those given, {self._origin}")
        prefix = "worlds."
        self._worlds.set_state(
            {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}
        )
        self._rng.bit_generator.state = json.loads(str(state["generator"]))
        self._plans = self._plans.choose(state["chosen"])
        self._disturb(state["noise"], state["push"])
        self._stage = int(state["stage"])
        self._cost = state["cost"].copy()
        self._flying, self._success = state["flying"].copy(), state["success"].copy()
        self._uncorrected = state["uncorrected"].copy()
        self._observer.reset(self._plans.known[: self.num_envs])
        self._observer.average = state["average"].copy()
        self._seed = None  # the worlds' generators are those of the state

    def _observe(self) -> NDArray[np.float32]:
        """Disturb flights and twins alike, and compute the plans' actions."""
        draw, count, kernels = self._disturbances.draw(), self.num_envs, self._worlds.kernels
        assert draw.push is not None
        assert draw.measurement is not None
        self._worlds.perturb(np.tile(draw.push, (2, 1)))
        measured = displaced(kernels, self._worlds.states, np.tile(draw.measurement, (2, 1)))
        followed = self._plans.follow(kernels, self._stage, measured)
        self._uncorrected = followed.action
        few = Followed(*(part[:count] for part in followed))
        return self._observer(self._stage, measured[:count], few)

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], FloatArray, Mask, Mask, Info]:
        """Fly one time step; after the last one the next episodes begin at once.

        Args:
            actions: Corrections, fractions of limits, shape (num_envs, n_u), clipped to the action space.

        Returns:
            Observations, rewards, terminated, truncated (always False), info.
        """
        count, applied = self.num_envs, self._uncorrected.copy()
        applied[:count] = corrected(applied[:count], actions, self._scale, self._observer.authority())
        charged = self._charged(applied)
        over = self._stage == self._scene.simulation.steps
        info = self._ending() if over else {}
        observations = self._begin() if over else self._observe()
        ended, truncated = np.full(count, over), np.zeros(count, dtype=np.bool_)
        return observations, charged[count:] - charged[:count], ended, truncated, info

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

    def _ending(self) -> Info:
        """Last observations, undisturbed, and infos of episodes that are over."""
        count, kernels, everyone = self.num_envs, self._worlds.kernels, np.ones(self.num_envs, dtype=np.bool_)
        flown = self._plans.choose(self._plans.chosen[:count])
        states = self._worlds.states[:count]
        deviation = kernels.difference(flown.states[flown.chosen, self._stage], states)
        idle = np.zeros((count, kernels.n_u))
        last = np.empty(count, dtype=object)
        last[:] = list(self._observer(self._stage, states, Followed(idle, deviation)))
        found = {
            "cost": self._cost[:count],
            "twin_cost": self._cost[count:],
            "is_success": self._success[:count],
        }
        masked = found | {f"_{name}": everyone for name in found}
        return {"final_obs": last, "final_info": masked, "_final_obs": everyone, "_final_info": everyone}
