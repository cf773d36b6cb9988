"""Fly entrants in all tasks of a suite: controllers of the expert, agents trained for it, policies."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from agents.configuration import AgentConfiguration
from agents.evaluation.comparing import check_sequences, compare
from agents.evaluation.conditions import scene_under
from agents.evaluation.evaluating import Advance as Step
from agents.evaluation.plan_followers import CONTROLLERS
from agents.experiments.many_trainings import train_seeds, training_executor, training_task
from agents.experiments.training_task import FAILED
from agents.run_folder import POLICY
from agents.suite.entrants import (
    agent_name,
    check_names,
    find_fliers,
    missing_files,
    names_of,
    sorted_out,
)
from agents.suite.scores import Score, SuiteRun
from agents.suite.tasks import ZOO, Suite, SuiteError, load_suite
from dq_space_arm_env import Scene
from dq_space_arm_env.common.progress import Advance
from experts.executors import Executor, local_executor

TRAININGS = "trainings"
Report = Callable[[Advance], None]


def run_suite(
    entrants: Sequence[str] = (),
    suite: str | Path | Suite = "v1",
    *,
    policies: Mapping[str, Callable[[Scene], Any]] = MappingProxyType({}),
    tasks: Sequence[str] = (),
    seeds: int | None = None,
    out: str | os.PathLike[str] = Path("results") / "suite",
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
        TypeError: If a text is given where a sequence should be.
        ValueError: If a condition does not suit a task.
        DemonstrationsError: If processes of the expert are killed again and again; finished rows remain.
        KeyboardInterrupt: If the user interrupts it; likewise.
    """
    check_sequences(entrants=entrants, tasks=tasks)
    chosen, out = load_suite(suite), Path(out)
    scenes = {task: chosen.scene(task) for task in tasks or chosen.tasks}
    for scene in scenes.values():
        for condition in chosen.conditions:
            scene_under(scene, condition)  # refuses one that the scene cannot have before anybody flies
    if not entrants and not policies:
        entrants = (*CONTROLLERS, *chosen.agents, ZOO)
    controllers, agents, files = sorted_out(entrants, chosen)
    check_names([*names_of(controllers, agents, files), *policies])
    fliers = find_fliers(files, policies, scenes, trust)  # before anything is trained
    if not (controllers or agents or any(fliers.values())):
        raise SuiteError(f"{ZOO}: no policy that ships was trained in {', '.join(scenes)}: nobody can fly")
    plans = {(agent, task): chosen.training(agent, task) for agent in agents for task in scenes}
    notes = [*missing_files(files, scenes)]
    count = chosen.seeds if seeds is None else seeds
    trained = _train(plans, count, out / TRAININGS, executor, workers, progress, notes)
    scores: list[Score] = []
    for number, task in enumerate(scenes, 1):

        def announce(step: Step, task: str = task, number: int = number) -> None:
            progress(step._replace(stage=f"{task} ({number} of {len(scenes)}), {step.stage}"))

        own = [(agent_name(agent), path) for agent in agents for path in trained[agent, task]]
        failed = {agent_name(agent): count - len(trained[agent, task]) for agent in agents}
        place, working = out / Path(task).stem, executor or local_executor(workers)
        flown = _fly(chosen, task, controllers, [*own, *fliers[task]], place, working, trust, announce)
        scores += (replace(score, failed=failed.get(score.entrant, 0)) for score in flown)
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
