"""Fly entrants in all tasks of a suite: controllers of the expert, agents trained for it, policies."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.configuration import AgentConfiguration, list_configurations
from agents.evaluation.comparing import Row, compare
from agents.evaluation.conditions import scene_under
from agents.evaluation.evaluating import Advance as Step
from agents.evaluation.evaluating import known_interval
from agents.evaluation.plan_followers import CONTROLLERS
from agents.evaluation.statistics import Interval, gap_over_runs, performance_profile, rate_over_runs
from agents.experiments.many_trainings import train_seeds, training_executor, training_task
from agents.experiments.training_task import FAILED
from agents.run_folder import POLICY
from agents.suite.tasks import ZOO, Limits, Suite, SuiteError, load_suite
from agents.zoo.finding import ActingPolicy, PolicyError, as_policy, check_fit, policy_path
from agents.zoo.shelf import list_policies, load_policy
from dq_space_arm_env import Scene
from dq_space_arm_env.common.progress import Advance
from experts.executors import Executor, local_executor

TASK = "{task}"
"""In the path of a policy: the name of a task."""
TRAININGS = "trainings"
_ONE_NAME = "entrants: two are named {!r}; put another name and = before the path of one"
_NAMED = re.compile(r"([\w.-]+)=(.+)")
Report = Callable[[Advance], None]


@dataclass(frozen=True, eq=False)
class Score:
    """An entrant in a task under a condition."""

    task: str
    condition: str
    entrant: str
    rows: tuple[Row, ...]  # one for each training, from the same starts

    @cached_property
    def success_rate(self) -> Interval:
        """Share of the flights that reach the target."""
        return rate_over_runs([row.evaluation.flights.is_success for row in self.rows])

    @cached_property
    def violating(self) -> Interval | None:
        """Share of the flights that violate a constraint at some step; None in a scene without."""
        return rate_over_runs(self._violates) if np.isfinite(self._shares).all() else None

    @cached_property
    def cost_gap(self) -> Interval:
        """Interquartile mean of J / J_expert - 1 over trainings and starts; NaN if it is not known."""
        return gap_over_runs([row.evaluation.cost_gaps for row in self.rows])

    def within(self, gaps: ArrayLike) -> list[Interval]:
        """Shares of the flights that reach the target within cost gaps and violate nothing."""
        return performance_profile([row.evaluation.valid_cost_gaps for row in self.rows], gaps)

    def solves(self, limits: Limits) -> bool:
        """Whether the entrant keeps to the limits of the suite; estimates count, not their intervals."""
        violating = None if self.violating is None else self.violating.value
        return limits.are_kept(self.success_rate.value, violating, self.cost_gap.value)

    def record(self, limits: Limits) -> dict[str, Any]:
        """The score as a row of JSON values."""
        summaries = [row.evaluation.summary() for row in self.rows]

        def mean(name: str) -> float | None:
            known = [each[name] for each in summaries if each[name] is not None]
            return float(np.mean(known)) if known else None

        tails = np.concatenate([row.evaluation.cost_gaps for row in self.rows])
        return {
            "task": self.task,
            "condition": self.condition,
            "entrant": self.entrant,
            "runs": len(self.rows),
            "episodes": summaries[0]["episodes"],
            "solved": self.solves(limits),
            "success_rate": list(self.success_rate),
            "interquartile_mean_cost_gap": known_interval(self.cost_gap),
            "tail": None if np.isnan(tails).all() else float(np.nanpercentile(tails, 95.0)),
            "unknown_optima": summaries[0]["unknown_optima"],  # starts that gaps and profiles leave out
            "violating_episodes": None if self.violating is None else list(self.violating),
            "action_seconds": float(np.median([each["action_seconds"] for each in summaries])),
            "planning_seconds": self.rows[0].facts["planning_seconds"],
            "training_seconds": mean("training_seconds"),
            "training_commits": self._commits or None,  # a folder may hold trainings of an earlier one
            "commands": [row.facts["evaluation_command"] for row in self.rows],
        }

    @property
    def _commits(self) -> list[str]:
        """Hashes of the commits that the policies were trained at, as far as they tell, sorted."""
        origins = [row.evaluation.metadata.get("provenance") or {} for row in self.rows]
        commits = [origin.get("commit") or {} for origin in origins]
        return sorted({str(commit["hash"]) for commit in commits if "hash" in commit})

    @property
    def _shares(self) -> NDArray[np.float64]:
        return np.array([row.evaluation.flights.constraint_violations for row in self.rows])

    @property
    def _violates(self) -> NDArray[np.bool_]:
        return np.nan_to_num(self._shares) > 0.0


@dataclass(frozen=True, eq=False)
class SuiteRun:
    """Entrants in the tasks of a suite."""

    suite: Suite
    scores: tuple[Score, ...]  # task by task
    descriptions: Mapping[str, str]  # of the tasks
    notes: tuple[str, ...]  # what is missing, and why

    @property
    def entrants(self) -> tuple[str, ...]:
        """Names of the entrants."""
        return tuple(dict.fromkeys(score.entrant for score in self.scores))

    def of(self, entrant: str, condition: str) -> tuple[Score, ...]:
        """Scores of an entrant under a condition, task by task."""
        return tuple(each for each in self.scores if (each.entrant, each.condition) == (entrant, condition))


def run_suite(
    entrants: Sequence[str] = (),
    suite: str | Path | Suite = "v1",
    *,
    policies: Mapping[str, Callable[[Scene], Any]] = MappingProxyType({}),
    tasks: Sequence[str] = (),
    seeds: int | None = None,
    out: Path = Path("results") / "suite",
    workers: int | None = None,
    executor: Executor | None = None,
    trust: bool = False,
    progress: Report = lambda advance: None,
) -> SuiteRun:
    """Train and fly entrants in the tasks of a suite, and compare all flights with the expert's optima.

    Args:
        entrants: Any of these. A controller of the expert, one of `CONTROLLERS`. An agent that is trained for
            each task: one of the suite's, the name of a shipped configuration, or a YAML file. "zoo". The
            path of a policy, as for `evaluate`, with "{task}" in it where each task has its own, and with
            "name=" before it for the tables; others fly where they fit. All that ship with the package by
            default, unless policies are given.
        suite: A version of the suite, or a YAML file.
        policies: Further policies by name: a function that gives, for the scene of a task, what `evaluate`
            takes, such as a function from observations, shape (B, n_obs), to actions, shape (B, n_u).
        tasks: Some of its tasks; all by default.
        seeds: Trainings of each agent and task; as the suite says by default.
        out: Folder of trainings and finished rows; those found there are not made again.
        workers: Number of processes; one per processor by default.
        executor: Used instead of local processes.
        trust: Whether to execute the code in a model's file (.zip) where its tensors do not suffice.
        progress: Called now and then.

    Returns:
        The scores.

    Raises:
        SuiteError: If the suite or a task is not what it should be, two entrants have one name, or nobody can
            fly.
        ConfigurationError, PolicyError, PolicyFileError: If an entrant cannot be used.
        ValueError: If a condition does not suit a task.
        DemonstrationsError: If processes of the expert are killed again and again; finished rows remain.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    chosen = load_suite(suite)
    scenes = {task: chosen.scene(task) for task in tasks or chosen.tasks}
    for scene in scenes.values():
        for condition in chosen.conditions:
            scene_under(scene, condition)  # refuses one that the scene cannot have before anybody flies
    if not entrants and not policies:
        entrants = (*CONTROLLERS, *chosen.agents, ZOO)
    controllers, agents, files = _sorted_out(entrants, chosen)
    _check_names([*_names(controllers, agents, files), *policies])
    fliers = {task: [*_from_files(files, task, scene, trust)] for task, scene in scenes.items()}
    for task, scene in scenes.items():
        made = [(name, as_policy(make(scene), name)) for name, make in policies.items()]
        for _, acting in made:
            check_fit(acting, scene)  # before anything is trained
        fliers[task] += made
    fitting = {name for found in fliers.values() for name, _ in found}
    for name, path in files.items():
        if name not in fitting and name != ZOO:
            why = "there is no such file" if TASK in path else "fits no task"
            raise SuiteError(f"{path}: {why}, whichever the task")
    if not (controllers or agents or fitting):
        raise SuiteError(f"{ZOO}: no policy that ships was trained in {', '.join(scenes)}: nobody can fly")
    plans = {(agent, task): chosen.training(agent, task) for agent in agents for task in scenes}
    notes = [*_missing(files, scenes)]
    trained = _train(
        plans, chosen.seeds if seeds is None else seeds, out / TRAININGS, executor, workers, progress, notes
    )
    scores: list[Score] = []
    for number, task in enumerate(scenes, 1):

        def announce(step: Step, task: str = task, number: int = number) -> None:
            progress(step._replace(stage=f"{task} ({number} of {len(scenes)}), {step.stage}"))

        own = [(agent_name(agent), path) for agent in agents for path in trained[agent, task]]
        place, working = out / Path(task).stem, executor or local_executor(workers)
        scores += _fly(chosen, task, controllers, [*own, *fliers[task]], place, working, trust, announce)
    described = {task: scene.description for task, scene in scenes.items()}
    return SuiteRun(chosen, tuple(scores), described, tuple(notes))


