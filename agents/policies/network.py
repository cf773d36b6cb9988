"""The network of a policy in PyTorch, to be trained; its twin in NumPy is `ExportedPolicy`."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from agents.policies.activations import SMOOTH
from agents.policies.exported import ExportedPolicy, FloatArray

CONSTANT = 1e-9
"""Entries of observations that vary by less, m, rad, m/s, rad/s, s, count as constant."""
FIRST_OUTPUTS = 0.1
"""Size of the last layer's first weights relative to PyTorch's: training begins near the mean action."""


class PolicyNetwork(nn.Module):
    """Layers from normalized observations to actions that are not clipped yet.

    Inside, both are in units of their variation in the training data: so a loss counts each entry of an
    action relative to how much it is used, however small a fraction of its limit that is.

    Attributes:
        activation: Function between layers.
        hidden: Sizes of the layers between.
        layers: The layers.
        observation_mean, observation_scale: As in `ExportedPolicy`, shape (n_obs,).
        action_mean, action_scale: Mean and standard deviation of actions, shape (n_u,), fractions of limits.
    """

    observation_mean: Tensor
    observation_scale: Tensor
    action_mean: Tensor
    action_scale: Tensor

    def __init__(
        self, n_observation: int, n_action: int, hidden: Sequence[int] = (256, 256), activation: str = "tanh"
    ) -> None:
        """Make a network with random weights, drawn from PyTorch's generator, and without normalization.

        Args:
            n_observation: Entries of an observation.
            n_action: Entries of an action.
            hidden: Sizes of the layers between.
            activation: Function between layers, "tanh" or "silu".

        Raises:
            ValueError: If a size is not positive, or the activation is unknown or not smooth.
        """
        super().__init__()
        sizes = [n_observation, *hidden, n_action]
        if min(sizes) < 1:
            raise ValueError(f"sizes of the layers: {sizes}, should be at least 1")
        if activation not in SMOOTH:
            raise ValueError(f"activation: {activation!r}, should be one of {', '.join(SMOOTH)}")
        self.activation, self.hidden = activation, tuple(hidden)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        last = self._linear[-1]
        with torch.no_grad():
            last.weight.mul_(FIRST_OUTPUTS)
            last.bias.zero_()
        for name, value, size in (
            ("observation_mean", 0.0, n_observation),
            ("observation_scale", 1.0, n_observation),
            ("action_mean", 0.0, n_action),
            ("action_scale", 1.0, n_action),
        ):
            self.register_buffer(name, torch.full((size,), value, dtype=torch.float64))

    @property
    def _linear(self) -> list[nn.Linear]:
        """The layers by their type."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def normalize(
        self,
        observation_mean: ArrayLike,
        observation_deviation: ArrayLike,
        action_mean: ArrayLike,
        action_deviation: ArrayLike,
    ) -> None:
        """Set what the network takes for the unit of each entry.

        Args:
            observation_mean: Shape (n_obs,), units of the observation.
            observation_deviation: Standard deviations, shape (n_obs,), units of the observation; entries that
                do not vary are ignored from then on.
            action_mean: Shape (n_u,), fractions of limits.
            action_deviation: Shape (n_u,), fractions of limits; entries that do not vary keep their mean.
        """
        deviation = np.asarray(observation_deviation, dtype=np.float64)
        varies = deviation > CONSTANT
        values = {
            "observation_mean": observation_mean,
            "observation_scale": np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0),
            "action_mean": action_mean,
            "action_scale": action_deviation,
        }
        for name, value in values.items():
            getattr(self, name).copy_(torch.as_tensor(np.asarray(value, dtype=np.float64)))

    def normalized(self, observation: ArrayLike) -> Tensor:
        """Bring observations into the units of the network.

        Args:
            observation: Shape (B, n_obs), units of the observation.

        Returns:
            What `forward` takes, float32, shape (B, n_obs).
        """
        difference = np.asarray(observation, dtype=np.float64) - self.observation_mean.numpy()
        return torch.from_numpy((difference * self.observation_scale.numpy()).astype(np.float32))

    def forward(self, normalized: Tensor) -> Tensor:
        """Evaluate the layers.

        Args:
            normalized: Observations, shape (B, n_obs), dimensionless.

        Returns:
            Actions in units of the network, (a - action_mean) / action_scale, not clipped, shape (B, n_u).
        """
        values = normalized
        for layer in self._linear[:-1]:
            values = layer(values)
            values = torch.tanh(values) if self.activation == "tanh" else nn.functional.silu(values)
        result: Tensor = self._linear[-1](values)
        return result

    def forward_with_tangent(self, normalized: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate the layers and their derivative in a direction, both open to a gradient.

        Forward-mode differentiation, written out: without bookkeeping it takes twice a forward pass.

        Args:
            normalized: Observations, shape (B, n_obs), dimensionless.
            tangent: Directions, in the same units, shape (B, n_obs).

        Returns:
            What `forward` returns, and its change in the direction, both of shape (B, n_u).
        """
        values = normalized
        for layer in self._linear[:-1]:
            values, tangent = layer(values), tangent @ layer.weight.T
            if self.activation == "tanh":
                values = torch.tanh(values)
                slope = 1.0 - values * values
            else:
                gate = torch.sigmoid(values)
                slope = gate * (1.0 + values * (1.0 - gate))
                values = values * gate
            tangent = slope * tangent
        last = self._linear[-1]
        return last(values), tangent @ last.weight.T

    def act(self, observation: ArrayLike) -> FloatArray:
        """Choose actions, without a gradient; in double precision, as the exported policy does.

        Args:
            observation: Shape (B, n_obs), units of the observation.

        Returns:
            Inputs as fractions of their limits, in [-1, 1], shape (B, n_u).
        """
        inputs = torch.from_numpy(np.array(observation, dtype=np.float64))
        twin = copy.deepcopy(self).double()
        with torch.no_grad():
            outputs = twin((inputs - self.observation_mean) * self.observation_scale)
            actions = (self.action_mean + self.action_scale * outputs).clamp(-1.0, 1.0)
        return np.asarray(actions.numpy())

    def export(self, metadata: Mapping[str, Any]) -> ExportedPolicy:
        """Write the network as arrays; the units of its actions become part of the last layer.

        Args:
            metadata: JSON values: for which scene, how trained.

        Returns:
            The policy; its actions are those of `act` but for the rounding of its last weights.
        """
        weights = [layer.weight.detach().double().numpy().T for layer in self._linear]
        biases = [layer.bias.detach().double().numpy() for layer in self._linear]
        scale = self.action_scale.numpy()
        weights[-1] = weights[-1] * scale
        biases[-1] = biases[-1] * scale + self.action_mean.numpy()
        return ExportedPolicy(
            weights=tuple(weights),
            biases=tuple(biases),
            activation=self.activation,
            mean=self.observation_mean.numpy(),
            scale=self.observation_scale.numpy(),
            metadata=metadata,
        )
