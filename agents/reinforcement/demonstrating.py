"""Demonstrations as an agent would have flown them: the same maneuvers, by the actions that it has.

A demonstration has an action for each time step and uses all of the actuators; an agent may hold its
actions, and have smaller ones. So demonstrations are flown again in the agent's own environment: what is
remembered are true decisions with their rewards, and no others.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from agents.reinforcement.held_actions import HeldActions, action_limits
from agents.vec_env import DQSpaceArmVecEnv
from dq_space_arm_env import Scene
from experts.demonstrations import Demonstration, Demonstrations, DemonstrationsError

SingleArray = NDArray[np.float32]
TOGETHER = 64
"""Demonstrations that are flown together; each has some megabytes of gains."""


class Flown(NamedTuple):
    """Decisions that flew demonstrations again, D of them, one successful flight after the other.

    Attributes:
        observations: Before the decision, shape (D, n_obs), units as in `DQSpaceArmEnv`.
        actions: Fractions of limits, shape (D, n_u).
        rewards: Shape (D,), as the agent gets them.
        next_observations: After the hold, shape (D, n_obs).
        done: Whether the episode ended with it, shape (D,).
    """

    observations: SingleArray
    actions: SingleArray
    rewards: SingleArray
    next_observations: SingleArray
    done: NDArray[np.bool_]


def fly_again(demonstrations: Demonstrations, scene: Scene, environment: HeldActions) -> Flown:
    """Fly demonstrations in an agent's environment, and keep those flights that succeed there.

    A decision is the mean of what the demonstration's feedback would do during the hold.

    Args:
        demonstrations: Of that scene, but perhaps for stricter tolerances.
        scene: The scene that the agent practices in.
        environment: Its settings are what counts: the flights are in another one of the same kind, and leave
            the episodes in this one alone.

    Returns:
        The decisions.

    Raises:
        DemonstrationsError: If no flight succeeds.
    """
    pieces = [
        piece
        for first in range(0, len(demonstrations), TOGETHER)
        for piece in _flights(demonstrations, [*demonstrations[first : first + TOGETHER]], scene, environment)
    ]
    if not pieces:
        raise DemonstrationsError(
            f"none of the {len(demonstrations)} demonstrations in {demonstrations.path} succeeds with "
            f"actions held for {environment.repeat} steps: let environment.action_repeat be smaller, or "
            "environment.action_scale larger"
        )
    arrays = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    return Flown(*cast(Any, arrays))


def _flights(
    data: Demonstrations, chosen: list[Demonstration], scene: Scene, settings: HeldActions
) -> Iterator[tuple[NDArray[Any], ...]]:
    """The columns of `Flown` for each flight that succeeds."""
    plain = DQSpaceArmVecEnv(len(chosen), scene)
    environment = settings.around(plain)
    plain.set_options({"initial_state": np.array([each.states[0] for each in chosen])})
    observation = environment.reset()
    unit = action_limits(environment)
    columns: list[tuple[NDArray[Any], ...]] = []
    infos: list[dict[str, Any]] = []
    for stage in range(0, data.scene.simulation.steps, settings.repeat):
        states = plain.vector_env.states
        actions = np.clip(_mean_action(data, chosen, states, stage, settings.repeat), -unit, unit)
        following, reward, done, infos = environment.step(actions)
        after = np.array(
            [info.get("terminal_observation", row) for info, row in zip(infos, following, strict=True)]
        )
        columns.append((np.asarray(observation), actions, reward, after, done))
        observation = following
    environment.close()
    # By flight, then by decision.
    joined = [np.stack(column, axis=1) for column in zip(*columns, strict=True)]
    for row, info in enumerate(infos):
        if info.get("is_success"):
            yield tuple(column[row] for column in joined)


def _mean_action(
    data: Demonstrations, chosen: list[Demonstration], states: NDArray[np.float64], stage: int, hold: int
) -> SingleArray:
    """Mean of the actions by which demonstrations would go on from states during a hold, shape (B, n_u)."""
    kernels = data.kernels
    limit = kernels.layout.control_limit
    total = np.zeros((len(chosen), len(limit)))
    stages = range(stage, min(stage + hold, data.scene.simulation.steps))
    for at in stages:
        deviation = data.tangent(np.array([each.states[at] for each in chosen]), states)
        gains = np.array([each.feedback_gains[at] for each in chosen])
        nominal = np.array([each.actions[at] for each in chosen])
        actions = np.clip(nominal + np.einsum("bij,bj->bi", gains, deviation), -1.0, 1.0)
        states = kernels.step(states, actions * limit)
        total += actions
    mean: SingleArray = (total / len(stages)).astype(np.float32)
    return mean
