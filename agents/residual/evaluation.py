"""All controllers from the same starts, under the same disturbances: what a correction is worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.comparison.comparing import distinct_names
from agents.comparison.controllers import FEEDBACK, OPEN_LOOP, RECEDING
from agents.comparison.kept_rows import KeptRows
from agents.comparison.planned_flights import agents_source
from agents.demonstrations import check_scene, stricter
from agents.evaluation import (
    EVALUATION_SEEDS,
    Interval,
    bootstrap_interval,
    evaluation_seeds,
    wilson_interval,
)
from agents.evaluation.evaluating import Advance
from agents.evaluation.expert_costs import SEED_OF_SEEDS
from agents.evaluation.policies import PolicyError, policy_path
from agents.plans import FloatArray, Plans
from agents.policies import ExportedPolicy
from agents.residual.conditions import CONDITIONS, Condition
from agents.residual.controllers import Controller, Corrected, GainScheduled, OpenLoop, RecedingHorizon
from agents.residual.flights import Adversity, Flown, fly
from agents.residual.informed import SOURCES, informed_costs
from agents.zoo.shelf import file_hash
from dq_space_arm_env import Scene
from experts.demonstrations import Demonstrations, generate_demonstrations
from experts.report.solvers.receding import PUSHES, with_masses

RECEDING_HORIZON = 50
"""Stages that the receding-horizon expert looks ahead."""
TOLERANCE_SCALE = 0.7
"""Of the tolerances that plans meet by default, relative to the scene's; as in training."""
_BLOCK = 40
"""Actions of a block; the configuration that ships holds a correction for half of it."""


@dataclass(frozen=True, eq=False)
class Row:
    """A controller under a condition.

    Attributes:
        condition: The condition.
        controller: Its name.
        flown: What became of its flights, from the first B starts.
        informed_cost: Of the expert that knows the masses, and meets neither noise nor pushes, shape (B,);
            NaN where it found no optimum.
        action_seconds: Mean time for an action of one flight, s; see `_Timed`.
    """

    condition: Condition
    controller: str
    flown: Flown
    informed_cost: FloatArray
    action_seconds: float

    @property
    def success_rate(self) -> Interval:
        """How often it arrives, with a 95 % interval."""
        success = self.flown.is_success
        return wilson_interval(int(success.sum()), len(success))

    @property
    def cost_gap(self) -> Interval:
        """Median of J / J_informed - 1, with a 95 % interval."""
        gaps = self.flown.cost / self.informed_cost - 1.0
        return bootstrap_interval(gaps[~np.isnan(gaps)], _median)

    def saving(self, base: Row) -> Interval:
        """Estimate what it saves, flight by flight, from the starts that both have flown.

        Args:
            base: What it is compared with.

        Returns:
            One minus the geometric mean of J / J_base, with a 95 % interval.
        """
        both = min(len(self.flown.cost), len(base.flown.cost))
        ratios = np.log(self.flown.cost[:both] / base.flown.cost[:both])
        return bootstrap_interval(ratios, lambda values: 1.0 - float(np.exp(np.mean(values))))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Controllers under several conditions.

    Attributes:
        scene: Name of the scene.
        rows: In the order of conditions, then of controllers.
        policies: Those that correct, with their files, by the names of their controllers.
    """

    scene: str
    rows: tuple[Row, ...]
    policies: Mapping[str, tuple[ExportedPolicy, Path]] = field(default_factory=dict)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions that there are rows for."""
        return tuple(dict.fromkeys(row.condition.name for row in self.rows))

    def under(self, condition: str) -> tuple[Row, ...]:
        """Rows of a condition.

        Args:
            condition: Its name.

        Returns:
            The rows.
        """
        return tuple(row for row in self.rows if row.condition.name == condition)

    def saving(self, row: Row) -> Interval | None:
        """Estimate what a controller saves of what the plan with its gains pays, see `Row.saving`.

        Args:
            row: Of the controller.

        Returns:
            The saving; None for the plan with its gains itself.
        """
        (base,) = (other for other in self.under(row.condition.name) if other.controller == FEEDBACK)
        return None if row is base else row.saving(base)


