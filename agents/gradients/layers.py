"""The layers of a policy in NumPy, in single precision, with their gradients over whole episodes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

SingleArray = NDArray[np.float32]
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
    """A network with tanh between its layers, evaluated for K decisions of B episodes.

    What each decision computes is kept: gradients by the weights are then one product for all decisions.
    """

    def __init__(self, weights: Sequence[SingleArray], decisions: int, episodes: int) -> None:
        """Take weights as `random_weights` gives them; they are shared, and changed in place by the owner."""
        self.weights = weights
        sizes = [len(weights[0]), *(len(bias) for bias in weights[1::2])]
        self.values: list[SingleArray] = [np.zeros((decisions, episodes, size), np.float32) for size in sizes]
        self._cotangents: list[SingleArray] = [
            np.zeros((decisions, episodes, size), np.float32) for size in sizes
        ]
        self._last = len(sizes) - 1
        self._ones = np.ones(decisions * episodes, np.float32)  # NumPy sums along the first axis more slowly

    def forward(self, decision: int) -> SingleArray:
        """Outputs (B, n) of the inputs that `values[0]` holds for a decision."""
        for index in range(self._last):
            result = self.values[index + 1][decision]
            np.matmul(self.values[index][decision], self.weights[2 * index], out=result)
            result += self.weights[2 * index + 1]
            if index + 1 < self._last:
                np.tanh(result, out=result)
        outputs: SingleArray = self.values[-1][decision]
        return outputs

    def backward(self, decision: int, cotangent: NDArray[Any]) -> SingleArray:
        """From the outputs' cotangents of a decision to those of its inputs, (B, n)."""
        self._cotangents[-1][decision] = cotangent
        for index in range(self._last, 0, -1):
            slope, value = self._cotangents[index][decision], self.values[index][decision]
            if index < self._last:
                of_tanh = value * value
                slope *= np.subtract(1.0, of_tanh, out=of_tanh)
            np.matmul(slope, self.weights[2 * index - 2].T, out=self._cotangents[index - 1][decision])
        inputs: SingleArray = self._cotangents[0][decision]
        return inputs

    def gradient(self) -> list[SingleArray]:
        """Gradients by all weights, summed over decisions and episodes; after `backward` of all decisions."""
        found: list[SingleArray] = []
        for values, cotangents in zip(self.values, self._cotangents[1:], strict=False):
            rows = cotangents.reshape(-1, cotangents.shape[-1])
            found += [values.reshape(len(rows), -1).T @ rows, self._ones @ rows]
        return found
