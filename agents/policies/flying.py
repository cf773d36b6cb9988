"""Flights of policies in the native vector environment: their outcomes, and the time per action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dq_space_arm_env import Scene
from dq_space_arm_env.environment.disturbances import Disturbances
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout

FloatArray = NDArray[np.float64]
Policy = Callable[[NDArray[Any]], NDArray[Any]]
"""From observations, shape (B, n_obs), to actions, fractions of the limits, shape (B, n_u); see `rollout`."""

TIMED_ACTIONS = 300
"""Actions that are timed."""
_WARM_UP = 20


class Flights(NamedTuple):
    """Outcomes of B episodes.

    Attributes:
        cost: J of each, dimensionless, shape (B,).
        is_success: Whether the tip ended within the scene's tolerances, shape (B,); False where the policy
            failed.
        diverged: Whether the simulation blew up, shape (B,).
        policy_failed: Whether the policy gave NaN; the episode then continued with zero inputs, shape (B,).
        length: Steps until the episode ended, shape (B,); all of the scene's unless it diverged, or a
            constraint ended it.
        attitude_error: Of the tip at the end, shape (B,), deg.
        position_error: Of the tip at the end, shape (B,), m.
        effort: Sum of the control cost, shape (B,), dimensionless.
        base_turn: Largest rotation of the base from its first attitude, shape (B,), deg.
        constraint_violations: Share of the steps that violate constraints, see `Rollout`, shape (B,); NaN in
            a scene without.
    """

    cost: FloatArray
    is_success: NDArray[np.bool_]
    diverged: NDArray[np.bool_]
    policy_failed: NDArray[np.bool_]
    length: NDArray[np.int64]
    attitude_error: FloatArray
    position_error: FloatArray
    effort: FloatArray
    base_turn: FloatArray
    constraint_violations: FloatArray

    @classmethod
    def of(cls, flown: Rollout) -> Self:
        """Outcomes of a rollout."""
        found = {name: getattr(flown, name) for name in cls._fields if name != "effort"}
        if flown.constraint_violations is None:
            found["constraint_violations"] = np.full(len(flown), np.nan)
        return cls(**found, effort=flown.cost_terms["cost_control"])

    def columns(self) -> dict[str, list[Any]]:
        """JSON values: a list for each attribute, None for numbers that are not finite."""
        return {name: json_list(values) for name, values in self._asdict().items()}

    @classmethod
    def from_columns(cls, columns: Mapping[str, Sequence[Any]]) -> Self:
        """Outcomes that `columns` has written, ValueError for others; more columns may stand beside them."""
        kinds = {"is_success": np.bool_, "diverged": np.bool_, "policy_failed": np.bool_, "length": np.int64}
        unknown = {"constraint_violations": [None] * len(columns["cost"])}  # in records of earlier versions
        found = {**unknown, **columns}
        flights = cls(**{name: from_json_list(found[name], kinds.get(name)) for name in cls._fields})
        if any(values.shape != (len(flights.cost),) for values in flights):
            raise ValueError("columns of flights have different lengths")
        return flights


def fly(
    policy: Policy | StateFeedback,
    scene: Scene,
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda step, steps: None,
    *,
    disturbances: Disturbances | None = None,
    delay: int = 0,
) -> Flights:
    """Fly one episode for each seed, all side by side, see `rollout`."""
    flown = rollout(policy, scene, seeds, disturbances=disturbances, delay=delay, progress=progress)
    return Flights.of(flown)


def time_per_action(policy: Policy | StateFeedback, scene: Scene, *, batched: bool = True) -> float:
    """Median time of an action in flight, s.

    Args:
        policy: As for `rollout`, for one episode.
        scene: The scene.
        batched: Whether the policy expects observations of shape (1, n_obs) rather than (n_obs,).
    """
    timed = policy if batched else _Single(policy)
    steps = min(_WARM_UP + TIMED_ACTIONS, scene.simulation.steps)
    flown = rollout(timed, scene, [0], steps=steps)
    seconds = flown.action_seconds[: flown.length[0]]
    if isinstance(timed, _Single):
        seconds = np.array(timed.seconds)
    return float(np.median(seconds[min(_WARM_UP, len(seconds) // 2) :]))


class _Single:
    """A policy of single observations, timed without the batch around it."""

    def __init__(self, policy: Any) -> None:
        self._policy = policy
        self.seconds: list[float] = []
        self.begin = getattr(policy, "begin", lambda environment: None)

    def __call__(self, observations: NDArray[Any]) -> ArrayLike:
        observation = observations[0]
        started = perf_counter()
        action = self._policy(observation)
        self.seconds.append(perf_counter() - started)
        return np.reshape(action, (1, -1))


def json_list(values: NDArray[Any]) -> list[Any]:
    """An array as JSON values, None for numbers that are not finite."""
    return [value if np.isfinite(value) else None for value in values.tolist()]


def from_json_list(values: Sequence[Any], kind: Any = None) -> NDArray[Any]:
    """An array that `json_list` has written, NaN for None; of floats by default. ValueError for others."""
    if kind is np.bool_ and not all(isinstance(value, bool) for value in values):
        raise ValueError("flags are neither true nor false")  # NaN would count as true
    return np.array([np.nan if value is None else value for value in values], dtype=kind or np.float64)
