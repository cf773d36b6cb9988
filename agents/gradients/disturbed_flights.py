"""What disturbs episodes of decisions: actions that act late, jumps of the base's velocity, noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from agents.configuration.gradients import FlightMismatch
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


class Arrival(NamedTuple):
    """Which outputs act in a decision: the newest that has arrived, and its difference to the one before."""

    newest: Any  # index of a decision, or (B,)
    before: Any
    ahead: Any  # in units of the time between these two, or (B, 1)
    arrived: Any  # 0 where nothing has, (B, 1); otherwise 1
    rows: Any  # of episodes: all, or (B,)

    def of(self, outputs: Array) -> Array:
        """Outputs (B, n) that act, of all decisions' (K, B, n)."""
        newest = outputs[self.newest, self.rows]
        return np.asarray(newest + self.ahead * (newest - outputs[self.before, self.rows]))

    def back(self, cotangent: Array, by_output: Array) -> None:
        """Add what the cotangent (B, n) of `of` adds to those of all outputs, (K, B, n)."""
        cotangent, ahead = cotangent * self.arrived, np.float64(self.ahead)
        by_output[self.newest, self.rows] += (1.0 + ahead) * cotangent
        by_output[self.before, self.rows] -= ahead * cotangent


def arrivals(times: Array, dt: float, firsts: Sequence[int], delays: Array | None = None) -> list[Arrival]:
    """What acts in each decision, by the times of decisions (K + 1,), the time step, and delays (B,), s.

    Flights hold each action for a time step: on average over a decision, they act with the output of half
    a step before its middle. Without delays, the first decisions of phases extrapolate nothing.
    """
    means, found = 0.5 * (times[:-1] + times[1:] - dt), []
    for k, mean in enumerate(means):
        if delays is None:
            newest, wanted = np.array(k), np.array(mean)
        else:
            wanted = mean - delays
            newest = np.minimum(np.searchsorted(times, wanted), k)
        before = np.maximum(newest - (delays is not None or k not in firsts), 0)
        between = times[newest] - times[before]
        ahead = np.where(between > 0.0, wanted - times[newest], 0.0) / np.where(between > 0.0, between, 1.0)
        ahead = ahead.astype(np.float32)
        if delays is None:
            found.append(Arrival(k, int(before), np.float32(ahead), 1.0, slice(None)))
        else:
            arrived = (wanted >= 0.0).astype(np.float64)[:, None]
            found.append(Arrival(newest, before, ahead[:, None], arrived, np.arange(len(delays))))
    return found
