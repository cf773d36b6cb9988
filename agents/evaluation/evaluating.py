"""The evaluation protocol: fixed starts, the expert's costs beside the agent's, and what follows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.conditions import scene_under
from agents.evaluation.expert_costs import EVALUATION_SEEDS, OptimalCosts, evaluation_seeds, optimal_costs
from agents.evaluation.flights import Flights, fly, time_per_action
from agents.evaluation.policies import as_policy, check_fit
from agents.evaluation.statistics import Interval, bootstrap_interval, wilson_interval
from dq_space_arm_env import Scene, load_scene
from experts.demonstrations.executors import Executor

CHEAPER = 1e-3
"""Share by which a flight has to be cheaper than the expert's to count as such."""
TAIL = 95.0
"""Percentile of the cost gap that tells how bad the bad flights are."""


class Advance(NamedTuple):
    """How far an evaluation has come.

    Attributes:
        stage: What is being done: "optimal costs" or "flights".
        done: How much of it: problems, or time steps.
        total: Of how much.
    """

    stage: str
    done: int
    total: int


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How an agent does on the evaluation starts of a scene.

    Attributes:
        policy: What it is called.
        scene: Name of the scene that it was evaluated on.
        condition: Which of `CONDITIONS`.
        seeds: Of the episodes, shape (n,).
        flights: What became of each episode.
        optimal: What the expert pays from the same starts; None if nobody asked.
        action_seconds: Median time for one action, s.
        wall_seconds: Time that all the flights took together, s.
        metadata: How the policy came about, as its file says.
        same_scene: Whether it was trained in the scene that the condition changes; None if nobody knows.
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

    @cached_property
    def success_rate(self) -> Interval:
        """Share of the episodes that end within the tolerances, with Wilson's interval."""
        return wilson_interval(int(self.flights.is_success.sum()), len(self.seeds))

    @cached_property
    def cost_gaps(self) -> NDArray[np.float64]:
        """J / J_expert - 1 of each episode, shape (n,); NaN where the expert's optimum is not known."""
        if self.optimal is None:
            return np.full(len(self.seeds), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.flights.cost / self.optimal.cost - 1.0)

    @cached_property
    def median_cost_gap(self) -> Interval:
        """Median of the known cost gaps, with a bootstrap interval."""
        return bootstrap_interval(_known(self.cost_gaps), _median)

    @cached_property
    def tail_cost_gap(self) -> Interval:
        """95th percentile of the known cost gaps, with a bootstrap interval."""
        return bootstrap_interval(_known(self.cost_gaps), _tail)

    def summary(self) -> dict[str, Any]:
        """Put the evaluation into numbers.

        Returns:
            JSON values, None for what is not known: rates and gaps with their intervals; medians of angle
            [deg], distance [m], effort and base turn [deg]; the time of an action [s]; and what the training
            took.
        """
        flights, training = self.flights, self.metadata.get("training", {})
        return {
            "policy": self.policy,
            "scene": self.scene,
            "condition": self.condition,
            "episodes": len(self.seeds),
            "success_rate": list(self.success_rate),
            "median_cost_gap": _finite(self.median_cost_gap),
            "tail_cost_gap": _finite(self.tail_cost_gap),
            "unknown_optima": int(np.isnan(self.cost_gaps).sum()),
            "cheaper_than_expert": int((flights.is_success & (self.cost_gaps < -CHEAPER)).sum()),
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
            "action_seconds": self.action_seconds,
            "wall_seconds": self.wall_seconds,
            "training_steps": training.get("environment_steps"),
            "training_seconds": training.get("seconds"),
            "expert_solves": training.get("expert_solves"),
        }


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
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Evaluation:
    """Evaluate a policy on the fixed evaluation starts of a scene.

    Args:
        policy: Name of a policy of the zoo; path of an exported policy (.npz), of a model of
            Stable-Baselines3 (.zip), or of the folder of a training run; an `ExportedPolicy`; a model; or a
            function of observations, see `agents.evaluation.flights.fly`.
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        n: Number of starts, the first ones of the 500.
        condition: What is changed in the scene, one of `CONDITIONS`.
        expert: Whether to compare with the expert's costs. They are computed once for each scene, which takes
            minutes, and kept.
        workers: Number of processes that compute them; one for each processor by default.
        executor: Who computes them, in place of processes.
        label: What tables call the policy.
        progress: Called now and then.

    Returns:
        The evaluation.

    Raises:
        SceneError: If the scene cannot be loaded.
        PolicyError, PolicyFileError: If the policy is none, does not fit the scene, or its file cannot be
            read.
        ValueError: If an argument is out of range; if the expert is asked for in a scene that draws targets
            or masses, which it cannot solve in bulk; if the policy's actions do not fit the scene.
    """
    acting, given = as_policy(policy, label), load_scene(scene)
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
            progress=lambda done, total: progress(Advance("optimal costs", done, total)),
        )
    started = perf_counter()
    flights = fly(acting.act, flown, seeds, lambda done, total: progress(Advance("flights", done, total)))
    wall_seconds = perf_counter() - started
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
        same_scene=_is_scene_of(acting.metadata, given),
    )


def _is_scene_of(metadata: Mapping[str, Any], scene: Scene) -> bool | None:
    """Whether metadata are those of a policy that was trained in a scene; None if they do not say."""
    made_in = metadata.get("scene_hash")
    return None if made_in is None else bool(made_in == scene.content_hash())


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values[~np.isnan(values)]


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values))


def _tail(values: NDArray[np.float64]) -> float:
    return float(np.percentile(values, TAIL))


def _finite(interval: Interval) -> list[float] | None:
    return None if np.isnan(interval.value) else list(interval)
