"""The arrays of a shard: M demonstrations and F failures, N stages.

| array | shape | meaning |
|---|---|---|
| `states` | (M, N + 1, n_x) | states of the environment, units of the state |
| `observations` | (M, N + 1, n_obs) | what it shows of them |
| `actions` | (M, N, n_u) | inputs as fractions of their limits, in [-1, 1] |
| `rewards` | (M, N) | what it charges; their sum is minus the cost |
| `feedback_gains` | (M, N, n_u, n_t) | float32: change of the action per deviation in tangent coordinates |
| `index`, `seed` | (M,) | number of the problem; `env.reset(seed=seed)` starts where it does |
| `cost` | (M,) | J, dimensionless |
| `iterations`, `stop_reason` | (M,) | of the solve; the latter is an index into `REASONS` |
| `guess` | (M,) | what the solve began with, an index into `GUESSES` |
| `emphasis` | (M,) | factor of the final pose's weights, see `experts.reaching` |
| `start_errors`, `final_errors` | (M, 2) | of the tip: attitude [deg] and position [m] |
| `clamped_share` | (M,) | share of the inputs, over all stages, that are at a limit |
| `failures.index`, `.seed`, `.stop_reason`, `.cost` | (F,) | of what is no demonstration |
| `failures.start` | (F, n_x) | state at stage 0, units of the state |
| `failures.final_errors` | (F, 2) | as planned |

Gains are control-limited: rows of inputs at a limit are zero.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experts.arm_problem import ArmProblem
from experts.demonstrations.episodes import Episodes
from experts.demonstrations.outcomes import GUESSES, REASONS, Outcome
from experts.problem import FloatArray

TRAJECTORIES = ("states", "observations", "actions", "rewards", "feedback_gains")
"""Arrays with a row for each stage."""
SUMMARIES = (
    "index",
    "seed",
    "cost",
    "iterations",
    "stop_reason",
    "guess",
    "emphasis",
    "start_errors",
    "final_errors",
    "clamped_share",
)
"""Arrays with a few numbers for each demonstration."""
FAILURES = ("index", "seed", "stop_reason", "cost", "start", "final_errors")
"""Arrays with a few numbers for each failure."""
NOTES = {"guesses": GUESSES, "reasons": REASONS}

Arrays = dict[str, NDArray[Any]]


def actions_of(problem: ArmProblem, outcomes: Sequence[Outcome]) -> FloatArray:
    """Controls as the environment takes them.

    Args:
        problem: The problem.
        outcomes: M of them.

    Returns:
        Inputs as fractions of their limits, shape (M, N, n_u).
    """
    actions = np.empty((len(outcomes), problem.horizon, problem.n_controls))
    for row, outcome in zip(actions, outcomes, strict=True):
        np.divide(outcome.solution.controls, problem.control_upper, out=row)
    return actions


def demonstration_arrays(
    problem: ArmProblem, outcomes: Sequence[Outcome], actions: FloatArray, episodes: Episodes
) -> Arrays:
    """Everything about demonstrations.

    Args:
        problem: The problem.
        outcomes: M good ones.
        actions: Shape (M, N, n_u).
        episodes: What they do in the environment.

    Returns:
        Arrays by name.
    """
    gains = np.empty((*actions.shape, problem.n_tangent), dtype=np.float32)
    for row, outcome in zip(gains, outcomes, strict=True):
        np.divide(
            outcome.solution.feedback_gains,
            problem.control_upper[:, None],
            out=row,
            casting="same_kind",
        )
    return {
        "states": episodes.states,
        "observations": episodes.observations,
        "actions": actions,
        "rewards": episodes.rewards,
        "feedback_gains": gains,
        **_common(outcomes),
        "iterations": np.array([outcome.solution.iterations for outcome in outcomes], dtype=np.int64),
        "guess": np.array([GUESSES.index(outcome.guess) for outcome in outcomes], dtype=np.uint8),
        "emphasis": np.array(
            [outcome.solution.metadata["emphasis"] for outcome in outcomes], dtype=np.float64
        ),
        "start_errors": episodes.start_errors,
        "final_errors": episodes.final_errors,
        "clamped_share": np.mean(np.abs(actions) == 1.0, axis=(1, 2)),
    }


def failure_arrays(problem: ArmProblem, outcomes: Sequence[Outcome]) -> Arrays:
    """Everything about failures.

    Args:
        problem: The problem.
        outcomes: F of them, not good.

    Returns:
        Arrays by name.
    """
    ends = np.array([outcome.solution.states[-1] for outcome in outcomes]).reshape(-1, problem.n_states)
    starts = np.array([outcome.start for outcome in outcomes]).reshape(-1, problem.n_states)
    errors = np.zeros((0, 2))
    if outcomes:
        errors = problem.kernels.observation(ends, np.zeros((len(ends), 1)))[1]
        errors = np.stack([np.degrees(errors[:, 0]), errors[:, 1]], axis=1)
    arrays = {**_common(outcomes), "start": starts, "final_errors": errors}
    return {f"failures.{name}": array for name, array in arrays.items()}


def _common(outcomes: Sequence[Outcome]) -> Arrays:
    return {
        "index": np.array([outcome.index for outcome in outcomes], dtype=np.int64),
        "seed": np.array([outcome.seed for outcome in outcomes], dtype=np.int64),
        "cost": np.array([outcome.solution.cost for outcome in outcomes], dtype=np.float64),
        "stop_reason": np.array([REASONS.index(outcome.reason) for outcome in outcomes], dtype=np.uint8),
    }
