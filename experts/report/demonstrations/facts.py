"""The numbers behind the summary: of every demonstration and failure, and of the log."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experts.demonstrations import Demonstrations
from experts.demonstrations.folder import LOG
from experts.demonstrations.outcomes import GUESSES
from experts.problem import FloatArray

REPLAYED = 1000
"""Demonstrations, evenly spaced, whose rewards are added up and compared with the cost."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """Numbers of one kind, one for each demonstration.

    Attributes:
        name: What they are.
        unit: Their unit; empty if they have none.
        values: Shape (M,), `unit`.
        failed: The same of the failures, shape (F,); None where it says nothing.
        bound: What no value may exceed; None if there is no such bound.
        from_log: Whether they come from the log: of all problems, and different in every run.
    """

    name: str
    unit: str
    values: FloatArray
    failed: FloatArray | None = None
    bound: float | None = None
    from_log: bool = False

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True, eq=False)
class Log:
    """What making the shards took.

    Attributes:
        shards: Number of shards that the log knows.
        machines: Name and processor of each machine.
        solve_seconds: Time of the first solve of each problem, shape (problems,), s.
        seconds: Time of each part of the work, s.
    """

    shards: int
    machines: tuple[str, ...]
    solve_seconds: FloatArray
    seconds: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Facts:
    """A data set in numbers, M demonstrations and F failures.

    Attributes:
        demonstrations: The data set.
        quantities: Those whose distributions are shown.
        guesses: What each solve began with, words, shape (M,).
        emphases: Factor of the final pose's weights in each solve, shape (M,).
        failures: From `Demonstrations.failures`, and `start_errors`, shape (F, 2), deg and m.
        log: Times.
        replayed: Number of demonstrations whose return was compared with the cost.
        return_gap: Largest difference of return and -J among those, relative to J.
    """

    demonstrations: Demonstrations
    quantities: tuple[Quantity, ...]
    guesses: NDArray[np.str_]
    emphases: FloatArray
    failures: Mapping[str, NDArray[Any]]
    log: Log
    replayed: int
    return_gap: float

    @property
    def problems(self) -> int:
        """Number of problems, M + F."""
        return len(self.demonstrations) + len(self.failures["index"])

    def quantity(self, name: str) -> Quantity:
        """Find a quantity.

        Args:
            name: Its name.

        Returns:
            The quantity.
        """
        return next(quantity for quantity in self.quantities if quantity.name == name)


def gather(demonstrations: Demonstrations) -> Facts:
    """Read the numbers of a complete folder.

    Args:
        demonstrations: All of its demonstrations.

    Returns:
        The facts.
    """
    log, failures = read_log(demonstrations), demonstrations.failures()
    failures["start_errors"] = _tip_errors(demonstrations, failures["start"])
    some = np.unique(np.linspace(0, len(demonstrations) - 1, REPLAYED).astype(np.int64))
    gaps = [_return_gap(demonstrations, int(position)) for position in some if len(demonstrations)]
    guesses = np.array(GUESSES)[demonstrations.column("guess")]
    quantities = tuple(_quantities(demonstrations, failures, log))
    emphases = demonstrations.column("emphasis")
    gap = max(gaps, default=0.0)
    return Facts(demonstrations, quantities, guesses, emphases, failures, log, len(gaps), gap)


def read_log(demonstrations: Demonstrations) -> Log:
    """Read what making the shards took.

    Args:
        demonstrations: The data set.

    Returns:
        The log; empty where the folder came without it.
    """
    entries: dict[int, dict[str, Any]] = {}
    for path in sorted((demonstrations.path / LOG).glob("*.jsonl")):
        processors: dict[str, str] = {}  # of machines that a run was started on
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue  # what a killed run has begun to write
            if "run" in entry:
                processors[entry["host"]] = f" ({entry['run']['machine']['processor_name']})"
            else:
                machine = entry["host"] + processors.get(entry["host"], "")
                entries[entry["shard"]] = {**entry, "machine": machine}  # one made anew counts once
    seconds: dict[str, float] = {}
    for entry in entries.values():
        for part, value in entry["seconds"].items():
            seconds[part] = seconds.get(part, 0.0) + value
    solves = [value for _, entry in sorted(entries.items()) for value in entry["solve_seconds"]]
    machines = tuple(sorted({entry["machine"] for entry in entries.values()}))
    return Log(len(entries), machines, np.array(solves), seconds)


def _quantities(
    demonstrations: Demonstrations, failures: Mapping[str, NDArray[Any]], log: Log
) -> Iterator[Quantity]:
    success = demonstrations.scene.success
    bounds = success.attitude_error_deg, success.position_error
    errors = {when: demonstrations.column(f"{when}_errors") for when in ("start", "final")}
    for index, (what, unit) in enumerate((("attitude", "°"), ("position", "m"))):
        failed = failures["start_errors"][:, index]
        yield Quantity(f"{what} error at the start", unit, errors["start"][:, index], failed)
    for index, (what, unit) in enumerate((("attitude", "°"), ("position", "m"))):
        yield Quantity(f"{what} error at the end", unit, errors["final"][:, index], bound=bounds[index])
    yield Quantity("cost J", "", demonstrations.column("cost"))
    yield Quantity("clamped share", "%", 100.0 * demonstrations.column("clamped_share"))
    yield Quantity("iterations", "", demonstrations.column("iterations").astype(np.float64))
    yield Quantity("time of the first solve", "s", log.solve_seconds, from_log=True)


def _tip_errors(demonstrations: Demonstrations, states: FloatArray) -> FloatArray:
    """Attitude error [deg] and position error [m] of states, shape (n, 2)."""
    if not len(states):
        return np.zeros((0, 2))
    _, errors = demonstrations.kernels.observation(states, np.zeros((len(states), 1)))
    return np.stack([np.degrees(errors[:, 0]), errors[:, 1]], axis=1)


def _return_gap(demonstrations: Demonstrations, position: int) -> float:
    demonstration = demonstrations[position]
    gap = abs(math.fsum(demonstration.rewards.tolist()) + demonstration.cost)
    return gap / abs(demonstration.cost) if demonstration.cost else gap
