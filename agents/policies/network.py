"""The trainable network of a policy, in PyTorch; `ExportedPolicy` is its twin in NumPy."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from agents.configuration.imitation import SMOOTH_ACTIVATIONS
from agents.policies.chunking import Exported
from agents.policies.exported import ExportedPolicy, FloatArray, scale_of

FIRST_OUTPUTS = 0.1  # initial size of the last layer relative to PyTorch's, to start near the mean action


class NormalizedNetwork(nn.Module):
    """A network from normalized observations to normalized actions, before clipping.

    Both are in units of their spread in the training data, so that a loss weighs each input relative to how
    much it is used, however small a fraction of its limit that is.
    """

    observation_mean: Tensor
    observation_scale: Tensor
    action_mean: Tensor
    action_scale: Tensor

    def __init__(self, n_observation: int, n_action: int) -> None:
        """Make a network without normalization."""
        super().__init__()
        for name, value, size in (
            ("observation_mean", 0.0, n_observation),
            ("observation_scale", 1.0, n_observation),
            ("action_mean", 0.0, n_action),
            ("action_scale", 1.0, n_action),
        ):
            self.register_buffer(name, torch.full((size,), value, dtype=torch.float64))

    def normalize(
        self,
        observation_mean: ArrayLike,
        observation_deviation: ArrayLike,
        action_mean: ArrayLike,
        action_deviation: ArrayLike,
    ) -> None:
        """Set the units of observations and actions."""
        values = {
            "observation_mean": observation_mean,
            "observation_scale": scale_of(np.asarray(observation_deviation, dtype=np.float64)),
            "action_mean": action_mean,
            "action_scale": action_deviation,
        }
        for name, value in values.items():
            getattr(self, name).copy_(torch.as_tensor(np.asarray(value, dtype=np.float64)))

    def normalized(self, observation: ArrayLike) -> Tensor:
        """Observations in the units of the network, float32."""
        difference = np.asarray(observation, dtype=np.float64) - self.observation_mean.numpy()
        return torch.from_numpy((difference * self.observation_scale.numpy()).astype(np.float32))

    def act(self, observation: ArrayLike) -> FloatArray:
        """Actions without gradients, clipped, in double precision like those of the exported policy."""
        inputs = torch.from_numpy(np.array(observation, dtype=np.float64))
        twin = copy.deepcopy(self).double()
        with torch.no_grad():
            outputs = twin((inputs - self.observation_mean) * self.observation_scale)
            actions = (self.action_mean + self.action_scale * outputs).clamp(-1.0, 1.0)
        return np.asarray(actions.numpy())

    def export(self, metadata: Mapping[str, Any]) -> Exported:
        """Export the network for NumPy alone, with metadata of JSON values."""
        raise NotImplementedError


class PolicyNetwork(NormalizedNetwork):
    """Layers of a perceptron."""

    def __init__(
        self, n_observation: int, n_action: int, hidden: Sequence[int] = (256, 256), activation: str = "tanh"
    ) -> None:
        """Make a network with random weights from PyTorch's generator, without normalization."""
        super().__init__(n_observation, n_action)
        sizes = [n_observation, *hidden, n_action]
        if min(sizes) < 1:
            raise ValueError(f"sizes of the layers: {sizes}, should be at least 1")
        if activation not in SMOOTH_ACTIVATIONS:
            raise ValueError(f"activation: {activation!r}, should be one of {', '.join(SMOOTH_ACTIVATIONS)}")
        self.activation, self.hidden = activation, tuple(hidden)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        last = self._linear[-1]
        with torch.no_grad():
            last.weight.mul_(FIRST_OUTPUTS)
            last.bias.zero_()

    @property
    def _linear(self) -> list[nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def forward(self, normalized: Tensor) -> Tensor:
        values = normalized
        for layer in self._linear[:-1]:
            values = layer(values)
            values = torch.tanh(values) if self.activation == "tanh" else nn.functional.silu(values)
        result: Tensor = self._linear[-1](values)
        return result

    def forward_with_tangent(self, normalized: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Evaluate the layers and their directional derivative, both differentiable in the weights.

        Forward-mode differentiation written out by hand: without bookkeeping it costs two forward passes.
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

    def export(self, metadata: Mapping[str, Any]) -> ExportedPolicy:
        """Export the network, with the units of its actions folded into the last layer."""
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
