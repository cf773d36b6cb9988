"""Measure how many demonstrations cloning needs: plain, with augmentation, and with feedback gains.

For each seed all variants learn from the same growing sets of demonstrations, with the same network and the
same number of updates, and fly from the same unseen starts. Each training is written as a line, so that an
interrupted measurement resumes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.configuration.imitation import ImitationConfiguration, ObjectiveWeights
from agents.demonstrations import fingerprint
from agents.evaluation.statistics import rate_over_runs
from agents.imitation.cloning import Making, clone
from agents.imitation.trainer import Progress
from agents.run_folder import reserved
from dq_space_arm_env.common.bounded_reading import parse_json, read_text
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.progress import Advance, Status
from dq_space_arm_env.common.tables import Row
from dq_space_arm_env.environment.rollouts import rollout
from experts.demonstrations import Demonstrations

VARIANTS: Mapping[str, ObjectiveWeights] = {
    "actions": ObjectiveWeights(gain_weight=0.0),
    "augmentation": ObjectiveWeights(gain_weight=0.0, augmentation_weight=1.0),
    "gains": ObjectiveWeights(),
}
TITLES = {"actions": "actions alone", "augmentation": "with augmentation", "gains": "with gains"}
LINES = "trainings.jsonl"


@dataclass(frozen=True)
class Effort:
    """Numbers of demonstrations, trainings of each (which draw demonstrations and weights), and updates."""

    counts: tuple[int, ...]
    seeds: int
    updates: int


class Saving(NamedTuple):
    """The point where a variant saves most, and what plain cloning needs for the same success."""

    point: Row
    needed: int | None  # demonstrations; None if even the largest set is too small
    ratio: float  # of the two counts; with None a lower bound, from the largest set


def measure(
    configuration: ImitationConfiguration,
    effort: Effort,
    demonstrations: Sequence[Demonstrations],
    tests: Demonstrations,
    folder: Path,
    progress: Progress | None = None,
) -> list[Row]:
    """Train all variants, fly each from the starts of `tests`, and return a row per training.

    Each seed learns from demonstrations of its own, or all from the only ones. Network and optimizer are the
    configuration's; finished trainings in the folder are kept. RunFolderError if another process works there.
    """
    if len(demonstrations) not in (1, effort.seeds):
        raise ValueError(f"{len(demonstrations)} sets of demonstrations: should be 1 or {effort.seeds}")
    for pool in demonstrations:
        if max(effort.counts) > len(pool):
            raise ValueError(f"{max(effort.counts)} demonstrations are requested, there are {len(pool)}")
        if set(pool.column("seed").tolist()) & set(tests.column("seed").tolist()):
            raise ValueError("demonstrations and tests share starts: give them different seeds")
    identity = _identity(configuration, effort, demonstrations, tests)
    with reserved(folder):
        done = _read(folder / LINES, identity)
        found = {(row["variant"], row["count"], row["seed"]) for row in done}
        order = list(_order(effort))
        for number, (variant, count, seed) in enumerate(order):
            if (variant, count, seed) in found:
                continue
            label = f"{number + 1} of {len(order)}, {TITLES[variant]}, {count} demonstrations"

            def tell(advance: Advance, number: int = number, label: str = label) -> None:
                if progress is not None:
                    finished, total = number * advance.total + advance.done, len(order) * advance.total
                    progress(Status(finished, total, f"{label}: {advance.describe()}"))

            # A larger set contains the smaller ones of the same seed.
            pool = demonstrations[seed % len(demonstrations)]
            chosen = pool.select(np.random.default_rng(seed).permutation(len(pool))[:count])
            done.append(_train(configuration, effort, variant, chosen, seed, tests, tell))
            lines = "".join(json.dumps(line) + "\n" for line in (identity, *done))
            write_atomically(folder / LINES, lines)
    return [row for row in done if (row["variant"], row["count"], row["seed"]) in order]


def _order(effort: Effort) -> Iterator[tuple[str, int, int]]:
    """Seed by seed, so that an interrupted measurement has some of everything."""
    for seed in range(effort.seeds):
        for count in effort.counts:
            for variant in VARIANTS:
                yield variant, count, seed


def _train(
    configuration: ImitationConfiguration,
    effort: Effort,
    variant: str,
    chosen: Demonstrations,
    seed: int,
    tests: Demonstrations,
    progress: Progress,
) -> Row:
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
    flights = rollout(cloned.export(), tests.scene, tests.column("seed").tolist())
    return {
        "variant": variant,
        "count": len(chosen),
        "seed": seed,
        "successes": flights.is_success.astype(int).tolist(),
        "gap": float(np.median(flights.cost / tests.column("cost") - 1.0)),  # of J / J_expert - 1
        "seconds": cloned.history[-1]["seconds"],
    }


def points(trainings: Sequence[Row]) -> list[Row]:
    """Aggregate the seeds: a row per variant and count, with an interval over trainings and starts."""
    counts = sorted({row["count"] for row in trainings})
    groups = (
        [row for row in trainings if (row["variant"], row["count"]) == (variant, count)]
        for variant in VARIANTS
        for count in counts
    )
    return [_point(rows) for rows in groups if rows]


def _point(rows: Sequence[Row]) -> Row:
    interval = rate_over_runs([row["successes"] for row in rows])
    shares = [float(np.mean(row["successes"])) for row in rows]
    return {
        "variant": rows[0]["variant"],
        "count": rows[0]["count"],
        "trainings": len(rows),
        "success": interval.value,
        "low": interval.low,
        "high": interval.high,
        "least": min(shares),
        "most": max(shares),
        "gap": float(np.median([row["gap"] for row in rows])),
        "seconds": math.fsum(row["seconds"] for row in rows) / len(rows),
    }


def saving(measured: Sequence[Row], variant: str) -> Saving | None:
    """Find where a variant needs the fewest demonstrations relative to plain cloning, at equal success."""
    plain = [point for point in measured if point["variant"] == "actions"]
    found = []
    for point in measured:
        if plain and point["variant"] == variant:
            enough = [each["count"] for each in plain if each["success"] >= point["success"]]
            most = max(each["count"] for each in plain)
            found.append(Saving(point, min(enough, default=None), min(enough, default=most) / point["count"]))
    best = max(found, key=lambda each: each.ratio, default=None)
    return best if best is not None and best.ratio > 1.0 else None


def _identity(
    configuration: ImitationConfiguration,
    effort: Effort,
    demonstrations: Sequence[Demonstrations],
    tests: Demonstrations,
) -> dict[str, Any]:
    """Inputs that determine a training besides variant, count and seed, JSON values."""
    return {
        "network": configuration.network.model_dump(mode="json"),
        "cloning": configuration.cloning.model_dump(mode="json"),
        "updates": effort.updates,
        "threads": configuration.threads,
        **{
            name: [[data.manifest["settings_sha256"], fingerprint(data)] for data in sets]
            for name, sets in (("demonstrations", demonstrations), ("tests", [tests]))
        },
    }


def _read(path: Path, identity: Mapping[str, Any]) -> list[Row]:
    if not path.is_file():
        return []
    lines = read_text(path).splitlines() or ["null"]
    first, *rows = (parse_json(line, f"{path}, line {number}") for number, line in enumerate(lines, 1))
    if first != identity or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"{path} is of another measurement: use another folder")
    return rows
