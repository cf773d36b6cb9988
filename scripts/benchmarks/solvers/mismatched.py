"""The receding-horizon expert in worlds with springs or loads that its scene does not have.

From random starts it flies with and without estimating them, beside the optimum of an expert that knows them.
One compiled scene, whose doubtful numbers are parameters, serves all worlds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from dq_space_arm_env import load_scene
from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.identification import Identification, doubtful_numbers
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from experts.receding_horizon import RecedingHorizonExpert
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Row, claim
from scripts.benchmarks.solvers.random_starts import draw_starts

STIFFNESS = 1.0
"""Of a spring in every joint, at rest at zero, N m/rad."""
LOADS = (0.5, 1.5)
"""Factors of mass and inertia of the payload."""
SCENES = ("paper", "payload", "joint-limits", "keep-out")


class Mismatch(NamedTuple):
    """A world, and its parameters."""

    name: str
    parameters: FloatArray  # of the scene with doubtful numbers, shape (n_p,)


@dataclass(frozen=True)
class _Subject:
    """A scene, and what its flights in other worlds share."""

    maneuver: ArmProblem
    world: ArmProblem  # with the doubtful numbers as parameters
    informed: GuidedDDP
    experts: dict[bool, RecedingHorizonExpert]  # by whether they estimate these numbers

    def fly(self, expert: RecedingHorizonExpert, start: FloatArray, mismatch: Mismatch) -> Rollout:
        expert.reset(start)
        policy = StateFeedback(lambda states, stage: expert(states[0])[None])
        return rollout(policy, self.world.scene, starts=start[None], parameters=mismatch.parameters)


def measure_mismatches(effort: Effort) -> Iterator[Row]:
    """Fly each scene in its worlds."""
    for name in effort.scenes or SCENES:
        maneuver = ArmProblem(load_scene(name))
        if not doubtful_numbers(maneuver):
            continue
        world = Identification(maneuver).problem
        experts = {each: RecedingHorizonExpert(maneuver.scene, identify=each) for each in (False, True)}
        subject = _Subject(maneuver, world, GuidedDDP(world), experts)
        starts = draw_starts(maneuver, effort.flown_starts, effort.seed)
        for mismatch in mismatches(world):
            rows = [_flights(subject, start, mismatch) for start in starts]
            summary = _summary(rows)
            yield {"table": "mismatches", "scene": name, "mismatch": mismatch.name, **summary}
            missed = 1.0 - summary["identified"]
            remark = "share of flights that miss where the informed optimum does not"
            yield claim("mismatch", f"scene {name}", mismatch.name, missed, 0.0, note=remark)


def mismatches(world: ArmProblem) -> Iterator[Mismatch]:
    """No mismatch, springs, and other payloads."""
    entries = world.kernels.parameters
    yield Mismatch("none", entries.nominal)
    springs = entries.nominal.copy()
    springs[[name.endswith(".stiffness") for name in entries.names]] = STIFFNESS
    yield Mismatch(f"springs, {STIFFNESS:g} N m/rad", springs)
    for factor in LOADS if world.scene.payload else ():
        loads = entries.nominal.copy()
        loads[entries.indices("payload")] *= factor
        yield Mismatch(f"payload x {factor:g}", loads)


def _flights(subject: _Subject, start: FloatArray, mismatch: Mismatch) -> dict[str, Any]:
    solved = uninterrupted(subject.informed.solve(start, parameters=mismatch.parameters))
    knows = solved.converged and subject.world.is_success(solved.states, solved.controls)
    found: dict[str, Any] = {"informed": knows}
    for identifies, expert in subject.experts.items():
        flight = subject.fly(expert, start, mismatch)
        violations = flight.constraint_violations
        found[f"success {identifies}"] = bool(flight.is_success[0])
        found[f"above {identifies}"] = float(flight.cost[0]) / solved.cost - 1.0
        found[f"violated {identifies}"] = np.nan if violations is None else float(violations[0])
        found[f"ms {identifies}"] = 1e3 * float(np.median(flight.action_seconds[: flight.length[0]]))
    return {**found, "replans": subject.experts[True].replans}


def _summary(rows: list[dict[str, Any]]) -> Row:
    """Shares and means; those of the flights over the starts from which the informed optimum succeeds."""
    good = [row for row in rows if row["informed"]]

    def mean(key: str) -> float:
        return float(np.mean([row[key] for row in good])) if good else np.nan

    return {
        "starts": len(rows),
        "informed": float(np.mean([row["informed"] for row in rows])),
        "unaware": mean("success False"),
        "identified": mean("success True"),
        "unaware_above": mean("above False"),
        "identified_above": mean("above True"),
        "unaware_violated": mean("violated False"),
        "identified_violated": mean("violated True"),
        "unaware_ms": mean("ms False"),
        "identified_ms": mean("ms True"),
        "replans": mean("replans"),
    }
