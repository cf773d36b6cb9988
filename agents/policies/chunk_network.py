"""The trainable transformer of a `ChunkingPolicy`, in PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from agents.policies.chunking import ChunkingPolicy
from agents.policies.exported import FloatArray
from agents.policies.network import FIRST_OUTPUTS, NormalizedNetwork

FIRST_POSITIONS = 0.3  # initial size of the learned positions, like that of the embedded observation
_ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {"tanh": torch.tanh, "silu": nn.functional.silu}


class ChunkNetwork(NormalizedNetwork):
    """From normalized observations, shape (B, n_obs), to normalized chunks, shape (B, k, n_u), not clipped.

    A perceptron embeds the observation; a token for each action of the chunk is that plus a learned position.
    Layers of self-attention with the normalization first, as PyTorch has them, follow.
    """

    def __init__(
        self,
        n_observation: int,
        n_action: int,
        *,
        hidden: Sequence[int],
        activation: str,
        chunk: int,
        width: int,
        layers: int,
        heads: int,
        spacing: int,
        weighting: float,
    ) -> None:
        """Make a network with random weights from PyTorch's generator, without normalization."""
        super().__init__(n_observation, n_action)
        self.activation, self.heads = activation, heads
        self.spacing, self.weighting = spacing, weighting  # of the exported policy
        self._activate = _ACTIVATIONS[activation]
        self.embed = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([n_observation, *hidden, width]))
        self.positions = nn.Parameter(FIRST_POSITIONS * torch.randn(chunk, width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, 0.0, self._activate, batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(
            layer, layers, norm=nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.out = nn.Linear(width, n_action)
        with torch.no_grad():
            self.out.weight.mul_(FIRST_OUTPUTS)
            self.out.bias.zero_()

    def forward(self, normalized: Tensor) -> Tensor:
        values = normalized
        for layer in self.embed[:-1]:
            values = self._activate(layer(values))
        tokens = self.embed[-1](values)[:, None] + self.positions
        result: Tensor = self.out(self.transformer(tokens))
        return result

    def export(self, metadata: Mapping[str, Any]) -> ChunkingPolicy:
        """Export the network, with the units of its actions folded into the last layer."""
        scale = self.action_scale.numpy()
        tensors = {"positions": _array(self.positions), **_of_norm("norm", "", self.transformer.norm)}
        for i, layer in enumerate(self.embed):
            tensors |= _of_linear("embed", f"_{i}", layer)
        for i, each in enumerate(self.transformer.layers):
            part, end = each, f"_{i}"
            attention = part.self_attn
            tensors |= _of_norm("attend_norm", end, part.norm1)
            tensors[f"attend_in_weight{end}"] = _array(attention.in_proj_weight).T
            tensors[f"attend_in_bias{end}"] = _array(attention.in_proj_bias)
            tensors |= _of_linear("attend_out", end, attention.out_proj)
            tensors |= _of_norm("feed_norm", end, part.norm2)
            tensors |= _of_linear("feed_in", end, part.linear1) | _of_linear("feed_out", end, part.linear2)
        tensors["out_weight"] = _array(self.out.weight).T * scale
        tensors["out_bias"] = _array(self.out.bias) * scale + self.action_mean.numpy()
        return ChunkingPolicy(
            tensors={name: array.astype(np.float32) for name, array in tensors.items()},
            activation=self.activation,
            heads=self.heads,
            spacing=self.spacing,
            weighting=self.weighting,
            mean=self.observation_mean.numpy(),
            scale=self.observation_scale.numpy(),
            metadata=metadata,
        )


def _array(tensor: Tensor) -> FloatArray:
    array: FloatArray = tensor.detach().double().numpy()
    return array


def _of_linear(name: str, end: str, layer: Any) -> dict[str, FloatArray]:
    return {f"{name}_weight{end}": _array(layer.weight).T, f"{name}_bias{end}": _array(layer.bias)}


def _of_norm(name: str, end: str, layer: Any) -> dict[str, FloatArray]:
    return {f"{name}_weight{end}": _array(layer.weight), f"{name}_bias{end}": _array(layer.bias)}