def _fly(
    suite: Suite,
    task: str,
    controllers: Sequence[str],
    policies: Sequence[tuple[str, Any]],
    out: Path,
    executor: Executor,
    trust: bool,
    progress: Callable[[Step], None],
) -> Iterator[Score]:
    """Fly controllers and policies by name in a task, under all conditions; runs of a name together."""
    if not (policies or controllers):
        return
    found = compare(
        [policy for _, policy in policies],
        task,
        suite.starts,
        controllers=controllers,
        conditions=suite.conditions,
        receding_starts=min(suite.receding_starts, suite.starts),
        out=out,
        learning_curves=False,
        executor=executor,
        trust=trust,
        progress=progress,
    )
    names = [*(CONTROLLERS[each] for each in controllers), *(name for name, _ in policies)]
    for condition in suite.conditions:
        flown = list(zip(names, found.under(condition), strict=True))
        for name in dict.fromkeys(names):
            yield Score(task, condition, name, tuple(row for each, row in flown if each == name))


def agent_name(agent: str) -> str:
    """Name of a trained agent in tables."""
    return Path(agent).stem if agent.endswith((".yaml", ".yml")) else agent


def entrant_names(entrants: Sequence[str], suite: Suite) -> list[str]:
    """Names of entrants in tables, before anything flies; all that ship with the package by default."""
    return _names(*_sorted_out(entrants or (*CONTROLLERS, *suite.agents, ZOO), suite))


