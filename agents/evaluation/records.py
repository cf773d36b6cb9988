"""Evaluations as JSON values, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.evaluating import Evaluation
from agents.evaluation.expert_costs import OptimalCosts
from agents.evaluation.flights import Flights

_OPTIMAL = {"cost": "expert_cost", "is_success": "expert_success", "seconds": "expert_seconds"}


def evaluation_record(evaluation: Evaluation) -> dict[str, Any]:
    """Write an evaluation down.

    Args:
        evaluation: The evaluation.

    Returns:
        JSON values: its summary, the policy's metadata, and a column for everything known of each episode.
    """
    episodes: dict[str, Any] = {"seed": evaluation.seeds.tolist(), **flights_columns(evaluation.flights)}
    if evaluation.optimal is not None:
        for name, column in _OPTIMAL.items():
            episodes[column] = _listed(getattr(evaluation.optimal, name))
    episodes["cost_gap"] = _listed(evaluation.cost_gaps)
    return {"summary": evaluation.summary(), "metadata": evaluation.metadata, "episodes": episodes}


def evaluation_of(record: Mapping[str, Any]) -> Evaluation:
    """Read an evaluation that `evaluation_record` has written.

    Args:
        record: What was written.

    Returns:
        The evaluation.

    Raises:
        KeyError, TypeError, ValueError: If it is something else.
    """
    summary, episodes = record["summary"], record["episodes"]
    seeds = np.array(episodes["seed"], dtype=np.int64)
    optimal = None
    if all(column in episodes for column in _OPTIMAL.values()):
        optimal = OptimalCosts(
            seeds,
            _array(episodes["expert_cost"], np.float64),
            _array(episodes["expert_success"], np.bool_),
            _array(episodes["expert_seconds"], np.float64),
        )
    return Evaluation(
        policy=str(summary["policy"]),
        scene=str(summary["scene"]),
        condition=str(summary["condition"]),
        seeds=seeds,
        flights=flights_of(episodes),
        optimal=optimal,
        action_seconds=float(summary["action_seconds"]),
        wall_seconds=float(summary["wall_seconds"]),
        metadata=dict(record["metadata"]),
        same_scene=summary["same_scene"],
    )


def flights_columns(flights: Flights) -> dict[str, list[Any]]:
    """Write flights down.

    Args:
        flights: The flights, B of them.

    Returns:
        JSON values: a list of length B for each attribute, None for numbers that are not finite.
    """
    return {name: _listed(values) for name, values in flights._asdict().items()}


def flights_of(columns: Mapping[str, list[Any]]) -> Flights:
    """Read flights that `flights_columns` has written.

    Args:
        columns: What was written; others may stand beside.

    Returns:
        The flights.

    Raises:
        KeyError, TypeError, ValueError: If something is missing or no number.
    """
    kinds = {"is_success": np.bool_, "diverged": np.bool_, "policy_failed": np.bool_, "length": np.int64}
    return Flights(**{name: _array(columns[name], kinds.get(name, np.float64)) for name in Flights._fields})


def _listed(values: NDArray[Any]) -> list[Any]:
    listed = values.tolist()
    return [value if np.isfinite(value) else None for value in listed]


def _array(values: list[Any], kind: Any) -> NDArray[Any]:
    return np.array([np.nan if value is None else value for value in values], dtype=kind)
