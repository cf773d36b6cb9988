"""A data set in numbers and tables, for data card and summary: demonstrations, failures and the log."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json, read_text
from dq_space_arm_env.common.tables import TextTable
from experts.demonstrations import Demonstrations
from experts.demonstrations.folder import LOG
from experts.demonstrations.outcomes import GUESSES
from experts.demonstrations.shard import PARAMETERS, tip_errors
from experts.guesses.guided import RESERVE
from experts.problems.shooting_problem import FloatArray

_LOG_BYTES = 2**26  # of a part: tens of thousands of shards
AT_TOLERANCE = 0.99 * (1.0 - RESERVE)
"""Least share of a tolerance that a final error at it has: the solver keeps the reserve free."""
REPLAYED = 1000
"""Demonstrations, evenly spaced, whose return is compared with the cost."""


@dataclass(frozen=True, eq=False)
class Quantity:
    """A number about every demonstration."""

    name: str
    unit: str  # empty if dimensionless
    values: FloatArray  # shape (M,)
    failed: FloatArray | None = None  # of the failures, shape (F,); None where meaningless
    bound: float | None = None  # upper bound of all values, if any
    from_log: bool = False  # of all problems, and different in every run

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True, eq=False)
class Log:
    """Times of making the shards."""

    shards: int  # in the log
    machines: tuple[str, ...]  # name and processor of each machine
    solve_seconds: FloatArray  # of the first solve of each problem, shape (problems,), s
    seconds: Mapping[str, float]  # of each part of the work, s


@dataclass(frozen=True, eq=False)
class Facts:
    """A data set in numbers, M demonstrations and F failures."""

    demonstrations: Demonstrations
    quantities: tuple[Quantity, ...]  # whose distributions are shown
    guesses: NDArray[np.str_]  # initial guess of each solve, shape (M,)
    # whether each ends at a tolerance of the pose, where the cheapest maneuver would end outside, (M,)
    at_tolerance: NDArray[np.bool_]
    # from `Demonstrations.failures`, and `start_errors`, shape (F, 2), deg and m
    failures: Mapping[str, NDArray[Any]]
    log: Log
    replayed: int  # demonstrations whose return was compared with the cost
    return_gap: float  # largest difference of return and -J among those, relative to J

    @property
    def problems(self) -> int:
        return len(self.demonstrations) + len(self.failures["index"])

    def quantity(self, name: str) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.name == name)


def gather(demonstrations: Demonstrations) -> Facts:
    """Collect the numbers of a complete folder."""
    log, failures = read_log(demonstrations), demonstrations.failures()
    kernels, start = demonstrations.kernels, failures["start"]
    varied = failures.get(PARAMETERS, np.zeros((len(start), 0)))
    failures["start_errors"] = tip_errors(kernels, start, varied)
    some = np.unique(np.linspace(0, len(demonstrations) - 1, REPLAYED).astype(np.int64))
    gaps = [_return_gap(demonstrations, int(position)) for position in some if len(demonstrations)]
    guesses = np.array(GUESSES)[demonstrations.column("guess")]
    quantities = tuple(_quantities(demonstrations, failures, log))
    success = demonstrations.scene.success
    tolerances = success.attitude_error_deg, success.position_error
    near: NDArray[np.bool_] = demonstrations.column("final_errors") >= AT_TOLERANCE * np.array(tolerances)
    gap = max(gaps, default=0.0)
    return Facts(
        demonstrations, quantities, guesses, np.asarray(near.any(axis=1)), failures, log, len(gaps), gap
    )


def read_log(demonstrations: Demonstrations) -> Log:
    """Read the log; empty where the folder comes without one."""
    entries: dict[int, dict[str, Any]] = {}
    for path in sorted((demonstrations.path / LOG).glob("*.jsonl")):
        processors: dict[str, str] = {}  # of machines that started a run
        for line in _lines(path):
            try:
                entry = parse_json(line, str(path))
                if "run" in entry:
                    processors[entry["host"]] = f" ({entry['run']['machine']['processor_name']})"
                    continue
                machine = str(entry["host"]) + processors.get(entry["host"], "")
                timed = {str(part): float(value) for part, value in entry["seconds"].items()}
                solves = [float(value) for value in entry["solve_seconds"]]
                if not (solves and math.isfinite(sum(solves)) and 0.0 < sum(timed.values()) < math.inf):
                    continue  # damaged
                # A repeated one counts once.
                entries[int(entry["shard"])] = {"machine": machine, "seconds": timed, "solve_seconds": solves}
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
                continue  # left over from a killed run, or damaged
    seconds: dict[str, float] = {}
    for entry in entries.values():
        for part, value in entry["seconds"].items():
            seconds[part] = seconds.get(part, 0.0) + value
    solves = [value for _, entry in sorted(entries.items()) for value in entry["solve_seconds"]]
    machines = tuple(sorted({entry["machine"] for entry in entries.values()}))
    return Log(len(entries), machines, np.array(solves), seconds)


def _lines(path: Path) -> list[str]:
    try:
        return read_text(path, _LOG_BYTES).splitlines()
    except UnreadableError:
        return []  # nothing follows from the log


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


def _return_gap(demonstrations: Demonstrations, position: int) -> float:
    demonstration = demonstrations[position]
    gap = abs(math.fsum(demonstration.rewards.tolist()) + demonstration.cost)
    return gap / abs(demonstration.cost) if demonstration.cost else gap


SHARES = (0.05, 0.5, 0.95)
MOST_FAILURES = 20
"""Failures listed individually."""


def contents(facts: Facts) -> TextTable:
    """One row per fact about the data set."""
    demonstrations, settings = facts.demonstrations, facts.demonstrations.settings
    simulation = demonstrations.scene.simulation
    size = sum(shard["bytes"] for shard in demonstrations.manifest["shards"])
    rows = (
        ("scene", demonstrations.scene.name),
        ("problems", f"{facts.problems}, drawn with seed {settings['seed']}"),
        ("demonstrations", f"{len(demonstrations)} ({share(len(demonstrations), facts.problems)})"),
        ("failures", str(len(facts.failures["index"]))),
        ("stages", f"{simulation.steps} of {simulation.dt:g} s"),
        ("files", f"{len(demonstrations.manifest['shards'])} shards, {number(size / 1e6)} MB"),
        ("versions", ", ".join(f"{name} {version}" for name, version in settings["versions"].items())),
    )
    return TextTable("The data set", ("", ""), rows)


def distributions(facts: Facts, *, with_times: bool = True) -> TextTable:
    """One row per quantity."""
    shown = (q for q in facts.quantities if len(q.values) and (with_times or not q.from_log))
    rows = tuple(_distribution(quantity) for quantity in shown)
    headings = ("", "least", *(f"{100 * part:g} %" for part in SHARES), "most", "mean", "bound")
    return TextTable("Distributions", headings, rows, right=1)


def _distribution(quantity: Quantity) -> tuple[str, ...]:
    values = quantity.values
    numbers = (values.min(), *np.quantile(values, SHARES), values.max(), values.mean())
    bound = "" if quantity.bound is None else number(quantity.bound)
    return (quantity.label, *(number(float(value)) for value in numbers), bound)


def parameters(facts: Facts) -> TextTable:
    """One row for each number that varies in the scene."""
    found, rows = facts.demonstrations.kernels.parameters, []
    columns = facts.demonstrations.column(PARAMETERS).T if len(facts.demonstrations) else ()
    names = zip(found.names, found.units, found.nominal, strict=True)
    for (name, unit, nominal), values in zip(names, columns, strict=False):
        numbers = (nominal, values.min(), values.mean(), values.max())
        rows.append((name, unit, *(number(float(value)) for value in numbers)))
    headings = ("", "unit", "nominal", "least", "mean", "most")
    title = "Parameters\nwhat varies between problems besides the start"
    title += "; and what phases change, as the first has it" if found.staged else ""
    return TextTable(title, headings, tuple(rows), right=2)


def guesses(facts: Facts) -> TextTable:
    """One row per initial guess, most frequent first."""
    title = "Initial guesses\nneighbor: solved again, starting with a neighbor's policy"
    return _groups(title, "guess", facts.guesses.tolist(), facts)


def ends(facts: Facts) -> TextTable:
    """One row for demonstrations within the tolerances, one for those at them; most frequent first."""
    title = (
        "Ends\nwhere the cheapest maneuver would end outside the tolerances, these are constraints, and the "
        "maneuver ends at them"
    )
    names = np.where(facts.at_tolerance, "at a tolerance of the pose", "within it").tolist()
    return _groups(title, "end", names, facts)


def _groups(title: str, heading: str, names: list[str], facts: Facts) -> TextTable:
    """Count, iterations and cost of the demonstrations with each name."""
    cost, iterations = (facts.quantity(name).values for name in ("cost J", "iterations"))
    rows, each = [], np.array(names)
    for name, count in Counter(names).most_common():
        mine = each == name
        medians = (number(float(np.median(values[mine]))) for values in (iterations, cost))
        rows.append((name, str(count), share(count, len(names)), *medians))
    headings = (heading, "demonstrations", "share", "iterations, median", "cost, median")
    return TextTable(title, headings, tuple(rows), right=1)


def times(facts: Facts) -> TextTable:
    """What making the shards took."""
    log = facts.log
    total = sum(log.seconds.values())
    problems = len(log.solve_seconds)
    rows = [
        (part, f"{seconds:.2f}", share(seconds, total), f"{1e3 * seconds / problems:.2f}")
        for part, seconds in log.seconds.items()
    ]
    rows.append(("total", f"{total:.2f}", "", f"{1e3 * total / problems:.2f}"))
    explained = (
        f"wall clock, {log.shards} of {len(facts.demonstrations.manifest['shards'])} shards, on "
        f"{', '.join(log.machines)}; {problems / total:.2f} problems per second and process"
    )
    headings = ("", "s", "share", "ms per problem")
    return TextTable(f"Times\n{explained}", headings, tuple(rows), right=1)


def failure_reasons(facts: Facts) -> TextTable:
    """One row per reason."""
    found = facts.demonstrations.manifest["failures"]
    rows = tuple((reason, str(count), share(count, facts.problems)) for reason, count in found.items())
    return TextTable("Reasons", ("reason", "problems", "share"), rows, right=1)


def failure_list(facts: Facts) -> TextTable:
    """One row for each of the first failures."""
    failures, rows = facts.failures, []
    for i in range(min(len(failures["index"]), MOST_FAILURES)):
        errors = (*failures["start_errors"][i], *failures["final_errors"][i], failures["cost"][i])
        rows.append(
            (
                str(failures["index"][i]),
                str(failures["seed"][i]),
                str(failures["reason"][i]),
                *(number(float(value)) for value in errors),
            )
        )
    rest = len(failures["index"]) - len(rows)
    headings = ("problem", "seed", "reason", "start [°]", "start [m]", "end [°]", "end [m]", "cost J")
    title = f"Failures\nstarts of env.reset(seed=...){f'; {rest} more are not shown' if rest else ''}"
    return TextTable(title, headings, tuple(rows), right=3)


def number(value: float) -> str:
    """Format with three digits."""
    return f"{value:.0f}" if 999.5 <= abs(value) < 1e6 else f"{value:.3g}"


def share(part: float, whole: float) -> str:
    """Format as per cent."""
    return f"{part / whole:.1%}" if whole else "-"
