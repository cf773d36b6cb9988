"""The value of corrections: all controllers from the same starts, under the same disturbances."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from agents.configuration.schema import RESERVED_SEED
from agents.demonstrations import check_scene, stricter
from agents.evaluation.comparing import Comparison, Row, distinct_names, finished
from agents.evaluation.comparison_tables import mismatch_table
from agents.evaluation.evaluating import Advance, Evaluation, known_interval
from agents.evaluation.evaluation_verbs import progress_bar, save_comparison
from agents.evaluation.expert_costs import EVALUATION_SEEDS, OptimalCosts, evaluation_seeds
from agents.evaluation.kept_results import KeptRows
from agents.evaluation.plan_followers import FEEDBACK, OPEN_LOOP, RECEDING, RecedingHorizon, follower
from agents.evaluation.planned_flights import agents_source
from agents.evaluation.plans import FloatArray, Plans
from agents.evaluation.statistics import Interval, bootstrap_interval
from agents.evaluation.training_runs import training_command
from agents.policies import ExportedPolicy
from agents.policies.flying import Flights
from agents.residual.corrections import correction, correction_settings
from agents.residual.informed import SOURCES, informed_costs
from agents.residual.mismatch import (
    CONDITIONS,
    PUSHES,
    Condition,
    Worlds,
    fly_mismatched,
)
from agents.zoo.finding import PolicyError, policy_path
from agents.zoo.shelf import file_hash
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.results import Destination
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback
from experts.demonstrations import Demonstrations, generate_demonstrations
from experts.executors import Executor

RECEDING_HORIZON = 50
"""Stages that the receding-horizon expert looks ahead."""
TOLERANCE_SCALE = 0.7
"""Default tolerances of the plans, relative to the scene's; as in training."""
_BLOCK = 40
"""Actions of a block; the shipped configuration holds a correction for half of it."""

Controller = Callable[[Plans], StateFeedback]
"""Makes a controller of flights from their plans."""


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

    The disturbances of a flight depend on the number of its start alone: not on the controller, nor on the
    number of flights.

    Args:
        policies: Exported corrections, or folders of their training runs.
        demonstrations: Plans of the flights.
        scene: Scene of the plans, whose tolerances define success; that of the demonstrations by default,
            which may have stricter ones.
        conditions: Model mismatch.
        receding_starts: Number of starts of the receding-horizon expert, some seconds each; 0 leaves it out.
        receding_horizon: Stages that it looks ahead.
        seed: Seed of noise and pushes.
        out: Folder whose folder `rows` keeps finished rows; rows found there are not computed again. None
            keeps only the costs of the informed expert, in the cache.
        progress: Called now and then.

    Returns:
        The comparison.

    Raises:
        PolicyError, PolicyFileError: If a policy is of no known kind, or cannot be read.
        ValueError: If a policy is no correction or does not fit the scene, or a number is out of range.
        DemonstrationsError: If the demonstrations are of another scene.
        KeyboardInterrupt: If the user interrupts it; finished rows remain.
    """
    _check_starts(receding_starts)
    scene = scene or demonstrations.scene
    check_scene(demonstrations, scene)
    found = read_corrections(policies, scene)
    work = _Work(
        demonstrations, Plans.of(demonstrations), scene, seed, receding_horizon, KeptRows(out), progress
    )
    controllers = _controllers(scene, found, receding_horizon, receding_starts)
    rows: list[Row] = []
    for condition in dict.fromkeys(conditions):
        optimal = informed_costs(
            scene,
            demonstrations,
            work.plans,
            condition.mass_factor,
            work.announced(f"{condition.name}: informed expert"),
        )
        evaluations = []
        for name, controller in controllers.items():
            starts = min(receding_starts, len(work.plans)) if name == RECEDING else len(work.plans)
            policy = found.get(name)
            evaluations.append(work.evaluation(condition, name, controller, starts, optimal, policy))
        rows += _rows(condition, evaluations)
    notes = tuple(_notes(rows, list(found)))
    return Comparison(scene.name, tuple(rows), notes=notes)


def _check_starts(receding: int) -> None:
    if receding < 0:
        raise ValueError(f"receding_starts: {receding}, should be at least 0, which leaves it out")


def _controllers(
    scene: Scene, found: Mapping[str, tuple[ExportedPolicy, Path]], horizon: int, receding_starts: int
) -> dict[str, Controller]:
    controllers: dict[str, Controller] = {
        OPEN_LOOP: lambda plans: follower(scene, plans, feedback=False),
        FEEDBACK: lambda plans: follower(scene, plans, feedback=True),
    }
    for name, (policy, _) in found.items():
        controllers[name] = lambda plans, policy=policy: correction(policy, scene, plans)  # type: ignore[misc]
    if receding_starts:
        expert = RecedingHorizon(scene, horizon)
        controllers[RECEDING] = lambda plans: expert.policy(plans.known)
    return controllers


def _rows(condition: Condition, evaluations: Sequence[Evaluation]) -> Iterator[Row]:
    """Rows of a condition, with the share of the plan's cost that each controller saves."""
    (base,) = (evaluation for evaluation in evaluations if evaluation.policy == FEEDBACK)
    for evaluation in evaluations:
        facts = {
            "condition": condition._asdict(),
            "controller": evaluation.policy,
            "mean_cost": float(np.mean(evaluation.flights.cost)),
            "saving": None
            if evaluation is base
            else known_interval(saving(evaluation.flights.cost, base.flights.cost)),
            "learning_curve": [],
        }
        yield Row(evaluation, facts)


