"""The evaluation protocol: fixed starts, the agent's costs relative to the expert's, and their statistics."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from agents.configuration.schema import RESERVED_SEED
from agents.evaluation.conditions import disturbance_under, scene_under
from agents.evaluation.expert_costs import (
    EVALUATION_SEEDS,
    STAGE,
    OptimalCosts,
    evaluation_seeds,
    optimal_costs,
)
from agents.evaluation.statistics import (
    Interval,
    bootstrap_interval,
    percentiles,
    rate_over_runs,
    wilson_interval,
)
from agents.policies.flying import Flights, Policy, fly, from_json_list, json_list, time_per_action
from agents.policies.policy_files import noted_effort
from agents.run_folder import starts_alike
from agents.zoo.finding import as_policy, check_fit
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.environment.rollouts import StateFeedback
from experts.executors import Executor

CHEAPER = 1e-3
"""Relative margin from which a flight counts as cheaper than the expert's."""
TAIL = 95.0
"""Percentile of the cost gap that describes the bad flights."""
_OPTIMAL = {"cost": "expert_cost", "is_success": "expert_success", "seconds": "expert_seconds"}


class Advance(NamedTuple):
    """Progress of an evaluation."""

    stage: str
    done: int  # problems, flights or time steps
    total: int

    def describe(self) -> str:
        """The progress in one line."""
        return f"{self.stage}: {self.done} of {self.total}"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Results of an agent from the evaluation starts of a scene.

    Attributes:
        policy: Its name.
        scene: Name of the scene that it was evaluated in.
        condition: One of `CONDITIONS`.
        seeds: Seeds of the episodes, shape (n,).
        flights: Outcome of each episode.
        optimal: The expert's costs from the same starts; None if not asked for.
        action_seconds: Time per action, s.
        wall_seconds: Time of all flights together, with the plans of the controllers that fly by them, s;
            flights in the cache, where those of other controllers put them too, take next to none.
        metadata: Metadata of the policy's file.
        same_scene: Whether it was trained in the scene that the condition changes; None if unknown.
    """

    policy: str
    scene: str
    condition: str
    seeds: NDArray[np.int64]
    flights: Flights
    optimal: OptimalCosts | None
    action_seconds: float
    wall_seconds: float
    metadata: dict[str, Any]
    same_scene: bool | None = None

    def __repr__(self) -> str:
        rate, gap = self.success_rate.value, self.median_cost_gap.value
        beside = "" if np.isnan(gap) else f", median cost gap {100.0 * gap:.3g} %"
        if failed := int(self.flights.policy_failed.sum()):
            beside += f"; the policy failed (gave NaN) in {failed} of {len(self.seeds)} flights"
        return (
            f"<Evaluation of {self.policy} in {self.scene!r}, {self.condition}: {len(self.seeds)} flights, "
            f"{100.0 * rate:.3g} % reach the target{beside}>"
        )

    @cached_property
    def success_rate(self) -> Interval:
        """Share of the episodes that end within the tolerances, with Wilson's interval."""
        return wilson_interval(int(self.flights.is_success.sum()), len(self.seeds))

    @cached_property
    def cost_gaps(self) -> NDArray[np.float64]:
        """J / J_expert - 1 of each episode, shape (n,); NaN where the expert's optimum is unknown."""
        if self.optimal is None:
            return np.full(len(self.seeds), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.flights.cost / self.optimal.cost - 1.0)

    @cached_property
    def valid_cost_gaps(self) -> NDArray[np.float64]:
        """Cost gaps, but inf where a flight misses the target or violates a constraint; NaN where unknown."""
        valid = self.flights.is_success & ~(self.flights.constraint_violations > 0.0)
        return np.where(valid | np.isnan(self.cost_gaps), self.cost_gaps, np.inf)

    @cached_property
    def median_cost_gap(self) -> Interval:
        """Median of the known cost gaps, with a bootstrap interval."""
        return bootstrap_interval(self._known_gaps, lambda gaps: float(np.median(gaps)))

    @cached_property
    def tail_cost_gap(self) -> Interval:
        """95th percentile of the known cost gaps, with a bootstrap interval."""
        return bootstrap_interval(
            self._known_gaps, lambda gaps: float(percentiles(gaps, TAIL)), share=TAIL / 100.0
        )

    @cached_property
    def violating_episodes(self) -> Interval:
        """Share of the episodes with a step that violates constraints, with Wilson's interval.

        See `Flights.constraint_violations`; NaN where that is unknown.
        """
        shares = self.flights.constraint_violations
        if not np.isfinite(shares).all():
            return Interval(np.nan, np.nan, np.nan)
        return wilson_interval(int((shares > 0.0).sum()), len(shares))

    @cached_property
    def constraint_violations(self) -> Interval:
        """Share of the steps that violate constraints, mean over episodes; NaN where that is unknown.

        Its interval is that of a rate: a bootstrap of a few violating flights, or of none, covers too little.
        """
        shares = self.flights.constraint_violations
        if not np.isfinite(shares).all():
            return Interval(np.nan, np.nan, np.nan)
        return rate_over_runs([shares])

    @property
    def _known_gaps(self) -> NDArray[np.float64]:
        return self.cost_gaps[~np.isnan(self.cost_gaps)]

    def summary(self) -> dict[str, Any]:
        """Summarize the evaluation as a row of JSON values, None for what is unknown.

        Returns:
            Rates and gaps with their intervals; medians of angle [deg], distance [m], effort and base turn
            [deg]; time per action [s]; and the effort of the training.
        """
        flights, spent = self.flights, noted_effort(self.metadata)
        return {
            "policy": self.policy,
            "scene": self.scene,
            "condition": self.condition,
            "episodes": len(self.seeds),
            "success_rate": list(self.success_rate),
            "median_cost_gap": known_interval(self.median_cost_gap),
            "tail_cost_gap": known_interval(self.tail_cost_gap),
            "unknown_optima": int(np.isnan(self.cost_gaps).sum()),
            "cheaper_than_expert": int((self.valid_cost_gaps < -CHEAPER).sum()),
            "expert_success_rate": None
            if self.optimal is None
            else list(wilson_interval(int(self.optimal.is_success.sum()), len(self.seeds))),
            "diverged": int(flights.diverged.sum()),
            "policy_failed": int(flights.policy_failed.sum()),
            "trained_in": self.metadata.get("scene"),
            "same_scene": self.same_scene,
            "median_cost": float(np.median(flights.cost)),
            "attitude_error": float(np.median(flights.attitude_error)),
            "position_error": float(np.median(flights.position_error)),
            "effort": float(np.median(flights.effort)),
            "base_turn": float(np.median(flights.base_turn)),
            "violating_episodes": known_interval(self.violating_episodes),
            "constraint_violations": known_interval(self.constraint_violations),
            "action_seconds": self.action_seconds,
            "wall_seconds": self.wall_seconds,
            "training_steps": spent.get("environment_steps"),
            "training_seconds": spent.get("seconds"),
            "expert_solves": spent.get("expert_solves"),
        }

    def record(self) -> dict[str, Any]:
        """The evaluation as JSON values: its summary, the policy's metadata, and columns of all episodes."""
        episodes: dict[str, Any] = {"seed": self.seeds.tolist(), **self.flights.columns()}
        if self.optimal is not None:
            for name, column in _OPTIMAL.items():
                episodes[column] = json_list(getattr(self.optimal, name))
        episodes["cost_gap"] = json_list(self.cost_gaps)
        return {"summary": self.summary(), "metadata": self.metadata, "episodes": episodes}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """The evaluation that `record` has written; KeyError, TypeError or ValueError for anything else."""
        summary, episodes = record["summary"], record["episodes"]
        seeds = np.array(episodes["seed"], dtype=np.int64)
        optimal = None
        if all(column in episodes for column in _OPTIMAL.values()):
            cost, success, seconds = (episodes[column] for column in _OPTIMAL.values())
            optimal = OptimalCosts(
                seeds, from_json_list(cost), from_json_list(success, np.bool_), from_json_list(seconds)
            )
        flights = Flights.from_columns(episodes)
        if not seeds.size or any(len(column) != len(seeds) for column in (flights.cost, *(optimal or ()))):
            raise ValueError("columns of episodes are empty, or have different lengths")
        return cls(
            policy=str(summary["policy"]),
            scene=str(summary["scene"]),
            condition=str(summary["condition"]),
            seeds=seeds,
            flights=flights,
            optimal=optimal,
            action_seconds=float(summary["action_seconds"]),
            wall_seconds=float(summary["wall_seconds"]),
            metadata=dict(record["metadata"]),
            same_scene=summary["same_scene"],
        )


