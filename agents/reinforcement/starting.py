"""A policy to begin with: an exported one, cloned from the expert for instance, becomes PPO's actor."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from agents.configuration import Configuration, ConfigurationError
from agents.evaluation.policies import PolicyError, policy_path
from agents.policies import ExportedPolicy, PolicyFileError
from agents.reinforcement.held_actions import action_limits


class Before(NamedTuple):
    """What was spent on an agent before it learns by itself.

    Attributes:
        expert_solves: Problems that the expert solved.
        seconds: Time of that, and of training, s.
    """

    expert_solves: int = 0
    seconds: float = 0.0


def load_start(configuration: Configuration, n_observation: int, n_action: int) -> ExportedPolicy | None:
    """Read the policy that a configuration begins with, and check that its actor can be that.

    Args:
        configuration: Of the agent.
        n_observation: Entries of an observation in its environment.
        n_action: Entries of an action.

    Returns:
        The policy; None if it begins with a random one.

    Raises:
        ConfigurationError: If there is no such policy, or it does not fit network or environment.
    """
    if configuration.start_from is None:
        return None
    policy = _read(configuration.start_from)
    network = configuration.network
    hidden = tuple(len(bias) for bias in policy.biases[:-1])
    problems = [
        f"{name} is {there} there and {here} here"
        for name, there, here in (
            ("network.hidden", list(hidden), list(network.hidden)),
            ("network.activation", policy.activation, network.activation),
            ("squash", policy.squash, "clip"),
            ("entries of observations", policy.n_observation, n_observation),
            ("entries of actions", policy.n_action, n_action),
        )
        if there != here
    ]
    if policy.normalized_limit != float("inf"):
        problems.append("normalized observations are clipped there and are not here")
    if problems:
        raise ConfigurationError(
            f"start_from: {configuration.start_from} does not fit: {'; '.join(problems)}"
        )
    return policy


def spent_before(configuration: Configuration) -> Before:
    """Look up what the policy has cost that a configuration begins with.

    Args:
        configuration: Of the agent.

    Returns:
        What it has cost; nothing if the agent begins with a random policy.

    Raises:
        ConfigurationError: If there is no such policy.
    """
    if configuration.start_from is None:
        return Before()
    training = _read(configuration.start_from).metadata.get("training", {})
    return Before(int(training.get("expert_solves") or 0), float(training.get("seconds") or 0.0))


def _read(source: str) -> ExportedPolicy:
    try:
        path = policy_path(source)
        if not path.exists():
            raise ConfigurationError(
                f"start_from: there is no {path}; train a policy first, "
                "dq-space-arm train cloning-with-gains, and give its run's folder"
            )
        return ExportedPolicy.load(path)
    except (PolicyError, PolicyFileError) as error:
        raise ConfigurationError(f"start_from: {error}") from error


def take_over(model: BaseAlgorithm, policy: ExportedPolicy) -> None:
    """Give PPO's actor the layers of a policy; its observations must already be in the same units.

    Args:
        model: PPO with `ScaledActionsPolicy`, its network of the same sizes.
        policy: As `load_start` returns it.
    """
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
