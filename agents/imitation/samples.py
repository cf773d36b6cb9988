"""Where time steps to learn from come from: demonstrations, corrections of a network's flights, or both."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from experts.demonstrations import Demonstrations
from experts.demonstrations.reading import Batch
from experts.problem import FloatArray

NAMES = ("states", "observations", "actions", "feedback_gains")
"""What is learned from."""
LOOKS = 50
"""Stages at which the spread of demonstrations is measured."""


class Source(Protocol):
    """What `Demonstrations.batches` offers."""

    def batches(
        self, size: int, names: Sequence[str], *, seed: int | None, drop_last: bool
    ) -> Iterator[Batch]:
        """Go through all time steps once; see `Demonstrations.batches`."""


@dataclass(frozen=True)
class Statistics:
    """Units for a network: how much things vary in demonstrations.

    Attributes:
        observation_mean, observation_deviation: Shape (n_obs,), units of the observation.
        action_mean, action_deviation: Shape (n_u,), fractions of limits; the deviation of an action that
            never varies is 1.
        spread: Deviation of states from each other at the same stage, shape (n_t,), units of the tangent
            coordinates.
        gain_size: Root mean square of the change of the action, by the gains, over deviations with the
            spread, shape (n_u,), fractions of limits; 1 where gains are zero.
    """

    observation_mean: FloatArray
    observation_deviation: FloatArray
    action_mean: FloatArray
    action_deviation: FloatArray
    spread: FloatArray
    gain_size: FloatArray

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> "Statistics":
        """Measure demonstrations, in one pass.

        Args:
            demonstrations: Some of them.

        Returns:
            The statistics.
        """
        spread = _spread(demonstrations)
        observations = _Moments()
        actions = _Moments()
        gains = _Moments()
        for demonstration in demonstrations:
            observations.add(demonstration.observations[:-1])
            actions.add(demonstration.actions)
            # E (G d)^2 over independent d is the sum of the squares of G's columns times their deviations.
            changes = (demonstration.feedback_gains * spread) ** 2
            gains.add(changes.sum(axis=2, dtype=np.float64))
        deviation, size = actions.deviation(), np.sqrt(gains.mean())
        return cls(
            observations.mean(),
            observations.deviation(),
            actions.mean(),
            np.where(deviation > 0.0, deviation, 1.0),
            spread,
            np.where(size > 0.0, size, 1.0),
        )


class _Moments:
    """Mean and deviation of rows that come in pieces, each of about the size of the others."""

    def __init__(self) -> None:
        self._means: list[FloatArray] = []
        self._variances: list[FloatArray] = []

    def add(self, rows: NDArray[Any]) -> None:
        self._means.append(rows.mean(axis=0))
        self._variances.append(rows.var(axis=0))

    def mean(self) -> FloatArray:
        return np.asarray(np.mean(self._means, axis=0))

    def deviation(self) -> FloatArray:
        return np.asarray(np.sqrt(np.mean(self._variances, axis=0) + np.var(self._means, axis=0)))


def _spread(demonstrations: Demonstrations) -> FloatArray:
    """Deviation of states from those of the first demonstration, about its mean, averaged over stages."""
    stages = np.linspace(0, demonstrations.scene.simulation.steps - 1, LOOKS).astype(np.int64)
    reference = demonstrations[0].states[stages]
    deviations = [demonstrations.tangent(reference, each.states[stages]) for each in demonstrations]
    return np.asarray(np.sqrt(np.var(deviations, axis=0).mean(axis=0)))


@dataclass(frozen=True, eq=False)
class Corrections:
    """Time steps with what the expert would do there, M of them, in memory; a `Source`.

    Attributes:
        states: Shape (M, n_x), units of the state.
        observations: Shape (M, n_obs), as the environment gives them.
        actions: Inputs as fractions of their limits, shape (M, n_u).
        feedback_gains: Of the action over tangent coordinates, float32, shape (M, n_u, n_t).
    """

    states: FloatArray
    observations: FloatArray
    actions: FloatArray
    feedback_gains: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def joined(cls, parts: Sequence["Corrections"]) -> "Corrections":
        """Put several together.

        Args:
            parts: At least one.

        Returns:
            All of their time steps.
        """
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in NAMES))

    def thinned(self, every: int) -> "Corrections":
        """Keep some.

        Args:
            every: One in so many is kept.

        Returns:
            Those.
        """
        return Corrections(*(getattr(self, name)[::every].copy() for name in NAMES))

    def batches(
        self, size: int, names: Sequence[str], *, seed: int | None, drop_last: bool
    ) -> Iterator[Batch]:
        """Go through all time steps once.

        Args:
            size: Time steps of a batch.
            names: What to give, of `NAMES`.
            seed: Seed of the order; None for that of the time steps.
            drop_last: Whether to leave out the last batch if it is smaller.

        Yields:
            Batches; each time step counts as a demonstration of one stage.
        """
        order = np.arange(len(self))
        if seed is not None:
            order = np.random.default_rng(seed).permutation(order)
        for first in range(0, len(order), size):
            rows = order[first : first + size]
            if len(rows) < size and drop_last:
                return
            yield Batch(rows, np.zeros_like(rows), {name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, eq=False)
class Mixture:
    """Batches that come partly from one source and partly from another; a `Source`.

    Attributes:
        first: It is gone through once.
        second: It is gone through again and again as long as the first lasts.
        share: Share of the second in a batch.
    """

    first: Source
    second: Source
    share: float

    def batches(
        self, size: int, names: Sequence[str], *, seed: int | None, drop_last: bool
    ) -> Iterator[Batch]:
        """Go through the first source once.

        Args:
            size: Time steps of a batch, at least 2.
            names: What to give, of `NAMES`.
            seed: Seed of the order; None for the sources' own.
            drop_last: Whether to leave out the last batch of the first source if it is smaller.

        Yields:
            Batches, those of the first source followed by those of the second, which may be fewer at its end.
        """
        other = min(max(1, round(self.share * size)), size - 1)
        second = self._endless(other, names, seed)
        for batch in self.first.batches(size - other, names, seed=seed, drop_last=drop_last):
            more = next(second)
            yield Batch(
                np.concatenate([batch.demonstration, more.demonstration]),
                np.concatenate([batch.stage, more.stage]),
                {name: np.concatenate([batch.arrays[name], more.arrays[name]]) for name in names},
            )

    def _endless(self, size: int, names: Sequence[str], seed: int | None) -> Iterator[Batch]:
        turn = 0
        while True:
            yield from self.second.batches(
                size, names, seed=None if seed is None else seed + turn, drop_last=False
            )
            turn += 1
