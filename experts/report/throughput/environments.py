"""Environments to be timed, as an agent in training steps them.

Actions are random, each followed by its opposite, so that the robot does not spin up. The copies of a vector
environment end their episodes at times spread evenly over an episode, so that resets are part of the time; a
sample holds whole periods of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any

import gymnasium
import numpy as np

from dq_space_arm_env import Scene
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.throughput.timing import ENVIRONMENT, OURS, Case, Subject
from experts.report.throughput.variants import PLAIN, VARIANTS

MAKE, MAKE_VEC, UNWRAPPED = "gymnasium.make", "gymnasium.make_vec", "gymnasium.make, unwrapped"


def environment_cases(scene: Scene, batch_sizes: Sequence[int]) -> list[Case]:
    """Single environments and vector environments of each size, with each integrator, and in each variant.

    Args:
        scene: The scene.
        batch_sizes: Copies in a vector environment.

    Returns:
        The cases; those of the variants with the scene's integrator only.
    """
    chosen, steps = scene.simulation.integrator, scene.simulation.steps
    cases = []
    for integrator in COMPARED_INTEGRATORS:
        for way in (UNWRAPPED, MAKE):
            env = gymnasium.make("DQSpaceArm-v0", scene=PLAIN.scene(scene, integrator))
            subject = Subject(what=ENVIRONMENT, engine=OURS, way=way, integrator=integrator)
            cases.append(single_case(subject, env if way == MAKE else env.unwrapped, steps))
    for variant in VARIANTS:
        for integrator in COMPARED_INTEGRATORS if variant == PLAIN else (chosen,):
            for batch in batch_sizes:
                subject = Subject(
                    what=ENVIRONMENT,
                    engine=OURS,
                    way=MAKE_VEC,
                    integrator=integrator,
                    batch=batch,
                    precision=variant.precision,
                    threads=variant.threads,
                )
                cases.append(vector_case(subject, variant.make_vec(scene, batch, integrator), steps))
    return cases


def single_case(subject: Subject, env: gymnasium.Env[Any, Any], steps: int) -> Case:
    """Step an environment, and reset it at the end of an episode.

    Args:
        subject: What is timed.
        env: The environment.
        steps: Steps of an episode.

    Returns:
        The case; a sample is a multiple of an episode.
    """
    actions = _alternating(env.action_space)
    env.reset(seed=0)

    def run() -> None:
        if env.step(next(actions))[2]:
            env.reset()

    return Case(subject, run, period=steps)


def vector_case(subject: Subject, env: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int) -> Case:
    """Step a vector environment whose copies' episodes are evenly apart.

    Args:
        subject: What is timed.
        env: The environment; it resets copies by itself.
        steps: Steps of an episode.

    Returns:
        The case; a sample is a multiple of the time between two ends of episodes.
    """
    actions = _alternating(env.action_space)
    env.reset(seed=0)
    _spread_episodes(env, actions, steps)
    period = math.ceil((steps + 1) / env.num_envs)  # the reset takes a step of its own
    return Case(subject, lambda: env.step(next(actions)), period)


def _alternating(space: gymnasium.Space[Any]) -> Iterator[Any]:
    space.seed(0)
    action = space.sample()
    return cycle((action, -action))


def _spread_episodes(
    env: gymnasium.vector.VectorEnv[Any, Any, Any], actions: Iterator[Any], steps: int
) -> None:
    """Begin the copies' episodes one after another, the last one when the first is nearly over."""
    starts = np.arange(env.num_envs) * steps // env.num_envs
    for step in range(int(starts.max()) + 1):
        beginning = starts == step
        if step and beginning.any():
            env.reset(options={"reset_mask": beginning})
        env.step(next(actions))
