"""Networks of Stable-Baselines3 with units for observations and actions, and their export to plain arrays.

The units are part of the model: a saved one needs no file of statistics, and acts in the environment as is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from agents.policies import ExportedPolicy
from agents.zoo.model_archive import environment_scale
from agents.zoo.normalization import statistics_of

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU, "silu": nn.SiLU}


class ScaledObservations(BaseFeaturesExtractor):
    """Observations in units of their spread; the parts of a dictionary joined in alphabetical order."""

    mean: Tensor  # (n_obs,), units of the observation
    scale: Tensor  # (n_obs,), one over these units

    def __init__(
        self, observation_space: spaces.Space[Any], mean: Sequence[float], scale: Sequence[float]
    ) -> None:
        super().__init__(observation_space, features_dim=len(mean))
        # Double precision: the error of a pose is small beside its mean.
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float64))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float64))

    def set_units(self, mean: Sequence[float], scale: Sequence[float]) -> None:
        self.mean.copy_(torch.tensor(mean, dtype=torch.float64))
        self.scale.copy_(torch.tensor(scale, dtype=torch.float64))

    def forward(self, observations: Tensor | dict[str, Tensor]) -> Tensor:
        return self.in_double_precision(observations).float()

    def in_double_precision(self, observations: Tensor | dict[str, Tensor]) -> Tensor:
        if isinstance(observations, dict):
            observations = torch.cat([observations[key] for key in sorted(observations)], dim=1)
        return (observations - self.mean) * self.scale


class ScaledActionsPolicy(ActorCriticPolicy):
    """PPO's policy for a small action box: an output of 1 means the bound, whatever its size.

    Stable-Baselines3 scales squashed actions only. Other networks act in the units of the space, where a
    standard deviation of 0.5 would be hundreds of times too large for some inputs. Outputs beyond 1 are not
    clipped here: the bound is the agent's unit, not the actuator's limit, at which the environment clips.
    """

    def _build(self, lr_schedule: Schedule) -> None:
        """Make the networks, and an optimizer with two parameter groups: actor, then critic."""
        super()._build(lr_schedule)
        critic = [*self.mlp_extractor.value_net.parameters(), *self.value_net.parameters()]
        theirs = {id(parameter) for parameter in critic}
        actor = [parameter for parameter in self.parameters() if id(parameter) not in theirs]
        groups = [{"params": actor}, {"params": critic}]
        optimizer: Any = self.optimizer_class
        self.optimizer = optimizer(groups, lr=lr_schedule(1.0), **self.optimizer_kwargs)

    @property
    def squash_output(self) -> bool:
        return True  # has Stable-Baselines3 scale actions from [-1, 1] to the box

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        """Choose actions, deterministic ones in double precision.

        With gains as large as a cloned policy's, sums of some hundred terms in single precision differ by
        2e-6 between libraries.
        """
        if not deterministic:
            return super()._predict(observation)
        extractor = self.features_extractor
        assert isinstance(extractor, ScaledObservations)
        values = extractor.in_double_precision(observation)
        for module in (*self.mlp_extractor.policy_net, self.action_net):
            if isinstance(module, nn.Linear):
                values = nn.functional.linear(values, module.weight.double(), module.bias.double())
            else:
                values = module(values)
        return values.float()


def export_policy(
    model: BaseAlgorithm,
    metadata: Mapping[str, Any] | None = None,
    *,
    normalize: str | Path | None = None,
) -> ExportedPolicy:
    """Export the deterministic policy of a model to arrays, which fly without Stable-Baselines3.

    Statistics of `VecNormalize` and the rescaling of actions in `agents.SB3VecEnv` become part of the policy.

    Args:
        model: PPO, A2C, SAC, TQC, TD3 or DDPG, with its environment.
        metadata: JSON values to keep with the policy.
        normalize: File of the `VecNormalize` that the model was trained in, as its `save` writes it, if the
            model was loaded without it.

    Returns:
        The policy of raw observations and of the environment's own actions.

    Raises:
        TypeError: If it is no model of Stable-Baselines3.
        ValueError: If the model acts in another way than by plain layers, or its normalization is missing.
    """
    if not isinstance(model, BaseAlgorithm):
        raise TypeError(
            f"model: {model!r}, should be a model of Stable-Baselines3: load a file first, as PPO.load does"
        )
    statistics = statistics_of(model, normalize)
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
    # Squashed actions are scaled afterwards, others in the last layer.
    scale = np.asarray(space.high, dtype=np.float64)
    if squash == "clip":
        if isinstance(model.policy, ScaledActionsPolicy):
            weights[-1], biases[-1] = weights[-1] * scale, biases[-1] * scale
        elif not (scale == 1.0).all():
            raise ValueError("actions are not in [-1, 1]: use ScaledActionsPolicy for a smaller box")
        scale = np.ones_like(scale)
    factors = environment_scale(space, len(biases[-1]))
    if isinstance(model.policy, ScaledActionsPolicy) and (factors != 1.0).any():
        raise ValueError("actions of ScaledActionsPolicy are rescaled: use a smaller action space instead")
    mean, factor = _units(model, weights[0].shape[0])
    kind = "goal" if isinstance(model.observation_space, spaces.Dict) else "plain"
    exported = ExportedPolicy(
        weights=tuple(weights),
        biases=tuple(biases),
        activation=_activation(modules),
        squash=squash,
        action_scale=scale * factors,
        mean=mean,
        scale=factor,
        metadata={**(metadata or {}), "observation": kind},
    )
    return exported if statistics is None else statistics.of(exported)


def _layers(model: BaseAlgorithm) -> tuple[list[nn.Module], str]:
    """The actor's modules in order, and how its outputs are squashed."""
    policy: Any = model.policy
    if hasattr(policy, "lstm_actor"):
        raise ValueError(
            f"{type(policy).__name__} has a memory, which arrays cannot hold: fly the model itself"
        )
    if isinstance(policy, ActorCriticPolicy):
        is_squashed = policy.squash_output and not isinstance(policy, ScaledActionsPolicy)
        return [*policy.mlp_extractor.policy_net, policy.action_net], "tanh" if is_squashed else "clip"
    actor: Any = getattr(policy, "actor", None)
    if hasattr(actor, "latent_pi"):  # SAC, TQC
        return [*actor.latent_pi, actor.mu], "tanh"
    if isinstance(getattr(actor, "mu", None), nn.Sequential):  # TD3
        *modules, last = actor.mu
        assert isinstance(last, nn.Tanh)
        return modules, "tanh"
    raise ValueError(
        f"{type(policy).__name__} cannot be exported: it is not a policy of PPO, SAC, TQC or TD3"
    )


def _activation(modules: list[nn.Module]) -> str:
    between = {type(module) for module in modules if not isinstance(module, nn.Linear)}
    names = [name for name, module in ACTIVATIONS.items() if between <= {module}]
    if not names:
        kinds = ", ".join(sorted(kind.__name__ for kind in between))
        raise ValueError(f"activations {kinds}: should all be the same, one of {', '.join(ACTIVATIONS)}")
    return names[0]


def _units(model: BaseAlgorithm, n_observation: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    policy: Any = model.policy
    # PPO shares one extractor; in the other algorithms each network has its own.
    extractor = getattr(policy, "actor", policy).features_extractor
    if isinstance(extractor, ScaledObservations):
        return extractor.mean.double().numpy(), extractor.scale.double().numpy()
    if type(extractor) not in (FlattenExtractor, CombinedExtractor):
        raise ValueError(
            f"observations go through {type(extractor).__name__}, which arrays lack: fly the model itself"
        )
    return np.zeros(n_observation), np.ones(n_observation)
