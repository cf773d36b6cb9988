"""Flying controllers through the same disturbances, to compare them start by start."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.configuration.residual import Mismatch
from agents.plans import FloatArray, Plans
from agents.residual.controllers import Controller
from agents.residual.worlds import Disturbance, Disturbances, Worlds
from dq_space_arm_env import Scene


class Flown(NamedTuple):
    """What became of B flights.

    Attributes:
        cost: J of each, dimensionless, shape (B,).
        is_success: Whether the tip ended within the scene's tolerances, shape (B,).
        attitude_error: Of the tip at the end, shape (B,), deg.
        position_error: Of the tip at the end, shape (B,), m.
    """

    cost: FloatArray
    is_success: NDArray[np.bool_]
    attitude_error: FloatArray
    position_error: FloatArray


class Adversity(NamedTuple):
    """How the worlds of B flights differ from their plans'.

    Attributes:
        mass_factors: Of mass and inertia of the payload, or of the last link without one, shape (B,).
        noise: Standard deviation of what is measured, shape (B,), rad, m, rad/s, m/s.
        push: Standard deviation of the jumps of the base's velocities, shape (B,), rad/s, m/s.
        pushes: Mean number of jumps in an episode.
        seed: Of all that is drawn.
    """

    mass_factors: ArrayLike
    noise: ArrayLike
    push: ArrayLike
    pushes: float
    seed: int

    @classmethod
    def drawn(cls, mismatch: Mismatch, count: int, seed: int) -> Adversity:
        """Draw as in training.

        Args:
            mismatch: What may differ.
            count: B.
            seed: Of the draws, and of the flights.

        Returns:
            Worlds as they are practiced in.
        """
        rng = np.random.default_rng(seed)
        return cls(
            np.resize(np.array(mismatch.mass_factors), count),
            mismatch.noise * rng.random(count),
            mismatch.push * rng.random(count),
            mismatch.pushes,
            seed,
        )


def fly(
    controller: Controller,
    scene: Scene,
    plans: Plans,
    adversity: Adversity,
    progress: Callable[[int, int], None] = lambda step, steps: None,
) -> Flown:
    """Let a controller fly from where plans begin; with the same adversity all controllers meet the same.

    Args:
        controller: Who flies.
        scene: The scene of the plans.
        plans: Of B flights.
        adversity: What they meet. If it is of more than B flights, they meet what the first B of them do.
        progress: Called after each step with its number and the number of all.

    Returns:
        What became of them.

    Raises:
        ValueError: If the scene has no masses that could be others.
    """
    count, steps = len(plans), scene.simulation.steps
    drawn = max(count, *(np.size(value) for value in adversity[:3]))
    factors, noise, push = (
        np.broadcast_to(np.asarray(value, np.float64), (drawn,)) for value in adversity[:3]
    )
    rng = np.random.default_rng([adversity.seed, 1])
    disturbances = Disturbances(scene, noise, push, adversity.pushes, rng)
    flight = Worlds(scene, factors[:count].tolist()).begin(plans.starts)
    controller.begin(plans)
    for stage in range(steps):
        measured = flight.measure(Disturbance(*(part[:count] for part in disturbances.draw())))
        flight.act(np.asarray(controller(stage, measured), dtype=np.float64))
        progress(stage + 1, steps)
    return Flown(flight.cost, flight.is_success(), *flight.errors())
