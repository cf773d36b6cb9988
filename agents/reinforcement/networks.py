"""What an agent's networks add to those of Stable-Baselines3: units of observations and of actions.

Both are part of the model: a saved one needs no file with statistics beside it, and acts in the environment.
"""

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor

ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "tanh": torch.nn.Tanh,
    "relu": torch.nn.ReLU,
    "silu": torch.nn.SiLU,
}
"""Modules by the names of the configuration."""


class ScaledObservations(BaseFeaturesExtractor):
    """Observations in units of their variation; those of a dictionary joined, keys in alphabetical order.

    Attributes:
        mean: Subtracted, shape (n_obs,), units of the observation.
        scale: What the difference is multiplied by, shape (n_obs,), one over those units.
    """

    mean: Tensor
    scale: Tensor

    def __init__(
        self, observation_space: spaces.Space[Any], mean: Sequence[float], scale: Sequence[float]
    ) -> None:
        """Take the units.

        Args:
            observation_space: A box, or a dictionary of boxes.
            mean: n_obs numbers, units of the observation.
            scale: n_obs numbers, one over those units.
        """
        super().__init__(observation_space, features_dim=len(mean))
        # In double precision: the error of a pose is small beside its mean.
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float64))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float64))

    def set_units(self, mean: Sequence[float], scale: Sequence[float]) -> None:
        """Take other units.

        Args:
            mean: n_obs numbers, units of the observation.
            scale: n_obs numbers, one over those units.
        """
        self.mean.copy_(torch.tensor(mean, dtype=torch.float64))
        self.scale.copy_(torch.tensor(scale, dtype=torch.float64))

    def forward(self, observations: Tensor | dict[str, Tensor]) -> Tensor:
        """Scale observations.

        Args:
            observations: Shape (B, n_obs), units of the observation; or parts of them, by name.

        Returns:
            Shape (B, n_obs), dimensionless.
        """
        return self.in_double_precision(observations).float()

    def in_double_precision(self, observations: Tensor | dict[str, Tensor]) -> Tensor:
        """Scale observations, and leave them in double precision.

        Args:
            observations: As for `forward`.

        Returns:
            float64, shape (B, n_obs), dimensionless.
        """
        if isinstance(observations, dict):
            observations = torch.cat([observations[key] for key in sorted(observations)], dim=1)
        return (observations - self.mean) * self.scale


class ScaledActionsPolicy(ActorCriticPolicy):
    """The policy of PPO for an action space whose box is small: 1 means the bound, whatever that is.

    Stable-Baselines3 scales actions only where they are squashed, and otherwise has the network give them in
    the units of the space, where a standard deviation of 0.5 would be hundreds of times too large for some.
    What exceeds 1 is not cut off here: the bound is the agent's unit rather than the actuator's limit, at
    which the environment clips.
    """

    def _build(self, lr_schedule: Schedule) -> None:
        """Make networks, and an optimizer with two groups: the actor's parameters, and the critic's."""
        super()._build(lr_schedule)
        critic = [*self.mlp_extractor.value_net.parameters(), *self.value_net.parameters()]
        theirs = {id(parameter) for parameter in critic}
        actor = [parameter for parameter in self.parameters() if id(parameter) not in theirs]
        groups = [{"params": actor}, {"params": critic}]
        optimizer: Any = self.optimizer_class
        self.optimizer = optimizer(groups, lr=lr_schedule(1.0), **self.optimizer_kwargs)

    @property
    def squash_output(self) -> bool:
        """True: actions are scaled from [-1, 1] to the box."""
        return True

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        """Choose actions, those without noise in double precision.

        In single precision, sums over some hundred entries come out 2e-6 apart in different libraries, with
        gains as large as those of a policy that was cloned.

        Args:
            observation: Shape (B, n_obs), units of the observation.
            deterministic: Whether to do without noise.

        Returns:
            Shape (B, n_u), in units of the box's bounds.
        """
        if not deterministic:
            return super()._predict(observation)
        extractor = self.features_extractor
        assert isinstance(extractor, ScaledObservations)
        values = extractor.in_double_precision(observation)
        for module in (*self.mlp_extractor.policy_net, self.action_net):
            if isinstance(module, torch.nn.Linear):
                values = torch.nn.functional.linear(values, module.weight.double(), module.bias.double())
            else:
                values = module(values)
        return values.float()
