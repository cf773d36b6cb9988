"""The expert's costs from the starts that agents are evaluated on, computed once for each scene and kept.

They lie in the cache folder, under a name that scene, seeds and code give. They are solved in groups, as
demonstrations are, and each group is written as soon as it is there: what is interrupted goes on.
"""

from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.cached_groups import CachedGroups, Row, known_groups
from dq_space_arm_env import Scene
from experts.demonstrations.executors import Executor, local_executor
from experts.demonstrations.outcomes import MISSED_TARGET, REASONS
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.shard import ShardResult, Task

EVALUATION_SEEDS = 500
"""Evaluation seeds of a scene."""
SEED_OF_SEEDS = 20180627
"""What they follow from; a data set of demonstrations with this seed would hold the answers."""
GROUP = 25
"""Problems that are solved, compared with each other, and written together."""


class OptimalCosts(NamedTuple):
    """What the expert pays, from n starts.

    Attributes:
        seeds: `env.reset(seed=seed)` starts there, shape (n,).
        cost: J of the best maneuver found, shape (n,), dimensionless; NaN where the expert found no optimum.
        is_success: Whether it ends within the scene's tolerances, shape (n,).
        seconds: Time to solve it, shape (n,), s.
    """

    seeds: NDArray[np.int64]
    cost: NDArray[np.float64]
    is_success: NDArray[np.bool_]
    seconds: NDArray[np.float64]


def evaluation_seeds(scene: Scene, n: int = EVALUATION_SEEDS) -> list[int]:
    """Give the seeds that agents are evaluated on; nothing may be trained or tuned on them.

    Args:
        scene: The scene. Those that draw target or masses have the same seeds.
        n: How many, the first ones.

    Returns:
        The seeds.

    Raises:
        ValueError: If n is not in [1, EVALUATION_SEEDS].
    """
    if not 1 <= n <= EVALUATION_SEEDS:
        raise ValueError(f"n: {n}, should be from 1 to {EVALUATION_SEEDS}, the number of evaluation seeds")
    settings = Settings(scene, EVALUATION_SEEDS, SEED_OF_SEEDS, GROUP)
    return [settings.problem_seed(problem) for problem in range(n)]


def optimal_costs(
    scene: Scene,
    n: int = EVALUATION_SEEDS,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] = lambda done, problems: None,
) -> OptimalCosts:
    """Look up what the expert pays from the evaluation starts; solve what is not there yet.

    Args:
        scene: The scene.
        n: How many starts, the first ones.
        workers: Number of processes; one for each processor by default.
        executor: Who solves, in place of processes.
        progress: Called at the beginning and after each group with the number of problems solved, and of all.

    Returns:
        The costs.

    Raises:
        ValueError: If n is out of range, or the scene is not one for demonstrations, see
            `generate_demonstrations`.
        DemonstrationsError: If processes are killed again and again. What is solved remains.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    seeds = evaluation_seeds(scene, n)
    settings = evaluation_settings(scene)
    files = _files(settings)
    groups, missing = known_groups(files, range(-(-n // GROUP)), lambda group: group_seeds(settings, group))
    _report(progress, groups, n)
    if missing:
        tasks = (Task(settings, group) for group in missing)
        with closing((executor or local_executor(workers)).run(tasks)) as results:
            for result in results:
                groups[result.shard] = keep_costs(settings, result)
                _report(progress, groups, n)
    rows = [row for group in sorted(groups) for row in groups[group]][:n]
    assert [row["seed"] for row in rows] == seeds
    return OptimalCosts(
        np.array(seeds, dtype=np.int64),
        np.array([np.nan if row["cost"] is None else row["cost"] for row in rows], dtype=np.float64),
        np.array([row["is_success"] for row in rows], dtype=np.bool_),
        np.array([row["seconds"] for row in rows], dtype=np.float64),
    )


def evaluation_settings(scene: Scene) -> Settings:
    """The evaluation starts of a scene as problems for the expert.

    Args:
        scene: The scene.

    Returns:
        What its demonstrations from there would follow from.

    Raises:
        ValueError: If the scene is not one for demonstrations, see `generate_demonstrations`.
    """
    return Settings.of(scene, EVALUATION_SEEDS, SEED_OF_SEEDS, GROUP)


def group_seeds(settings: Settings, group: int) -> list[int]:
    """Give the seeds of a group of evaluation starts.

    Args:
        settings: Those of `evaluation_settings`.
        group: Number of the group.

    Returns:
        The seeds.
    """
    return [settings.problem_seed(problem) for problem in settings.problems(group)]


def keep_costs(settings: Settings, result: ShardResult) -> list[Row]:
    """Keep what the expert pays from a group of evaluation starts, however it came to be solved.

    Args:
        settings: Those of `evaluation_settings`.
        result: The group, solved.

    Returns:
        What is kept, a row for each start.

    Raises:
        OSError: If it cannot be written.
    """
    rows = _summary(result)
    _files(settings).write(result.shard, rows)
    return rows


def _files(settings: Settings) -> CachedGroups:
    content = {
        "scene": settings.scene.content_hash(),
        "problems": settings.n,
        "seed": settings.seed,
        "group": settings.shard_size,
        **software(),
    }
    return CachedGroups("optimal-costs", content, ("seed", "cost", "is_success", "seconds"))


def _summary(result: ShardResult) -> list[Row]:
    """What is worth keeping of a shard of demonstrations: a line for each problem, in their order."""
    from safetensors.numpy import load

    arrays = load(result.content)
    rows: dict[int, Row] = {
        int(index): {"seed": int(seed), "cost": float(cost), "is_success": True}
        for index, seed, cost in zip(arrays["index"], arrays["seed"], arrays["cost"], strict=True)
    }
    failures = (arrays[f"failures.{name}"] for name in ("index", "seed", "cost", "stop_reason"))
    for index, seed, cost, reason in zip(*failures, strict=True):
        # Where the target is out of reach the optimum misses it, and is the optimum all the same.
        is_optimum = REASONS[reason] == MISSED_TARGET
        rows[int(index)] = {
            "seed": int(seed),
            "cost": float(cost) if is_optimum else None,
            "is_success": False,
        }
    first = min(rows)
    return [row | {"seconds": result.solve_seconds[index - first]} for index, row in sorted(rows.items())]


def _report(progress: Callable[[int, int], None], groups: dict[int, list[Row]], n: int) -> None:
    progress(min(n, sum(len(rows) for rows in groups.values())), n)
