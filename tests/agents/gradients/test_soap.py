"""SOAP: it does not see the axes of rows and columns, and goes on to the bit."""

import numpy as np

from agents.gradients.soap import BETWEEN_BASES, SOAP

UPDATES = 2 * BETWEEN_BASES + 5
RATE = 0.1


def gradients(rng, n):
    """Of a matrix and of a bias; those of the matrix have spreads of their own along rows and columns."""
    spread = np.logspace(0.0, -2.0, 5)[:, None] * np.logspace(0.0, -1.0, 4)
    return [(spread * rng.normal(size=(5, 4)), rng.normal(size=4)) for _ in range(n)]


def test_turned_axes_turn_the_steps():
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for n in (5, 4))
    matrix, bias = rng.normal(size=(5, 4)), rng.normal(size=4)
    plain, turned = [matrix.copy(), bias.copy()], [left.T @ matrix @ right, bias.copy()]
    one, other = SOAP(plain), SOAP(turned)
    for by_matrix, by_bias in gradients(rng, UPDATES):
        one.update([by_matrix, by_bias], RATE)
        other.update([left.T @ by_matrix @ right, by_bias], RATE)
    np.testing.assert_allclose(turned[0], left.T @ plain[0] @ right, atol=5e-7)  # directions without gradient
    np.testing.assert_array_equal(turned[1], plain[1])
    assert np.abs(plain[0] - matrix).max() > RATE


def test_it_goes_on_where_it_was():
    given = gradients(np.random.default_rng(1), UPDATES)
    whole = [np.zeros((5, 4)), np.zeros(4)]
    optimizer = SOAP(whole)
    for each in given[: UPDATES // 2]:
        optimizer.update(each, RATE)
    resumed = [each.copy() for each in whole]
    other = SOAP(resumed)
    other.restore({name: np.array(each) for name, each in optimizer.arrays().items()})
    for each in given[UPDATES // 2 :]:
        optimizer.update(each, RATE)
        other.update(each, RATE)
    for one, two in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(one, two)
