"""SOAP (Vyas et al., 2024, arXiv:2409.11321): Adam in the eigenbases of each matrix's gradients.

Rows and columns of a layer's gradient are strongly correlated. In the eigenbases of their covariances they
are not, and Adam's scaling of single numbers then approximates that of the whole matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

MEAN, SQUARE, COVARIANCE = 0.9, 0.999, 0.95  # decay per update of the averages
BETWEEN_BASES = 10  # updates between new eigenbases
SMALLEST = 1e-8


class SOAP:
    """The optimizer of a list of matrices and biases, changed in place; biases follow Adam."""

    def __init__(self, weights: Sequence[Array]) -> None:
        self._weights, self._updates = weights, 0
        self._means = [np.zeros_like(each) for each in weights]
        self._squares = [np.zeros_like(each) for each in weights]
        self._covariances = [[np.zeros((n, n)) for n in _sides(each)] for each in weights]
        self._bases = [[np.eye(n, dtype=each.dtype) for n in _sides(each)] for each in weights]

    def update(self, gradients: Sequence[Array], rate: float) -> None:
        """Take a step against the gradients."""
        self._updates += 1
        unbiased, spread = 1.0 - MEAN**self._updates, 1.0 - SQUARE**self._updates
        for index, (weight, gradient) in enumerate(zip(self._weights, gradients, strict=True)):
            self._follow(index, gradient)
            mean, square = self._means[index], self._squares[index]
            mean += (1.0 - MEAN) * (gradient - mean)
            turned = self._turn(index, gradient)
            square += (1.0 - SQUARE) * (turned * turned - square)
            step = self._turn(index, mean) / (np.sqrt(square / spread) + SMALLEST)
            weight -= (rate / unbiased) * self._turn(index, step, back=True)

    def _follow(self, index: int, gradient: Array) -> None:
        """Average the covariances of a matrix's gradient, and take their eigenbases now and then."""
        if gradient.ndim < 2:
            return
        exact, covariances = gradient.astype(np.float64), self._covariances[index]
        for covariance, product in zip(covariances, (exact @ exact.T, exact.T @ exact), strict=True):
            covariance += (1.0 - COVARIANCE) * (product - covariance)
        if self._updates % BETWEEN_BASES == 1:
            bases = (np.linalg.eigh(each)[1] for each in covariances)
            self._bases[index] = [np.ascontiguousarray(each, gradient.dtype) for each in bases]

    def _turn(self, index: int, matrix: Array, *, back: bool = False) -> Array:
        """A matrix in the eigenbases, or from there back."""
        if matrix.ndim < 2:
            return matrix
        left, right = self._bases[index]
        turned: Array = left @ matrix @ right.T if back else left.T @ matrix @ right
        return turned

    def arrays(self) -> dict[str, Array]:
        """Everything that it remembers, by name."""
        found: dict[str, Array] = {"updates": np.array(self._updates)}
        for index in range(len(self._weights)):
            found |= {f"mean{index}": self._means[index], f"square{index}": self._squares[index]}
            pairs = zip(self._covariances[index], self._bases[index], strict=True)
            for side, (covariance, basis) in enumerate(pairs):
                found |= {f"covariance{index}.{side}": covariance, f"basis{index}.{side}": basis}
        return found

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Go on from what `arrays` has returned."""
        self._updates = int(arrays["updates"])
        for index in range(len(self._weights)):
            self._means[index] = arrays[f"mean{index}"].copy()
            self._squares[index] = arrays[f"square{index}"].copy()
            sides = range(len(self._bases[index]))
            self._covariances[index] = [arrays[f"covariance{index}.{side}"].copy() for side in sides]
            self._bases[index] = [arrays[f"basis{index}.{side}"].copy() for side in sides]


def _sides(weight: Array) -> tuple[int, ...]:
    """Sizes of the bases of a weight: those of a matrix's rows and columns; none for a bias."""
    return weight.shape if weight.ndim == 2 else ()
