"""Optimal costs from the evaluation starts, computed once per scene and cached.

The expert solves them in groups, as it does demonstrations, and each group is written as soon as it is
solved: an interrupted computation resumes with the next group.
"""

from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.configuration.schema import RESERVED_SEED
from agents.evaluation.kept_results import CachedGroups, Row
from agents.run_folder import VALIDATION_SEED, starts_alike, validation_seeds
from dq_space_arm_env import Scene
from experts.demonstrations.outcomes import MISSED_TARGET, REASONS
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.shard import ShardResult, Task
from experts.executors import Executor, local_executor

EVALUATION_SEEDS = 500
"""Evaluation seeds of a scene."""
GROUP = 25
"""Problems that are solved, compared with each other, and written together."""
STAGE = f"optimal costs, {GROUP} at a time"
"""Name of the work in messages on its progress."""
KIND = "optimal-costs"
"""Folder of the cached rows. Their key has the expert's code, not this file's: where `cost_rows` gives rows
another meaning, append "/2", or rows of the old meaning are read."""


class OptimalCosts(NamedTuple):
    """Costs of the expert from n starts.

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

    def first(self, n: int) -> "OptimalCosts":
        """Costs from the first n starts."""
        return OptimalCosts(self.seeds[:n], self.cost[:n], self.is_success[:n], self.seconds[:n])

    @classmethod
    def of(cls, rows: list[Row]) -> "OptimalCosts":
        """Costs from cached rows."""
        return cls(
            np.array([row["seed"] for row in rows], dtype=np.int64),
            np.array([np.nan if row["cost"] is None else row["cost"] for row in rows], dtype=np.float64),
            np.array([row["is_success"] for row in rows], dtype=np.bool_),
            np.array([row["seconds"] for row in rows], dtype=np.float64),
        )


def evaluation_seeds(scene: Scene, n: int = EVALUATION_SEEDS) -> list[int]:
    """Give the evaluation seeds of a scene; never train or tune on them.

    Args:
        scene: The scene. Scenes that draw targets or masses have the same seeds.
        n: Number of seeds, the first ones.

    Returns:
        The seeds.

    Raises:
        ValueError: If n is no whole number in [1, EVALUATION_SEEDS].
    """
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or not 1 <= n <= EVALUATION_SEEDS:
        raise ValueError(f"n: {n!r}, should be from 1 to {EVALUATION_SEEDS}, the number of evaluation seeds")
    settings = Settings(scene, EVALUATION_SEEDS, RESERVED_SEED, GROUP)
    return [settings.problem_seed(problem) for problem in range(n)]


def optimal_costs(
    scene: Scene,
    n: int = EVALUATION_SEEDS,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] = lambda done, problems: None,
) -> OptimalCosts:
    """Look up the expert's costs from the evaluation starts; solve those that are missing.

    Args:
        scene: The scene.
        n: Number of starts, the first ones.
        workers: Number of processes; one per processor by default.
        executor: Used instead of local processes.
        progress: Called at the beginning and after each group with the number of problems solved and of all.

    Returns:
        The costs.

    Raises:
        ValueError: If n is out of range, or the scene does not suit demonstrations, see
            `generate_demonstrations`.
        DemonstrationsError: If processes are killed again and again; solved groups remain.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    evaluation_seeds(scene, n)  # refuses a wrong n
    return _look_up(evaluation_settings(scene), n, executor or local_executor(workers), progress)


def validation_costs(
    scene: Scene,
    n: int,
    executor: Executor,
    progress: Callable[[int, int], None] = lambda done, problems: None,
) -> OptimalCosts:
    """Likewise from the first n validation starts, which learning curves are flown from."""
    problems = GROUP * -(-max(n, EVALUATION_SEEDS) // GROUP)  # a group is kept whole
    settings = _ValidationStarts.of(scene, problems, VALIDATION_SEED, GROUP)
    return _look_up(settings, n, executor, progress)


class _ValidationStarts(Settings):
    """Settings whose problems begin at validation starts."""

    def problem_seed(self, problem: int) -> int:
        return validation_seeds(problem + 1)[problem]


def _look_up(
    settings: Settings, n: int, executor: Executor, progress: Callable[[int, int], None]
) -> OptimalCosts:
    files = cost_files(settings, n)
    progress(min(n, len(files.rows)), n)
    if files.missing:
        tasks = (Task(settings, group) for group in files.missing)
        with closing(executor.run(tasks)) as results:
            for result in results:
                files.add(result.shard, cost_rows(result))
                progress(min(n, len(files.rows)), n)
    return OptimalCosts.of(files.rows[:n])


def evaluation_settings(scene: Scene) -> Settings:
    """Settings of demonstrations from the evaluation starts; ValueError if the scene does not suit them."""
    if starts_alike(scene):
        raise ValueError(
            f"scene {scene.name!r} has no spread, so all evaluation starts are the same: give it a spread, "
            "or evaluate without the expert (expert=False, --no-expert)"
        )
    return Settings.of(scene, EVALUATION_SEEDS, RESERVED_SEED, GROUP)


def group_seeds(settings: Settings, n: int, size: int = GROUP) -> list[int]:
    """Seeds of whole groups of evaluation starts, enough for the first n."""
    return [settings.problem_seed(problem) for problem in range(-(-n // size) * size)]


def cost_files(settings: Settings, n: int = 0) -> CachedGroups:
    """Cached costs of the groups with the first n starts."""
    content = {
        "scene": settings.scene.content_hash(),
        "problems": settings.n,
        "seed": settings.seed,
        "group": settings.shard_size,
        **software(),
    }
    columns = ("seed", "cost", "is_success", "seconds")
    return CachedGroups(KIND, content, columns, group_seeds(settings, n), GROUP)


def cost_rows(result: ShardResult) -> list[Row]:
    """Costs in a solved group: a row for each problem, in their order."""
    from safetensors.numpy import load

    arrays = load(result.content)
    rows: dict[int, Row] = {
        int(index): {"seed": int(seed), "cost": float(cost), "is_success": True}
        for index, seed, cost in zip(arrays["index"], arrays["seed"], arrays["cost"], strict=True)
    }
    failures = (arrays[f"failures.{name}"] for name in ("index", "seed", "cost", "stop_reason"))
    for index, seed, cost, reason in zip(*failures, strict=True):
        # Where the target is out of reach, the optimum misses it, and is the optimum all the same.
        is_optimum = REASONS[reason] == MISSED_TARGET
        rows[int(index)] = {
            "seed": int(seed),
            "cost": float(cost) if is_optimum else None,
            "is_success": False,
        }
    first = min(rows)
    return [row | {"seconds": result.solve_seconds[index - first]} for index, row in sorted(rows.items())]
