"""Disturbances of episodes: pushes, noise on measurements and inputs, masses other than the model's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv
from dq_space_arm_env.kernels import compile_scene
from dq_space_arm_env.scene import Scene, StateLayout

FloatArray = NDArray[np.float64]


class Disturbance(NamedTuple):
    """What disturbs B episodes in one time step; None for nothing."""

    push: FloatArray | None = None  # jump of the state in tangent coordinates, shape (B, n_t)
    measurement: FloatArray | None = (
        None  # noise on the measured state in tangent coordinates, shape (B, n_t)
    )
    inputs: FloatArray | None = None  # noise on the actions, fractions of the limits, shape (B, n_u)


class Disturbances:
    """Random pushes and noise for B episodes, drawn step by step.

    Draws depend on the generator alone: with equal generators all controllers meet the same disturbances.

    Args:
        scene: The scene.
        rng: Source of random numbers.
        push: Standard deviation of the jumps of the base's velocities, shape () or (B,), rad/s and m/s; None
            for no pushes.
        pushes: Mean number of pushes in an episode.
        evenly: Whether pushes come at even intervals instead of at random times.
        measurement: Standard deviation of the noise on every tangent coordinate, shape () or (B,), rad, m,
            rad/s and m/s; None for no noise.
        inputs: Standard deviation of the noise on the inputs, shape () or (B,), fractions of the limits; None
            for no noise.
        count: B, if no standard deviation tells it.
    """

    def __init__(
        self,
        scene: Scene,
        rng: np.random.Generator,
        *,
        push: ArrayLike | None = None,
        pushes: float = 0.0,
        evenly: bool = False,
        measurement: ArrayLike | None = None,
        inputs: ArrayLike | None = None,
        count: int = 1,
    ) -> None:
        layout, steps = StateLayout.of(scene), scene.simulation.steps
        self._rng, self._step = rng, 0
        self._n_t, self._n_u, self._velocity = layout.n_t, layout.n_u, layout.tangent.base_velocity
        sizes = [np.size(sigma) for sigma in (push, measurement, inputs) if sigma is not None]
        self.count = max([count, *sizes])
        self._push, self._measurement, self._inputs = (
            None if sigma is None else self._column(sigma) for sigma in (push, measurement, inputs)
        )
        self._probability = pushes / steps
        self._interval = max(steps // int(pushes + 1), 1) if evenly else 0

    def _column(self, sigma: ArrayLike) -> FloatArray:
        """A standard deviation for each episode, shape (B, 1)."""
        return np.broadcast_to(np.asarray(sigma, dtype=np.float64), (self.count,))[:, None]

    def draw(self) -> Disturbance:
        """Draw the disturbances of the next step."""
        push, measurement, inputs = self._draw_push(), None, None
        if self._measurement is not None:
            measurement = self._measurement * self._rng.standard_normal((self.count, self._n_t))
        if self._inputs is not None:
            inputs = self._inputs * self._rng.standard_normal((self.count, self._n_u))
        self._step += 1
        return Disturbance(push, measurement, inputs)

    def _draw_push(self) -> FloatArray | None:
        if self._push is None:
            return None
        if not self._interval:
            struck = self._rng.random((self.count, 1)) < self._probability
        elif self._step % self._interval == self._interval - 1:
            struck = np.ones((self.count, 1), dtype=np.bool_)
        else:
            return None
        push = np.zeros((self.count, self._n_t))
        strength = self._rng.standard_normal(push[:, self._velocity].shape)
        push[:, self._velocity] = np.where(struck, self._push * strength, 0.0)
        return push


class MassMismatchVectorEnv:
    """B episodes of a scene whose masses differ from the scene's, one native vector environment per factor.

    It has what `rollout` needs of a `DQSpaceArmVectorEnv`; episodes begin at given states.

    Attributes:
        scene: The nominal scene.
        kernels: Its functions.
        mass_factors: Factor of mass and inertia of the payload, or of the last link without one, shape (B,).
    """

    def __init__(self, scene: Scene, mass_factors: Sequence[float]) -> None:
        self.scene, self.kernels = scene, compile_scene(scene)
        self.mass_factors = np.array(mass_factors, dtype=np.float64)
        self.num_envs = len(self.mass_factors)
        if scene.payload is None and not scene.links and (self.mass_factors != 1.0).any():
            raise ValueError(
                f"scene {scene.name!r} has neither payload nor links: mass_factors should be 1 alone"
            )
        self._groups: list[tuple[DQSpaceArmVectorEnv, NDArray[np.int64]]] = []
        for factor in np.unique(self.mass_factors):
            rows, changed = np.flatnonzero(self.mass_factors == factor), with_masses(scene, float(factor))
            environment = DQSpaceArmVectorEnv(len(rows), changed, autoreset_mode=AutoresetMode.NEXT_STEP)
            self._groups.append((environment, rows))

    @property
    def states(self) -> FloatArray:
        """The states, shape (B, n_x), units as in `kernels.layout.state`."""
        return np.asarray(self._joined([environment.states for environment, _ in self._groups]))

    @property
    def targets(self) -> FloatArray:
        """Poses q_{D/I} of the targets, shape (B, 8)."""
        return np.asarray(self._joined([environment.targets for environment, _ in self._groups]))

    def reset(self, starts: ArrayLike) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin episodes at given states, shape (B, n_x); returns observations and info."""
        states = np.asarray(starts, dtype=np.float64)
        results = [env.reset(options={"initial_state": states[rows]}) for env, rows in self._groups]
        observations, infos = zip(*results, strict=True)
        return self._joined(observations), _JoinedInfo(self._joined, infos)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[Any], FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply actions, fractions of the limits, shape (B, n_u), for one time step."""
        results = [environment.step(actions[rows]) for environment, rows in self._groups]
        *arrays, infos = zip(*results, strict=True)
        observations, rewards, terminated, truncated = (self._joined(parts) for parts in arrays)
        return observations, rewards, terminated, truncated, _JoinedInfo(self._joined, infos)

    def perturb(self, increments: FloatArray) -> None:
        """Displace the states, see `DQSpaceArmVectorEnv.perturb`."""
        for environment, rows in self._groups:
            environment.perturb(increments[rows])

    def observe(self, states: FloatArray) -> NDArray[Any]:
        """Observations of given states, shape (B, n_x), at the present times."""
        return self._joined([environment.observe(states[rows]) for environment, rows in self._groups])

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Copy what all later steps depend on, see `DQSpaceArmVectorEnv.get_state`."""
        return {
            f"{place}.{name}": array
            for place, (environment, _) in enumerate(self._groups)
            for name, array in environment.get_state().items()
        }

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on where `get_state` was called, see `DQSpaceArmVectorEnv.set_state`."""
        for place, (environment, _) in enumerate(self._groups):
            prefix = f"{place}."
            part = {name.removeprefix(prefix): state[name] for name in state if name.startswith(prefix)}
            environment.set_state(part)

    def _joined(self, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Arrays of the groups in the order of the episodes."""
        if len(parts) == 1:
            return parts[0]
        joined = np.empty((self.num_envs, *parts[0].shape[1:]), parts[0].dtype)
        for part, (_, rows) in zip(parts, self._groups, strict=True):
            joined[rows] = part
        return joined


class _JoinedInfo(dict[str, Any]):
    """Info of all groups; entries are joined when they are read, because training reads few."""

    def __init__(
        self, join: Callable[[Sequence[NDArray[Any]]], NDArray[Any]], infos: Sequence[dict[str, Any]]
    ) -> None:
        super().__init__()
        self._join, self._infos = join, infos

    def __missing__(self, key: str) -> NDArray[Any]:
        self[key] = joined = self._join([info[key] for info in self._infos])
        return joined


def with_masses(scene: Scene, factor: float) -> Scene:
    """Multiply mass and inertia of the payload, or of the last link if there is no payload.

    Args:
        scene: A scene with a payload or a link, unless the factor is 1.
        factor: The factor, dimensionless.

    Returns:
        The changed scene.
    """
    if factor == 1.0:
        return scene
    if scene.payload is not None:
        return scene.replace(payload=_scaled(scene.payload.model_dump(), factor))
    links = [link.model_dump() for link in scene.links]
    return scene.replace(links=[*links[:-1], _scaled(links[-1], factor)])


def _scaled(body: dict[str, Any], factor: float) -> dict[str, Any]:
    inertia = (factor * np.array(body["inertia"])).tolist()
    return {**body, "mass": factor * body["mass"], "inertia": inertia}
