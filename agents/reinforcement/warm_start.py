"""Give a learner the layers of an exported policy, or demonstrations replayed by its own actions."""

from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from agents.configuration import Configuration
from agents.policies import ExportedPolicy
from agents.reinforcement.training_environment import action_limits, native_environment
from dq_space_arm_env import Scene
from experts.demonstrations import Demonstration, Demonstrations, DemonstrationsError

SingleArray = NDArray[np.float32]
BATCH = 64
"""Demonstrations flown together; each holds some megabytes of gains."""


def set_actor(model: BaseAlgorithm, policy: ExportedPolicy) -> None:
    """Copy a policy's layers into PPO's actor, which must already see observations in its units."""
    actor: Any = model.policy
    layers = [module for module in actor.mlp_extractor.policy_net if isinstance(module, nn.Linear)]
    weights: list[NDArray[Any]] = list(policy.weights)
    biases: list[NDArray[Any]] = list(policy.biases)
    environment = model.get_env()
    assert environment is not None
    unit = action_limits(environment)  # of the actor's outputs, which are scaled to the box afterwards
    scale = (1.0 if policy.action_scale is None else policy.action_scale) / unit
    weights[-1], biases[-1] = weights[-1] * scale, biases[-1] * scale
    with torch.no_grad():
        for layer, weight, bias in zip([*layers, actor.action_net], weights, biases, strict=True):
            layer.weight.copy_(torch.from_numpy(np.asarray(weight.T, dtype=np.float32)))
            layer.bias.copy_(torch.from_numpy(np.asarray(bias, dtype=np.float32)))


class Flown(NamedTuple):
    """Transitions of demonstrations replayed by the agent, D in all, one successful flight after another."""

    observations: SingleArray  # (D, n_obs), units as in `DQSpaceArmEnv`
    actions: SingleArray  # (D, n_u), fractions of the limits
    rewards: SingleArray  # (D,)
    next_observations: SingleArray  # after the hold, (D, n_obs)
    done: NDArray[np.bool_]  # (D,)


def fly_again(demonstrations: Demonstrations, configuration: Configuration, scene: Scene) -> Flown:
    """Replay demonstrations in the agent's environment, and keep the flights that succeed there.

    A demonstration acts at every step with full authority; the agent may hold its actions, and have smaller
    ones. Each decision is the mean of the demonstration's feedback actions during the hold, so that the
    replay buffer gets true transitions with the agent's own rewards.
    """
    flights = [
        flight
        for first in range(0, len(demonstrations), BATCH)
        for flight in _flights(demonstrations, [*demonstrations[first : first + BATCH]], configuration, scene)
    ]
    if not flights:
        raise DemonstrationsError(
            f"none of the {len(demonstrations)} demonstrations in {demonstrations.path} succeeds with "
            f"actions held for {configuration.environment.action_repeat} steps: reduce "
            "environment.action_repeat, or raise environment.action_scale"
        )
    arrays = [np.concatenate(column) for column in zip(*flights, strict=True)]
    return Flown(*cast(Any, arrays))


def _flights(
    data: Demonstrations, chosen: list[Demonstration], configuration: Configuration, scene: Scene
) -> Iterator[tuple[NDArray[Any], ...]]:
    """The columns of `Flown` for each successful flight."""
    environment = native_environment(configuration, scene, len(chosen))
    repeat = configuration.environment.action_repeat
    native: Any = environment.vector_env.unwrapped
    options = {"initial_state": np.array([each.states[0] for each in chosen])}
    if data.kernels.n_p:
        options["parameters"] = np.array([each.parameters for each in chosen])
    environment.set_options(options)
    observation: Any = environment.reset()
    unit = action_limits(environment)
    rows = np.array([data.kernels.stage_parameters(each.parameters) for each in chosen])
    columns: list[tuple[NDArray[Any], ...]] = []
    infos: list[dict[str, Any]] = []
    for stage in range(0, data.scene.simulation.steps, repeat):
        states = native.states
        actions = np.clip(_mean_action(data, chosen, rows, states, stage, repeat), -unit, unit)
        following, reward, done, infos = environment.step(actions)
        after = np.array(
            [info.get("terminal_observation", row) for info, row in zip(infos, following, strict=True)]
        )
        columns.append((np.asarray(observation), actions, reward, after, done))
        observation = following
    environment.close()
    # From (decision, flight) to (flight, decision).
    joined = [np.stack(column, axis=1) for column in zip(*columns, strict=True)]
    for row, info in enumerate(infos):
        if info.get("is_success"):
            yield tuple(column[row] for column in joined)


def _mean_action(
    data: Demonstrations,
    chosen: list[Demonstration],
    rows: NDArray[np.float64],
    states: NDArray[np.float64],
    stage: int,
    hold: int,
) -> SingleArray:
    """Mean feedback action clip(a_k + G_k (x (-) x_k)) over a hold from given states, shape (B, n_u).

    `rows` are the parameters of the flights' stages, shape (B, N + 1, n_p).
    """
    kernels = data.kernels
    total = np.zeros((len(chosen), kernels.n_u))
    least = kernels.layout.lower_limits(np.ones(kernels.n_u))
    stages = range(stage, min(stage + hold, data.scene.simulation.steps))
    for at in stages:
        deviation = data.tangent(np.array([each.states[at] for each in chosen]), states)
        gains = np.array([each.feedback_gains[at] for each in chosen])
        nominal = np.array([each.actions[at] for each in chosen])
        actions = np.clip(nominal + np.einsum("bij,bj->bi", gains, deviation), least, 1.0)
        states = kernels.step(states, kernels.layout.to_control(actions, rows[:, at]), p=rows[:, at])
        total += actions
    mean: SingleArray = (total / len(stages)).astype(np.float32)
    return mean
