"""How many demonstrations cloning needs: plain, with augmentation, and with gains.

Each variant learns from the same demonstrations, more and more of them, with the same network and as many
updates; what it has learned flies from starts that none has seen. What is measured is written line by line,
so that an interrupted measurement goes on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.configuration.imitation import ImitationConfiguration, ObjectiveWeights
from agents.evaluation.flights import fly
from agents.evaluation.statistics import wilson_interval
from agents.imitation.cloning import Making, clone, fingerprint
from agents.imitation.trainer import Progress
from agents.progress import Advance
from experts.demonstrations import Demonstrations
from experts.files import write_atomically

VARIANTS: Mapping[str, ObjectiveWeights] = {
    "actions": ObjectiveWeights(gain_weight=0.0),
    "augmentation": ObjectiveWeights(gain_weight=0.0, augmentation_weight=1.0),
    "gains": ObjectiveWeights(),
}
"""What is minimized, by the name of the variant; all of them learn the actions."""
TITLES = {"actions": "actions alone", "augmentation": "with augmentation", "gains": "with gains"}
LINES = "trainings.jsonl"


@dataclass(frozen=True)
class Effort:
    """How much is trained.

    Attributes:
        counts: Numbers of demonstrations.
        seeds: Trainings of each variant with each number; each draws its demonstrations and first weights.
        updates: Steps of the optimizer in each training.
    """

    counts: tuple[int, ...]
    seeds: int
    updates: int


@dataclass(frozen=True)
class Training:
    """A training and the flights after it.

    Attributes:
        variant: One of `VARIANTS`.
        count: Number of demonstrations.
        seed: Of the choice among them and of the first weights.
        successes: Flights that ended within the scene's tolerances.
        flights: All of them.
        gap: Median of J / J_expert - 1 over them, dimensionless.
        seconds: Time of the training, s.
    """

    variant: str
    count: int
    seed: int
    successes: int
    flights: int
    gap: float
    seconds: float


@dataclass(frozen=True)
class Comparing:
    """How far a comparison has come.

    Attributes:
        number: Of the training, from 0.
        trainings: All of them.
        title: Of the training.
        advance: How far that has come.
    """

    number: int
    trainings: int
    title: str
    advance: Advance

    @property
    def done(self) -> int:
        """Updates that are done."""
        return self.number * self.advance.total + self.advance.done

    @property
    def total(self) -> int:
        """Updates in all."""
        return self.trainings * self.advance.total

    def describe(self) -> str:
        """Put into one line how far it has come.

        Returns:
            The line.
        """
        return f"{self.number + 1} of {self.trainings}, {self.title}: {self.advance.describe()}"


@dataclass(frozen=True)
class Point:
    """All trainings of a variant with a number of demonstrations.

    Attributes:
        variant: One of `VARIANTS`.
        count: Number of demonstrations.
        trainings: How many there are.
        success: Share of flights that succeeded, 0 to 1.
        low, high: Its 95 % interval, that of Wilson over all flights.
        least, most: Lowest and highest share among the trainings.
        gap: Median over the trainings of their median gap, dimensionless.
        seconds: Mean time of a training, s.
    """

    variant: str
    count: int
    trainings: int
    success: float
    low: float
    high: float
    least: float
    most: float
    gap: float
    seconds: float


@dataclass(frozen=True)
class Saving:
    """What a variant saves at a point.

    Attributes:
        point: The point.
        count: Demonstrations that plain cloning needs for the same success; None if none of its numbers is
            enough.
        ratio: Of the two numbers; with None that of the largest, and it would take more.
    """

    point: Point
    count: int | None
    ratio: float


def measure(
    configuration: ImitationConfiguration,
    effort: Effort,
    demonstrations: Demonstrations,
    tests: Demonstrations,
    folder: Path,
    progress: Progress | None = None,
) -> list[Training]:
    """Train all variants, and let them fly.

    Args:
        configuration: Network and optimizer; its objective and its updates are not read.
        effort: How much.
        demonstrations: What to learn from, at least as many as the largest number.
        tests: Where to fly from, with the expert's costs: demonstrations with another seed.
        folder: Where the lines are, and more are added; existing.
        progress: Called now and then.

    Returns:
        The trainings, those of an earlier measurement in the folder included.

    Raises:
        ValueError: If there are fewer demonstrations than asked for; if they are also what is flown from; if
            the folder holds a measurement of something else.
    """
    if max(effort.counts) > len(demonstrations):
        raise ValueError(
            f"{max(effort.counts)} demonstrations are asked for, there are {len(demonstrations)}"
        )
    if set(demonstrations.column("seed").tolist()) & set(tests.column("seed").tolist()):
        raise ValueError("demonstrations and tests share starts: give them different seeds")
    identity = _identity(configuration, effort, demonstrations, tests)
    done = _read(folder / LINES, identity)
    found = {(each.variant, each.count, each.seed) for each in done}
    order = list(_order(effort))
    for number, (variant, count, seed) in enumerate(order):
        if (variant, count, seed) not in found:
            chosen = _choice(demonstrations, count, seed)
            tell = partial(_tell, progress, number, len(order), f"{TITLES[variant]}, {count} demonstrations")
            done.append(_train(configuration, effort, variant, chosen, seed, tests, tell))
            _write(folder / LINES, identity, done)
    return done


def points(trainings: Sequence[Training]) -> list[Point]:
    """Put together what differs in the seed only.

    Args:
        trainings: As `measure` gives them.

    Returns:
        A point for each variant and number, in the order of `VARIANTS` and of the numbers.
    """
    counts = sorted({each.count for each in trainings})
    found = []
    for variant in VARIANTS:
        for count in counts:
            mine = [each for each in trainings if (each.variant, each.count) == (variant, count)]
            if mine:
                found.append(_point(variant, count, mine))
    return found


def saving(measured: Sequence[Point], variant: str) -> Saving | None:
    """Find out how many times fewer demonstrations than plain cloning a variant needs for the same success.

    Args:
        measured: Points.
        variant: The variant.

    Returns:
        Where the variant saves most; None if it is nowhere better than plain cloning.
    """
    plain = [point for point in measured if point.variant == "actions"]
    found = []
    for point in measured:
        if plain and point.variant == variant:
            enough = [each.count for each in plain if each.success >= point.success]
            most = max(each.count for each in plain)
            found.append(Saving(point, min(enough, default=None), min(enough, default=most) / point.count))
    best = max(found, key=lambda each: each.ratio, default=None)
    return best if best is not None and best.ratio > 1.0 else None


def _tell(progress: Progress | None, number: int, trainings: int, title: str, advance: Advance) -> None:
    if progress is not None:
        progress(Comparing(number, trainings, title, advance))


def _order(effort: Effort) -> Iterator[tuple[str, int, int]]:
    """Seed by seed, so that what is interrupted has some of everything."""
    for seed in range(effort.seeds):
        for count in effort.counts:
            for variant in VARIANTS:
                yield variant, count, seed


def _choice(demonstrations: Demonstrations, count: int, seed: int) -> Demonstrations:
    """Some demonstrations; a larger choice with the same seed contains the smaller ones."""
    order = np.random.default_rng(seed).permutation(len(demonstrations))
    return demonstrations.select(order[:count])


def _train(
    configuration: ImitationConfiguration,
    effort: Effort,
    variant: str,
    chosen: Demonstrations,
    seed: int,
    tests: Demonstrations,
    progress: Progress,
) -> Training:
    cloning = configuration.cloning
    settings = cloning.model_copy(
        update={
            "objective": VARIANTS[variant],
            "optimization": cloning.optimization.model_copy(update={"updates": effort.updates}),
            "validation_share": 0.0,
            "validate_every": effort.updates,
        }
    )
    making = Making(configuration.network, seed, configuration.threads)
    cloned = clone(chosen, settings, making=making, scene=tests.scene, progress=progress)
    flights = fly(cloned.export(), tests.scene, tests.column("seed").tolist())
    gap = float(np.median(flights.cost / tests.column("cost") - 1.0))
    successes, seconds = int(flights.is_success.sum()), cloned.history[-1]["seconds"]
    return Training(variant, len(chosen), seed, successes, len(tests), gap, seconds)


def _point(variant: str, count: int, trainings: Sequence[Training]) -> Point:
    interval = wilson_interval(
        sum(each.successes for each in trainings), sum(each.flights for each in trainings)
    )
    shares = [each.successes / each.flights for each in trainings]
    return Point(
        variant,
        count,
        len(trainings),
        interval.value,
        interval.low,
        interval.high,
        min(shares),
        max(shares),
        float(np.median([each.gap for each in trainings])),
        math.fsum(each.seconds for each in trainings) / len(trainings),
    )


def _identity(
    configuration: ImitationConfiguration,
    effort: Effort,
    demonstrations: Demonstrations,
    tests: Demonstrations,
) -> dict[str, Any]:
    """What a training follows from besides variant, number and seed, JSON values."""
    return {
        "network": configuration.network.model_dump(mode="json"),
        "cloning": configuration.cloning.model_dump(mode="json"),
        "updates": effort.updates,
        "threads": configuration.threads,
        **{
            name: [data.manifest["settings_sha256"], fingerprint(data)]
            for name, data in (("demonstrations", demonstrations), ("tests", tests))
        },
    }


def _read(path: Path, identity: Mapping[str, Any]) -> list[Training]:
    if not path.is_file():
        return []
    first, *lines = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    if first != identity:
        raise ValueError(f"{path} is a measurement of something else: take another folder")
    return [Training(**line) for line in lines]


def _write(path: Path, identity: Mapping[str, Any], trainings: Sequence[Training]) -> None:
    lines = [identity, *(asdict(each) for each in trainings)]
    write_atomically(path, "".join(json.dumps(line) + "\n" for line in lines))