def compare_under_mismatch(
    policies: Sequence[str | Path],
    demonstrations: Demonstrations,
    scene: Scene | None = None,
    *,
    conditions: Sequence[Condition] = tuple(CONDITIONS.values()),
    receding_starts: int = 0,
    receding_horizon: int = RECEDING_HORIZON,
    seed: int = 0,
    out: Path | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Comparison:
    """Fly all controllers from where demonstrations begin.

    What a flight meets depends on the number of its start alone: not on who flies, nor on how many fly.

    Args:
        policies: Exported corrections, or folders of their training runs.
        demonstrations: Plans of the flights.
        scene: What they are for, whose tolerances tell success; that of the demonstrations by default, which
            may have stricter ones.
        conditions: How the worlds differ.
        receding_starts: Number of starts of the receding-horizon expert, the first ones, some seconds each;
            0 leaves it out.
        receding_horizon: Stages that it looks ahead.
        seed: Of noise and pushes.
        out: Folder that keeps finished rows, in its folder `rows`; what is there is not done again. None
            keeps nothing but the costs of the informed expert, in the cache.
        progress: Called now and then.

    Returns:
        The comparison.

    Raises:
        PolicyError, PolicyFileError: If a policy is none, or its file cannot be read.
        ValueError: If it is no correction or does not fit the scene, or a number is out of range.
        DemonstrationsError: If the demonstrations are of another scene.
        KeyboardInterrupt: If the user interrupts it. Rows that are finished remain.
    """
    if receding_starts < 0:
        raise ValueError(f"receding_starts: {receding_starts}, should be at least 0, which leaves it out")
    scene = scene or demonstrations.scene
    check_scene(demonstrations, scene)
    controllers: dict[str, Controller] = {OPEN_LOOP: OpenLoop(), FEEDBACK: GainScheduled(scene)}
    found = read_corrections(policies, scene)
    controllers |= {name: Corrected.by(policy, scene) for name, (policy, _) in found.items()}
    if receding_starts:
        controllers[RECEDING] = RecedingHorizon(scene, receding_horizon)
    work = _Work(
        demonstrations, Plans.of(demonstrations), scene, seed, receding_horizon, KeptRows(out), progress
    )
    rows = []
    for condition in conditions:
        informed = informed_costs(
            scene,
            demonstrations,
            work.plans,
            condition.mass_factor,
            work.announced(f"{condition.name}: informed expert"),
        )
        for name, controller in controllers.items():
            starts = min(receding_starts, len(work.plans)) if name == RECEDING else len(work.plans)
            file_of = found[name][1] if name in found else None
            flown, seconds = work.row(condition, name, controller, starts, file_of)
            rows.append(Row(condition, name, flown, informed[:starts], seconds))
    return Comparison(scene.name, tuple(rows), found)


def read_corrections(policies: Sequence[str | Path], scene: Scene) -> dict[str, tuple[ExportedPolicy, Path]]:
    """Read policies that correct plans.

    Args:
        policies: Exported policies, or folders of training runs.
        scene: What they are to fly in.

    Returns:
        Each with its file, by the name of its run.

    Raises:
        PolicyError, PolicyFileError: If a policy is none, or its file cannot be read.
        ValueError: If it is no correction, or does not fit the scene.
    """
    files = [policy_path(policy) for policy in policies]
    found = {}
    for name, file in zip(distinct_names(files), files, strict=True):
        if not file.exists():
            raise PolicyError(f"{file}: there is no such file or folder")
        policy = ExportedPolicy.load(file)
        Corrected.by(policy, scene)  # what cannot be used is refused before hours of work
        found[name] = policy, file
    return found


def evaluation_plans(
    scene: Scene,
    out: Path,
    n: int = EVALUATION_SEEDS,
    *,
    tolerance_scale: float = TOLERANCE_SCALE,
    workers: int | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Demonstrations:
    """Plan the maneuvers from the evaluation starts of a scene, for evaluations only.

    Args:
        scene: The scene.
        out: Where to make a folder for the plans; those that are there remain.
        n: Number of starts, the first ones. The few that the expert fails at are left out.
        tolerance_scale: Tolerances that plans meet, relative to the scene's, in (0, 1].
        workers: Processes that plan; one for each processor by default.
        progress: Called now and then.

    Returns:
        The plans.

    Raises:
        DemonstrationsError: If they cannot be written.
        ValueError: If demonstrations of the scene are impossible, or a number is out of range.
        KeyboardInterrupt: If the user interrupts it. What is planned remains.
    """
    evaluation_seeds(scene, n)  # these are the seeds that follow from the seed of the data set, if n is one
    if not 0.0 < tolerance_scale <= 1.0:
        raise ValueError(f"tolerance_scale: {tolerance_scale}, should be above 0, and 1 at most")
    plans = generate_demonstrations(
        stricter(scene, tolerance_scale),
        n,
        out / f"plans-{scene.name}-{n}-{tolerance_scale:g}",
        SEED_OF_SEEDS,
        workers=workers,
        progress=lambda advance: progress(Advance("plans", advance.done, advance.problems)),
    )
    assert plans is not None  # one part is all of it
    return plans


@dataclass(frozen=True)
class _Work:
    """What all rows have in common."""

    demonstrations: Demonstrations
    plans: Plans
    scene: Scene
    seed: int
    horizon: int
    kept: KeptRows
    progress: Callable[[Advance], None]

    def row(
        self, condition: Condition, name: str, controller: Controller, starts: int, policy: Path | None
    ) -> tuple[Flown, float]:
        """Fly a controller from the first starts, or take up what is there; with its time per action, s."""
        content = {
            "controller": name,
            "policy": None if policy is None else file_hash(policy),
            "condition": condition._asdict(),
            "flown in": with_masses(self.scene, condition.mass_factor).content_hash()
            if condition.mass_factor != 1.0
            else self.scene.content_hash(),
            "plans": dict(self.demonstrations.settings),  # tolerances, seeds, and the experts' code
            "starts": self.demonstrations.column("seed")[:starts].tolist(),
            "pushes": PUSHES,
            "seed": self.seed,
            "horizon": self.horizon if name == RECEDING else None,
            "agents": agents_source(SOURCES),
        }
        label = f"{name}-{condition.name}"
        known = _row_of(self.kept.read(label, content), starts)
        if known is not None:
            return known
        worlds = max(EVALUATION_SEEDS, len(self.plans))
        factors = np.full(worlds, condition.mass_factor)
        adversity = Adversity(factors, condition.noise, condition.push, PUSHES, self.seed)
        chosen = self.plans.choose(self.plans.chosen[:starts])
        flown = fly(controller, self.scene, chosen, adversity, self.announced(f"{condition.name}: {name}"))
        timed = _Timed(controller)
        fly(timed, self.scene, chosen.choose(chosen.chosen[:1]), adversity)
        seconds = timed.action_seconds()
        columns = {column: values.tolist() for column, values in flown._asdict().items()}
        self.kept.write(label, content, {"action_seconds": seconds, **columns})
        return flown, seconds

    def announced(self, stage: str) -> Callable[[int, int], None]:
        """What to call with how much is done of a stage, and with how much there is."""
        return lambda done, total: self.progress(Advance(stage, done, total))


class _Timed:
    """A controller whose actions are timed."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._seconds: list[float] = []

    def begin(self, plans: Plans) -> None:
        self._controller.begin(plans)

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        started = perf_counter()
        action = self._controller(stage, measured)
        self._seconds.append(perf_counter() - started)
        return action

    def action_seconds(self) -> float:
        """Mean time of an action, s: of the medians of those that are at the same place of a block.

        So a correction that is held counts as often as it is chosen, and an interruption of the process not.
        """
        blocks = max(1, len(self._seconds) // _BLOCK)
        times = np.reshape(self._seconds[: blocks * _BLOCK], (blocks, -1))
        return float(np.mean(np.median(times, axis=0)))


def _row_of(record: Mapping[str, Any] | None, starts: int) -> tuple[Flown, float] | None:
    """Flights and time per action out of a file; None if it is damaged."""
    if record is None:
        return None
    try:
        flown = Flown(*(np.array(record[column]) for column in Flown._fields))
        seconds = float(record["action_seconds"])
    except (KeyError, ValueError, TypeError):
        return None
    return (flown, seconds) if all(column.shape == (starts,) for column in flown) else None


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values))