def evaluate(
    policy: Any,
    scene: Scene | str | Path = "paper",
    n: int = EVALUATION_SEEDS,
    *,
    condition: str = "training",
    expert: bool = True,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str | None = None,
    trust: bool = False,
    normalize: str | Path | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Evaluation:
    """Evaluate a policy from the fixed evaluation starts of a scene.

    Args:
        policy: Name of a policy of the zoo; path of an exported policy (.npz), of a network (.onnx), of a
            Stable-Baselines3 model (.zip), or of the folder of a training run; an `ExportedPolicy`; a model;
            or a function from observations, shape (B, n_obs), to actions, fractions of the limits, shape
            (B, n_u).
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        n: Number of starts, the first ones of the 500.
        condition: Variant of the scene, one of `CONDITIONS`.
        expert: Whether to compare with the expert's costs. They are computed once for each scene, which takes
            minutes, and cached.
        workers: Number of processes that compute them; one per processor by default.
        executor: Computes them in place of these processes.
        label: Name in tables.
        trust: Whether to execute the code in a model's file (.zip) where its tensors do not suffice; only if
            you trust whoever made it.
        normalize: File of the `VecNormalize` that a Stable-Baselines3 model was trained in, as its `save`
            writes it, if the model is a file (.zip) or was loaded without it.
        progress: Called now and then.

    Returns:
        The evaluation.

    Raises:
        SceneError: If the scene cannot be loaded.
        PolicyError, PolicyFileError: If the policy is of no known kind, does not fit the scene, or cannot be
            read.
        ValueError: If an argument is out of range, or the policy's actions do not fit the scene.
    """
    acting, given = as_policy(policy, label, trust=trust, normalize=normalize), load_scene(scene)
    flown = scene_under(given, condition)
    check_fit(acting, flown)
    seeds = evaluation_seeds(flown, n)
    optimal = None
    if expert:
        optimal = optimal_costs(
            flown,
            n,
            workers=workers,
            executor=executor,
            progress=lambda done, total: progress(Advance(STAGE, done, total)),
        )
    elif n > 1 and starts_alike(flown) and not disturbance_under(condition).is_drawn:
        warnings.warn(
            f"scene {given.name!r} has no spread, so all {n} flights are the same, and their intervals tell "
            "nothing of other starts: give it a spread, or set n = 1",
            stacklevel=2,
        )
    started = perf_counter()
    flights = fly_under(
        condition,
        acting.act,
        given,
        seeds,
        lambda done, total: progress(Advance("steps of all flights", done, total)),
    )
    wall_seconds, made_in = perf_counter() - started, acting.metadata.get("scene_hash")
    return Evaluation(
        policy=acting.label,
        scene=flown.name,
        condition=condition,
        seeds=np.array(seeds, dtype=np.int64),
        flights=flights,
        optimal=optimal,
        action_seconds=time_per_action(acting.act_once, flown, batched=acting.batched),
        wall_seconds=wall_seconds,
        metadata=dict(acting.metadata),
        same_scene=None if made_in is None else bool(made_in == given.content_hash()),
    )


def fly_under(
    condition: str,
    policy: Policy | StateFeedback,
    scene: Scene,
    seeds: Sequence[int],
    progress: Callable[[int, int], None] = lambda step, steps: None,
) -> Flights:
    """Fly in a scene under a condition, from some of its evaluation starts.

    Noise and pushes of a flight depend on its start alone: all policies meet the same.
    """
    disturbance = disturbance_under(condition)
    numbers = {seed: number for number, seed in enumerate(evaluation_seeds(scene))}
    flights = [numbers[seed] for seed in seeds]
    disturbances = disturbance.drawn(scene, flights, EVALUATION_SEEDS, RESERVED_SEED)
    flown, delay = scene_under(scene, condition), disturbance.steps(scene)
    return fly(policy, flown, seeds, progress, disturbances=disturbances, delay=delay)


def known_interval(interval: Interval) -> list[float | None] | None:
    """An interval as JSON values; None if it is NaN, and for bounds that are."""
    found = [None if np.isnan(each) else each for each in interval]
    return None if found[0] is None else found
