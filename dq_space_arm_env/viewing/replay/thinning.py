"""Fewer instants of long flights, such that a page stays small and shows every peak."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.viewing.replay.flights import FloatArray, ShownFlight

LARGEST = 3_300_000
"""Bytes of poses and curves on a page; base 64 adds a third."""


def thinned(flights: Sequence[ShownFlight], thrusters: int = 0) -> list[ShownFlight]:
    """Leave out instants evenly, where all flights together would be too large, of those above their share.

    Poses and errors are those of the instants that stay, the ends among them. Of the inputs the smallest and
    the largest between two instants stay, in their order, one for each of two steps. A violation stays one.

    Args:
        flights: As prepared, of any lengths.
        thrusters: Number of thrusters, of which a page has the gas.

    Returns:
        The same flights, or ones with fewer steps, longer time steps, and `stride` set.
    """
    sizes = [_size(flight, thrusters) for flight in flights]
    few, room = list(flights), float(LARGEST)
    # From the smallest: what it leaves of its share is for the larger ones.
    for count, place in enumerate(sorted(range(len(few)), key=sizes.__getitem__)):
        stride = math.ceil(sizes[place] * (len(few) - count) / room)
        if stride > 1:
            few[place] = _thinned(few[place], min(stride, few[place].steps))
        room -= sizes[place] / stride
    return few


def _size(flight: ShownFlight, thrusters: int = 0) -> int:
    """Bytes in single precision, and one for each row of constraints."""
    moving = [each for each in (flight.target, flight.target_body, flight.payload) if each is not None]
    numbers = flight.frames.size + sum(each.size for each in moving) + 2 * len(flight.angle)
    numbers += flight.controls.size * (2 if flight.noise is not None else 1)
    if thrusters:
        numbers += 3 * (1 + thrusters) * len(flight.angle)
    return 4 * numbers + flight.violated.size


def _thinned(flight: ShownFlight, stride: int) -> ShownFlight:
    steps = math.ceil(flight.steps / stride)
    instants = np.rint(np.linspace(0, flight.steps, steps + 1)).astype(np.intp)
    controls = _extremes(flight.controls, instants)
    noise = None
    if flight.noise is not None:
        noise = _extremes(flight.controls + flight.noise, instants) - controls
    # What is violated at an instant, or after it and before the next that stays.
    violated = np.logical_or.reduceat(flight.violated, instants, axis=1)
    return replace(
        flight,
        controls=controls,
        noise=noise,
        acting=_extremes(flight.acting, instants),
        target=_at(flight.target, instants),
        target_body=None if flight.target_body is None else _at(flight.target_body, instants),
        payload=None if flight.payload is None else _at(flight.payload, instants),
        frames=flight.frames[instants],
        angle=flight.angle[instants],
        distance=flight.distance[instants],
        violated=violated,
        dt=flight.dt * flight.steps / steps,
        stride=stride,
    )


def _at(poses: FloatArray, instants: NDArray[np.intp]) -> FloatArray:
    return poses if poses.ndim == 1 else poses[instants]


def _extremes(values: FloatArray, instants: NDArray[np.intp]) -> FloatArray:
    """Of values (M, n): the smallest and the largest of two steps between instants, in their order."""
    kept = np.empty((len(instants) - 1, values.shape[1]))
    for first in range(0, len(kept), 2):
        some = values[instants[first] : instants[min(first + 2, len(kept))]]
        if first + 1 == len(kept):
            places = np.abs(some).argmax(axis=0)[None]
        else:
            places = np.sort([some.argmin(axis=0), some.argmax(axis=0)], axis=0)
        kept[first : first + 2] = np.take_along_axis(some, places, axis=0)
    return kept
