"""Sources of training samples: demonstrations, labeled flights of a network, or a mixture."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from experts.demonstrations import Demonstrations
from experts.demonstrations.reading import Batch
from experts.demonstrations.shard import PARAMETERS
from experts.problems.shooting_problem import FloatArray

NAMES = ("states", "observations", "actions", "feedback_gains")
COLUMNS = (*NAMES, PARAMETERS)  # the last one without columns where nothing varies in the scene
SPREAD_STAGES = 50  # at which the spread of demonstrations is measured


class Source(Protocol):
    """Samples in batches, as `Demonstrations` offers them."""

    def batches(self, size: int, names: Sequence[str], *, seed: int) -> Iterator[Batch]:
        """One pass over all time steps, see `Demonstrations.batches`."""


@dataclass(frozen=True)
class Statistics:
    """Spread of demonstrations, which gives a network its units."""

    observation_mean: FloatArray  # (n_obs,), units of the observation
    observation_deviation: FloatArray  # (n_obs,)
    action_mean: FloatArray  # (n_u,), fractions of the limits
    action_deviation: FloatArray  # (n_u,), 1 where actions do not vary
    spread: FloatArray  # deviation of states about their mean trajectory, tangent coordinates, (n_t,)
    gain_size: FloatArray  # root mean square of G d for directions d of that spread, (n_u,), 1 for zero gains

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> "Statistics":
        """Measure demonstrations in one pass."""
        spread = _spread(demonstrations)
        observations = _Moments()
        actions = _Moments()
        gains = _Moments()
        for demonstration in demonstrations:
            observations.add(demonstration.observations[:-1])
            actions.add(demonstration.actions)
            # E (G d)^2 for independent d is the sum over the columns of (G_j sigma_j)^2.
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
    """Mean and standard deviation of rows that come in chunks of similar size."""

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
    """Standard deviation of states about their mean trajectory, averaged over stages."""
    stages = np.linspace(0, demonstrations.scene.simulation.steps - 1, SPREAD_STAGES).astype(np.int64)
    reference = demonstrations[0].states[stages]
    deviations = [demonstrations.tangent(reference, each.states[stages]) for each in demonstrations]
    return np.asarray(np.sqrt(np.var(deviations, axis=0).mean(axis=0)))


@dataclass(frozen=True, eq=False)
class Corrections:
    """M time steps labeled with the expert's actions and gains, in memory; a `Source`."""

    states: FloatArray  # (M, n_x)
    observations: FloatArray  # (M, n_obs)
    actions: FloatArray  # (M, n_u), fractions of the limits
    feedback_gains: NDArray[np.float32]  # (M, n_u, n_t)
    parameters: FloatArray  # what varies in the scene, (M, n_p)

    def __len__(self) -> int:
        return len(self.states)

    @classmethod
    def joined(cls, parts: Sequence["Corrections"]) -> "Corrections":
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS))

    def thinned(self, every: int) -> "Corrections":
        """Keep one time step in `every`."""
        return Corrections(*(getattr(self, name)[::every].copy() for name in COLUMNS))

    def batches(self, size: int, names: Sequence[str], *, seed: int) -> Iterator[Batch]:
        order = np.random.default_rng(seed).permutation(len(self))
        for first in range(0, len(order), size):
            rows = order[first : first + size]
            yield Batch(rows, np.zeros_like(rows), {name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, eq=False)
class Mixture:
    """Batches of which a share comes from the second source; one pass over the first is a pass."""

    first: Source
    second: Source
    share: float

    def batches(self, size: int, names: Sequence[str], *, seed: int) -> Iterator[Batch]:
        other = min(max(1, round(self.share * size)), size - 1)
        second = self._endless(other, names, seed)
        for batch in self.first.batches(size - other, names, seed=seed):
            more = next(second)
            yield Batch(
                np.concatenate([batch.demonstration, more.demonstration]),
                np.concatenate([batch.stage, more.stage]),
                {name: np.concatenate([batch.arrays[name], more.arrays[name]]) for name in names},
            )

    def _endless(self, size: int, names: Sequence[str], seed: int) -> Iterator[Batch]:
        for turn in itertools.count(seed):
            yield from self.second.batches(size, names, seed=turn)