def saving(cost: FloatArray, base: FloatArray) -> Interval:
    """One minus the geometric mean of J / J_base over the starts that both have flown, shape (B,) each."""
    both = min(len(cost), len(base))
    ratios = np.log(cost[:both] / base[:both])
    return bootstrap_interval(ratios, lambda values: 1.0 - float(np.exp(np.mean(values))))


def read_corrections(policies: Sequence[str | Path], scene: Scene) -> dict[str, tuple[ExportedPolicy, Path]]:
    """Read policies that correct plans, each with its file, by the name of its run.

    Raises PolicyError or PolicyFileError if a policy is of no known kind or cannot be read, ValueError if it
    is no correction or does not fit the scene.
    """
    files = [policy_path(policy) for policy in policies]
    found = {}
    for name, file in zip(distinct_names(files), files, strict=True):
        if not file.exists():
            raise PolicyError(f"{file}: there is no such file or folder")
        policy = ExportedPolicy.load(file)
        correction_settings(policy, scene)  # refuse unusable policies before hours of work
        found[name] = policy, file
    return found


def evaluation_plans(
    scene: Scene,
    out: Path,
    n: int = EVALUATION_SEEDS,
    *,
    tolerance_scale: float = TOLERANCE_SCALE,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Demonstrations:
    """Plan the maneuvers from the first n evaluation starts, for evaluations only; existing plans are reused.

    The few starts at which the expert fails are left out.
    """
    evaluation_seeds(scene, n)  # the seeds that RESERVED_SEED gives; refuses a wrong n
    if not 0.0 < tolerance_scale <= 1.0:
        raise ValueError(f"tolerance_scale: {tolerance_scale}, should be above 0, and 1 at most")
    name = re.sub(r"[/\\]+", "-", scene.name)  # any text may name a scene
    plans = generate_demonstrations(
        stricter(scene, tolerance_scale),
        n,
        out / f"plans-{name}-{n}-{tolerance_scale:g}",
        RESERVED_SEED,
        executor=executor,
        progress=lambda advance: progress(Advance("plans", advance.done, advance.problems)),
    )
    assert plans is not None  # one part is all of it
    return plans


@dataclass(frozen=True)
class _Work:
    """Settings common to all rows."""

    demonstrations: Demonstrations
    plans: Plans
    scene: Scene
    seed: int
    horizon: int
    kept: KeptRows
    progress: Callable[[Advance], None]

    def evaluation(
        self,
        condition: Condition,
        name: str,
        controller: Controller,
        starts: int,
        optimal: OptimalCosts,
        policy: tuple[ExportedPolicy, Path] | None,
    ) -> Evaluation:
        """Fly a controller from the first starts, or read its finished row."""
        seeds = self.demonstrations.column("seed")[:starts]
        content = {
            "controller": name,
            "policy": None if policy is None else file_hash(policy[1]),
            "condition": condition._asdict(),
            "scene": self.scene.content_hash(),
            "plans": dict(self.demonstrations.settings),  # tolerances, seeds, and the experts' code
            "starts": seeds.tolist(),
            "pushes": PUSHES,
            "seed": self.seed,
            "horizon": self.horizon if name == RECEDING else None,
            "agents": agents_source(SOURCES),
        }

        def fly() -> tuple[Evaluation, float]:
            factors = np.full(max(EVALUATION_SEEDS, len(self.plans)), condition.mass_factor)
            worlds = Worlds(factors, condition.noise, condition.push, PUSHES, self.seed)
            chosen, one = (self.plans.choose(self.plans.chosen[:count]) for count in (starts, 1))
            began, show = perf_counter(), self.announced(f"{condition.name}: {name}")
            flown = fly_mismatched(controller(chosen), self.scene, chosen, worlds, show)
            wall_seconds = perf_counter() - began
            alone = fly_mismatched(controller(one), self.scene, one, worlds)
            evaluation = Evaluation(
                policy=name,
                scene=self.scene.name,
                condition=condition.name,
                seeds=seeds,
                flights=Flights.of(flown),
                optimal=optimal.first(starts),
                action_seconds=typical_seconds(alone),
                wall_seconds=wall_seconds,
                metadata={} if policy is None else dict(policy[0].metadata),
            )
            return evaluation, 0.0

        return finished(self.kept, f"{name}-{condition.name}", content, fly)[0]

    def announced(self, stage: str) -> Callable[[int, int], None]:
        """A callback for the progress of a stage: done, and total."""
        return lambda done, total: self.progress(Advance(stage, done, total))


def typical_seconds(flown: Rollout) -> float:
    """Mean over the places in a block of the median time of an action there, s, of a single flight.

    A correction that is held counts as often as it is chosen, and an interruption of the process does not.
    """
    seconds = flown.action_seconds[: flown.length[0]]
    blocks = max(1, len(seconds) // _BLOCK)
    return float(np.mean(np.median(np.reshape(seconds[: blocks * _BLOCK], (blocks, -1)), axis=0)))


def _notes(rows: Sequence[Row], corrections: Sequence[str]) -> Iterator[str]:
    yield (
        "Cost gap: J / J_informed - 1, median; J_informed is the optimum of the expert that knows the "
        f"masses, and meets neither noise nor pushes. Saves: share of the cost of the {FEEDBACK}, geometric "
        "mean, flight by flight from the starts that both have flown. Angle and distance are medians."
    )
    if corrections:
        verb = "corrects" if len(corrections) == 1 else "correct"
        yield f"{' and '.join(corrections)} {verb} the {FEEDBACK}."
    starts = {row.name: len(row.evaluation.seeds) for row in rows}
    if RECEDING in starts and starts[RECEDING] < max(starts.values()):
        yield (
            f"The {RECEDING} flies the first {starts[RECEDING]} starts: compare it by its saving, because "
            "its success rate and cost gap are of these alone."
        )


def compare_corrections(
    destination: Destination,
    policies: Sequence[str] = (),
    scene: str = "paper",
    n: int = 128,
    *,
    conditions: Sequence[str] = tuple(CONDITIONS),
    tolerance_scale: float = TOLERANCE_SCALE,
    receding_starts: int = 0,
    executor: Executor | None = None,
) -> None:
    """Plan, compare, print the table, and write the files; finished rows are read from the folder."""
    _check_starts(receding_starts)  # before planning
    flown = load_scene(scene)
    corrections = read_corrections(policies, flown)  # refuse unusable policies before planning
    with progress_bar() as show:
        folder = destination.folder
        options: dict[str, Any] = {"tolerance_scale": tolerance_scale, "executor": executor, "progress": show}
        plans = evaluation_plans(flown, folder, n, **options)
        found = compare_under_mismatch(
            policies,
            plans,
            flown,
            conditions=[CONDITIONS[name] for name in conditions],
            receding_starts=receding_starts,
            out=folder,
            progress=show,
        )
    words = [
        *("dq-space-arm", "compare", "residual", *policies, "--scene", scene, "-n", str(n)),
        *("--condition", *dict.fromkeys(conditions), "--tolerance-scale", f"{tolerance_scale:g}"),
        *("--receding-starts", str(receding_starts)),
    ]
    trained = (training_command(policy.metadata, file) for policy, file in corrections.values())
    found = replace(
        found, commands=(*(command for command in trained if command is not None), shlex.join(words))
    )

    def draw() -> bytes:
        from agents.evaluation.comparison_figure import mismatch_figure
        from experts.figures.style import as_png

        return as_png(lambda: mismatch_figure(found))

    title = "Corrections of plans under model mismatch"
    save_comparison(destination, title, [mismatch_table(found)], found, draw)