def _names(controllers: Sequence[str], agents: Sequence[str], files: Mapping[str, str]) -> list[str]:
    """Names in tables, those of all policies that ship with the package included."""
    shelf = [f"{each} ({ZOO})" for each in list_policies()] if ZOO in files else []
    named = [name for name in files if name != ZOO]
    return [*(CONTROLLERS[each] for each in controllers), *map(agent_name, agents), *named, *shelf]


def _check_names(names: Sequence[str]) -> None:
    """Raise SuiteError if two entrants have one name: they would count as one."""
    for name, count in Counter(names).items():
        if count > 1:
            raise SuiteError(_ONE_NAME.format(name))


def _sorted_out(entrants: Sequence[str], suite: Suite) -> tuple[list[str], list[str], dict[str, str]]:
    """Controllers, agents to train, and paths of policies by name among the entrants."""
    controllers: list[str] = []
    agents: list[str] = []
    files: dict[str, str] = {}
    for entrant in dict.fromkeys(map(str, entrants)):
        if entrant in CONTROLLERS:
            controllers.append(entrant)
        elif entrant in (*suite.agents, *list_configurations()) or entrant.endswith((".yaml", ".yml")):
            agents.append(entrant)
        else:
            named = _NAMED.fullmatch(entrant)
            name, path = (named[1], named[2]) if named else (entrant, entrant)
            if named and name == ZOO:
                raise SuiteError(f"{entrant}: {ZOO} is the policies that ship: put another name before the =")
            if name in files:
                raise SuiteError(_ONE_NAME.format(name))
            files[name] = path
    return controllers, agents, files


def _from_files(
    files: Mapping[str, str], task: str, scene: Scene, trust: bool
) -> Iterator[tuple[str, str | Path | ActingPolicy]]:
    """Names and policies that fly in a task."""
    for name, file in files.items():
        if name == ZOO:
            for each in list_policies():
                if load_policy(each).metadata.get("scene_hash") == scene.content_hash():
                    yield f"{each} ({ZOO})", each
            continue
        path = _path_in(file, task)
        if TASK in file and not path.exists():
            continue
        acting = as_policy(path, trust=trust)
        try:
            check_fit(acting, scene)
        except PolicyError:
            if TASK in file:
                raise
            continue
        yield name, path


def _missing(files: Mapping[str, str], tasks: Iterable[str]) -> Iterator[str]:
    """A note on each entrant that lacks the files of some tasks."""
    for name, file in files.items():
        own = tasks if TASK in file else ()
        lacking = [Path(task).stem for task in own if not _path_in(file, task).exists()]
        if lacking:
            yield f"{name}: there is no file {file} for {', '.join(lacking)}"


def _path_in(file: str, task: str) -> Path:
    """Path of a policy in a task; what has the task in it is no name of the zoo."""
    return policy_path(Path(file.replace(TASK, Path(task).stem)) if TASK in file else file)


def _train(
    plans: Mapping[tuple[str, str], AgentConfiguration],
    count: int,
    out: Path,
    executor: Executor | None,
    workers: int | None,
    progress: Report,
    notes: list[str],
) -> dict[tuple[str, str], list[Path]]:
    """Train all agents for all tasks; the policies of each, and a note on each training that failed."""
    configurations = list(plans.values())
    if not configurations:
        return {}
    running = executor or training_executor(configurations, workers)
    rows = train_seeds(configurations, count, out, executor=running, report=progress)
    for row in rows:
        if row["outcome"] == FAILED:
            notes.append(f"The training of {row['agent']}, seed {row['seed']}, failed: {row['failure']}")
    made = {row["folder"] for row in rows if row["outcome"] != FAILED}
    found: dict[tuple[str, str], list[Path]] = {}
    for key, plan in plans.items():
        seeds = range(plan.seed, plan.seed + count)
        folders = [training_task(plan.model_copy(update={"seed": seed}), out).folder for seed in seeds]
        found[key] = [folder / POLICY for folder in folders if str(folder) in made]
    return found
