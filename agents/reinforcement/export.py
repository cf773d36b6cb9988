"""From a policy of Stable-Baselines3 to arrays that act without it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from agents.policies import ExportedPolicy
from agents.reinforcement.networks import ACTIVATIONS, ScaledActionsPolicy, ScaledObservations


def export_policy(model: BaseAlgorithm, metadata: Mapping[str, Any]) -> ExportedPolicy:
    """Write the deterministic policy of PPO, SAC, TQC or TD3 as arrays.

    Args:
        model: The trained model, with a policy of fully connected layers.
        metadata: JSON values: for which scene, how trained. Whether it sees the goal environment's
            observations, joined, is added as "observation": "goal" or "plain".

    Returns:
        The policy; its actions are those of `model.predict(observation, deterministic=True)` to single
        precision.

    Raises:
        ValueError: If the policy is none of these, or its observations are not those of the environment.
    """
    modules, squash = _layers(model)
    linear = [module for module in modules if isinstance(module, nn.Linear)]
    weights = [layer.weight.detach().double().numpy().T for layer in linear]
    biases = [layer.bias.detach().double().numpy() for layer in linear]
    space = model.action_space
    assert isinstance(space, spaces.Box)
    if not np.array_equal(space.low, -space.high):
        raise ValueError(
            f"actions in [{space.low}, {space.high}]: should be symmetric, as in the environment"
        )
    # Squashed actions are scaled afterwards; others within the last layer.
    scale = np.asarray(space.high, dtype=np.float64)
    if squash == "clip":
        if isinstance(model.policy, ScaledActionsPolicy):
            weights[-1], biases[-1] = weights[-1] * scale, biases[-1] * scale
        elif not (scale == 1.0).all():
            raise ValueError("actions are not in [-1, 1]: take ScaledActionsPolicy for a smaller box")
        scale = np.ones_like(scale)
    mean, factor = _units(model, weights[0].shape[0])
    kind = "goal" if isinstance(model.observation_space, spaces.Dict) else "plain"
    return ExportedPolicy(
        weights=tuple(weights),
        biases=tuple(biases),
        activation=_activation(modules),
        squash=squash,
        action_scale=scale,
        mean=mean,
        scale=factor,
        metadata={**metadata, "observation": kind},
    )


def _layers(model: BaseAlgorithm) -> tuple[list[nn.Module], str]:
    """The actor's modules from first to last, and what becomes of its outputs."""
    policy: Any = model.policy
    if isinstance(policy, ActorCriticPolicy):
        return [*policy.mlp_extractor.policy_net, policy.action_net], "clip"
    actor: Any = getattr(policy, "actor", None)
    if hasattr(actor, "latent_pi"):  # SAC, TQC
        return [*actor.latent_pi, actor.mu], "tanh"
    if isinstance(getattr(actor, "mu", None), nn.Sequential):  # TD3
        *modules, last = actor.mu
        assert isinstance(last, nn.Tanh)
        return modules, "tanh"
    raise ValueError(f"{type(policy).__name__} cannot be exported: it is no policy of PPO, SAC, TQC or TD3")


def _activation(modules: list[nn.Module]) -> str:
    between = {type(module) for module in modules if not isinstance(module, nn.Linear)}
    names = [name for name, module in ACTIVATIONS.items() if between <= {module}]
    if not names:
        kinds = ", ".join(sorted(kind.__name__ for kind in between))
        raise ValueError(f"activations {kinds}: should be one and the same of {', '.join(ACTIVATIONS)}")
    return names[0]


def _units(model: BaseAlgorithm, n_observation: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if model.get_vec_normalize_env() is not None:
        raise ValueError("observations of VecNormalize cannot be exported: let ScaledObservations scale them")
    policy: Any = model.policy
    # PPO shares one extractor, the others have one for each network.
    extractor = getattr(policy, "actor", policy).features_extractor
    if isinstance(extractor, ScaledObservations):
        return extractor.mean.double().numpy(), extractor.scale.double().numpy()
    return np.zeros(n_observation), np.ones(n_observation)
