"""What disturbs episodes of decisions: actions that act late, jumps of the base's velocity, noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from agents.configuration.gradients import FlightMismatch
from agents.gradients.episode_loops import Arrivals
from dq_space_arm_env import Scene
from dq_space_arm_env.scene import StateLayout

Array = NDArray[Any]


class Met(NamedTuple):
    """What B episodes of K decisions meet; None for nothing."""

    delays: Array | None = None  # from an output to its effect, (B,), s
    jumps: Array | None = None  # of the states in tangent coordinates, as decisions begin, (K, B, n_t)
    noise: Array | None = None  # on the states that are measured, in tangent coordinates, (K, B, n_t)

    @classmethod
    def draw(
        cls, mismatch: FlightMismatch, scene: Scene, times: Array, count: int, rng: np.random.Generator
    ) -> Self:
        """Draw for episodes of which the first half meets nothing."""
        layout, steps = StateLayout.of(scene), np.diff(times)
        shape, met = (len(steps), count, layout.n_t), np.arange(count) >= calm(count)
        delays = jumps = noise = None
        if mismatch.delay:
            delays = mismatch.delay * rng.random(count) * met
        if mismatch.push:
            strength = mismatch.push * rng.random(count) * met
            struck = rng.random(shape[:2]) < mismatch.pushes * steps[:, None] / times[-1]
            jumps, velocity = np.zeros(shape), layout.tangent.base_velocity
            jumps[..., velocity] = rng.standard_normal(jumps[..., velocity].shape)
            jumps *= (struck * strength)[..., None]
        if mismatch.noise:
            deviation = mismatch.noise * rng.random(count) * met
            # A decision's measurement stands for one in each of its time steps: it has their mean's noise.
            means = np.sqrt(scene.simulation.dt / steps)
            noise = rng.standard_normal(shape) * (means[:, None] * deviation)[..., None]
        return cls(delays, jumps, noise)


def calm(count: int) -> int:
    """How many of some episodes, the first ones, meet nothing."""
    return (count + 1) // 2


def arrivals(
    times: Array, dt: float, firsts: Sequence[int], count: int, delays: Array | None = None
) -> Arrivals:
    """Which outputs act in the decisions of B episodes.

    Flights hold each action for a time step: on average over a decision, they act with the output of half
    a step before its middle. From the first decision of a phase nothing is extrapolated.

    Args:
        times: Those of the decisions and of the end, s, shape (K + 1,).
        dt: The time step, s.
        firsts: First decision of each phase.
        count: B.
        delays: From an output to its effect, s, shape (B,); None for none.
    """
    wanted = np.repeat(0.5 * (times[:-1] + times[1:] - dt)[:, None], count, axis=1)
    own = np.arange(len(wanted))[:, None]
    if delays is None:
        newest = np.repeat(own, count, axis=1)
        before = newest - ~np.isin(newest, firsts)
    else:
        wanted -= delays
        newest = np.minimum(np.searchsorted(times, wanted), own)
        before = np.maximum(newest - 1, 0)
        begun = (wanted > times[newest]) & np.isin(newest, firsts)
        before[begun] = newest[begun]
    between = times[newest] - times[before]
    ahead = np.where(between > 0.0, wanted - times[newest], 0.0) / np.where(between > 0.0, between, 1.0)
    arrived = (wanted >= 0.0) | (delays is None)
    return Arrivals(newest, before, ahead.astype(np.float32), arrived.astype(np.float64))
