"""What scenes cost: the size of their equations, and the time that these take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dq_space_arm_env import Scene
from experts.report.throughput.environments import MAKE_VEC, vector_case
from experts.report.throughput.kernels import kernel_case
from experts.report.throughput.timing import (
    DYNAMICS,
    ENVIRONMENT,
    OURS,
    STEP,
    Case,
    Effort,
    Subject,
    Timing,
    time_cases,
)
from experts.report.throughput.variants import PLAIN

BATCH = 1024


@dataclass(frozen=True)
class SceneCost:
    """What a scene costs, in float64 on one thread.

    Attributes:
        title: Name of the scene, or what it is.
        states: Number of states.
        inputs: Number of inputs.
        integrator: Name of the integrator.
        dynamics: Forward dynamics.
        step: A step with the scene's integrator.
        environment_step: The compiled part of an environment's step.
        environment: A step of the vector environment; None where it is not asked for.
    """

    title: str
    states: int
    inputs: int
    integrator: str
    dynamics: Timing
    step: Timing
    environment_step: Timing
    environment: Timing | None


def measure_costs(scenes: Mapping[str, Scene], effort: Effort, environments: bool) -> list[SceneCost]:
    """Time scenes, all in turns, in batches of BATCH states.

    Args:
        scenes: The scenes by title.
        effort: How much to measure; its batch sizes do not matter.
        environments: Whether to time vector environments too.

    Returns:
        A scene's cost each.
    """
    cases = [_cases(scene, environments) for scene in scenes.values()]
    timings = iter(time_cases([case for row in cases for case in row], effort))
    costs = []
    for (title, scene), row in zip(scenes.items(), cases, strict=True):
        kernels = PLAIN.compile(scene)
        dynamics, step, environment_step, *environment = (next(timings) for _ in row)
        costs.append(
            SceneCost(
                title=title,
                states=kernels.n_x,
                inputs=kernels.n_u,
                integrator=scene.simulation.integrator,
                dynamics=dynamics,
                step=step,
                environment_step=environment_step,
                environment=environment[0] if environment else None,
            )
        )
    return costs


def _cases(scene: Scene, environment: bool) -> list[Case]:
    integrator = scene.simulation.integrator
    programs = ((DYNAMICS, ""), (STEP, integrator), (ENVIRONMENT, integrator))
    cases = [kernel_case(scene, what, name, BATCH) for what, name in programs]
    if environment:
        subject = Subject(what=ENVIRONMENT, engine=OURS, way=MAKE_VEC, integrator=integrator, batch=BATCH)
        vector = PLAIN.make_vec(scene, BATCH, integrator)
        cases.append(vector_case(subject, vector, scene.simulation.steps))
    return cases
