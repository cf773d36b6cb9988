"""Model mismatch: worlds with other masses than the plan's, noise and pushes, and flights in them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from agents.configuration.schema import Mismatch
from agents.evaluation.conditions import NOISE, PAYLOAD_CHANGE, ChosenDisturbances
from agents.evaluation.plans import Plans
from dq_space_arm_env import Scene
from dq_space_arm_env.environment.disturbances import with_loads
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout

PUSH, PUSHES = 0.02, 6
"""Standard deviation of the jumps of the base's velocities, rad/s, m/s; and their mean number."""


class Condition(NamedTuple):
    """Model mismatch of a row of the comparison."""

    name: str
    mass_factor: float = 1.0  # of mass and inertia of the payload, or of the last link without one
    noise: float = 0.0  # standard deviation of the measured state, rad, m, rad/s, m/s
    push: float = 0.0  # standard deviation of the jumps of the base's velocities, rad/s, m/s


_LIGHT, _HEAVY = 1.0 - PAYLOAD_CHANGE, 1.0 + PAYLOAD_CHANGE
CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("as-planned"),
        Condition("light", mass_factor=_LIGHT),
        Condition("heavy", mass_factor=_HEAVY),
        Condition("noise", noise=NOISE),
        Condition("small-pushes", push=PUSH / 4.0),
        Condition("pushes", push=PUSH),
        Condition("light-noise-pushes", _LIGHT, NOISE, PUSH),
        Condition("heavy-noise-pushes", _HEAVY, NOISE, PUSH),
    )
}
"""Noise and pushes of the receding-horizon benchmark, with the masses of the evaluation protocol."""


class Worlds(NamedTuple):
    """Model mismatch of B flights."""

    mass_factors: ArrayLike  # of mass and inertia of the payload, or of the last link without one, shape (B,)
    noise: ArrayLike  # standard deviation of the measured state, shape (B,), rad, m, rad/s, m/s
    push: ArrayLike  # standard deviation of the jumps of the base's velocities, shape (B,), rad/s, m/s
    pushes: float  # mean number of jumps in an episode
    seed: int  # of all draws

    @classmethod
    def drawn(cls, mismatch: Mismatch, count: int, seed: int) -> Worlds:
        """Draw worlds as in training."""
        rng = np.random.default_rng(seed)
        return cls(
            np.resize(np.array(mismatch.mass_factors), count),
            mismatch.noise * rng.random(count),
            mismatch.push * rng.random(count),
            mismatch.pushes,
            seed,
        )


def fly_mismatched(
    controller: StateFeedback,
    scene: Scene,
    plans: Plans,
    worlds: Worlds,
    progress: Callable[[int, int], None] = lambda step, steps: None,
) -> Rollout:
    """Fly from where plans begin; in equal worlds all controllers meet equal disturbances.

    Worlds for more than B flights are those of the first B: draws do not depend on the number of flights.
    """
    count = len(plans)
    drawn = max(count, *(np.size(value) for value in worlds[:3]))
    factors, noise, push = (np.broadcast_to(np.asarray(value, np.float64), (drawn,)) for value in worlds[:3])
    rng = np.random.default_rng([worlds.seed, 1])
    disturbances = ChosenDisturbances(
        range(count), scene, rng, push=push, pushes=worlds.pushes, measurement=noise
    )
    flown, parameters = with_loads(scene, factors[:count], plans.known)
    return rollout(
        controller,
        flown,
        starts=plans.starts,
        parameters=parameters,
        disturbances=disturbances,
        progress=progress,
    )
