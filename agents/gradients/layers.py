"""The layers of a policy, and the gradients by their weights over whole episodes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.gradients.episode_loops import Network
from experts.native.vector_code import LANES

Array = NDArray[Any]
SingleArray = NDArray[np.float32]
ROW = 8 * LANES  # bytes of a vector; rows are whole ones
FIRST_OUTPUTS = 0.01  # size of the last layer relative to the others at first, to start near rest


def random_weights(sizes: Sequence[int], rng: np.random.Generator) -> list[SingleArray]:
    """Matrix and bias of each layer in turn; rows or columns of the matrices are orthonormal."""
    weights = []
    for inputs, outputs in pairwise(sizes):
        matrix = np.linalg.qr(rng.normal(size=(max(inputs, outputs), min(inputs, outputs))))[0]
        matrix = matrix if inputs >= outputs else matrix.T
        weights += [matrix.astype(np.float32), np.zeros(outputs, np.float32)]
    weights[-2] *= np.float32(FIRST_OUTPUTS)
    return weights


class Layers:
    """A network with tanh between its layers, evaluated for K decisions of B episodes by `episode_loops`.

    What each decision computes is kept: gradients by the weights are then one product for all decisions.

    Attributes:
        weights: Matrix and bias of each layer in turn.
        shape: Numbers of decisions, episodes, and inputs.
        outputs: Those of the last flight, shape (K, B, n).
        network: Its arrays, padded; valid after `prepare`.
    """

    def __init__(self, weights: Sequence[Array], decisions: int, episodes: int) -> None:
        """Take weights as `random_weights` gives them; they are shared, and changed in place by the owner."""
        self.weights, dtype = weights, weights[0].dtype
        sizes = [len(weights[0]), *(len(bias) for bias in weights[1::2])]
        self.shape = decisions, episodes, sizes[0]
        columns = [-(-size // (ROW // dtype.itemsize)) * (ROW // dtype.itemsize) for size in sizes]

        def zeros(*shape: int) -> Array:
            return np.zeros(shape, dtype)

        values, cotangents = (tuple(zeros(decisions, episodes, count) for count in columns) for _ in range(2))
        self.network = Network(
            values=values,
            cotangents=cotangents,
            matrices=tuple(zeros(size, count) for size, count in zip(sizes, columns[1:], strict=False)),
            transposes=tuple(zeros(size, count) for size, count in zip(sizes[1:], columns, strict=False)),
            biases=tuple(zeros(count) for count in columns[1:]),
            zeros=zeros(max(columns)),
        )
        self.outputs = values[-1][..., : sizes[-1]]
        self._ones = np.ones(decisions * episodes, dtype)  # NumPy sums along the first axis more slowly

    def prepare(self) -> None:
        """Take over what the owner has changed of the weights."""
        network = self.network
        for index, (matrix, bias) in enumerate(zip(self.weights[::2], self.weights[1::2], strict=True)):
            network.matrices[index][:, : len(bias)] = matrix
            network.transposes[index][:, : len(matrix)] = matrix.T
            network.biases[index][: len(bias)] = bias

    def forget(self, episodes: NDArray[np.bool_]) -> None:
        """Set to zero what some episodes (B,) have computed."""
        for values in self.network.values:
            values[:, episodes] = 0.0

    def gradient(self) -> list[Array]:
        """Gradients by all weights, summed over decisions and episodes; after the way back."""
        found: list[Array] = []
        network, matrices = self.network, self.weights[::2]
        for values, cotangents, matrix in zip(network.values, network.cotangents[1:], matrices, strict=False):
            given, slopes = (each.reshape(-1, each.shape[-1]) for each in (values, cotangents))
            rows, columns = matrix.shape  # without padding
            found += [(given.T @ slopes)[:rows, :columns], (self._ones @ slopes)[:columns]]
        return found
