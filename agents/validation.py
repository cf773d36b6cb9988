"""Flights for the learning curve: few, always from the same starts, which are not those of the evaluation."""

from collections.abc import Sequence

import numpy as np

from agents.evaluation.flights import Policy, fly
from dq_space_arm_env import Scene

VALIDATION_SEED = 1
"""What the seeds of flights during training follow from; those of the evaluation protocol are others."""


def validation_seeds(episodes: int) -> list[int]:
    """Give the seeds of the flights.

    Args:
        episodes: How many.

    Returns:
        A seed for each.
    """
    return [int(seed) for seed in np.random.SeedSequence(VALIDATION_SEED).generate_state(episodes)]


def validate(policy: Policy, scene: Scene, seeds: Sequence[int]) -> dict[str, float]:
    """Let a policy fly, and say how well it does.

    Args:
        policy: As for `agents.evaluation.flights.fly`.
        scene: The scene.
        seeds: A seed for each flight.

    Returns:
        Share of successes, median cost, median attitude error [deg] and position error [m] of the tip at the
        end.
    """
    flights = fly(policy, scene, seeds)
    return {
        "success_rate": float(np.mean(flights.is_success)),
        "median_cost": float(np.median(flights.cost)),
        "attitude_error": float(np.median(flights.attitude_error)),
        "position_error": float(np.median(flights.position_error)),
    }
