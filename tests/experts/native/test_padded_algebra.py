import numpy as np
import pytest

from experts.native.compilation import compiled
from experts.native.padded_algebra import (
    FloatArray,
    add_product,
    add_product_upper,
    add_vector_product,
    copy_in,
    factorize,
    mirror_upper,
    padded,
    padded_zeros,
    set_product,
    solve_in_place,
    solve_vector_in_place,
)
from experts.native.vector_tiles import copy_row_out, set_row_sum, set_vector_sum

SIZES = [(1, 1, 1), (3, 5, 4), (8, 8, 8), (21, 12, 21), (12, 21, 9), (7, 60, 5)]


def in_padding(matrix: np.ndarray, filler: float = 0.0) -> np.ndarray:
    """The matrix with padded rows."""
    result = padded_zeros(*matrix.shape)
    result[:] = filler
    result[:, : matrix.shape[1]] = matrix
    return result


def random_positive(rng: np.random.Generator, n: int, condition: float = 1e3) -> np.ndarray:
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return (basis * np.geomspace(1.0, condition, n)) @ basis.T


@pytest.mark.parametrize(("n", "m", "depth"), SIZES)
def test_set_product(n: int, m: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    left, right = rng.normal(size=(depth, n)), rng.normal(size=(depth, m))
    target = np.full((n, padded(m)), np.nan)
    set_product(target, in_padding(left), in_padding(right), depth)
    np.testing.assert_allclose(target[:, :m], left.T @ right, rtol=1e-13, atol=1e-13)
    add_product(target, in_padding(left), in_padding(right), depth)
    np.testing.assert_allclose(target[:, :m], 2.0 * left.T @ right, rtol=1e-13, atol=1e-13)


def test_product_is_blind_to_what_padding_and_further_rows_hold() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=(5, 3)), rng.normal(size=(5, 11))
    target = np.zeros((3, 16))
    set_product(target, in_padding(left, np.nan), in_padding(right, np.nan), 5)
    np.testing.assert_allclose(target[:, :11], left.T @ right, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("n", [1, 4, 12, 21])
def test_add_product_upper_and_mirror(n: int) -> None:
    rng = np.random.default_rng(n)
    weights, factor = random_positive(rng, n), rng.normal(size=(n, n))
    start = random_positive(rng, n)
    target = in_padding(np.triu(start))
    add_product_upper(target, in_padding(factor), in_padding(weights @ factor), n)
    mirror_upper(target, n)
    expected = start + factor.T @ weights @ factor
    np.testing.assert_allclose(target[:n, :n], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(target[:n, :n], target[:n, :n].T)


def test_add_vector_product_and_copy() -> None:
    rng = np.random.default_rng(3)
    matrix, vector, target = rng.normal(size=(6, 9)), rng.normal(size=6), rng.normal(size=9)
    expected = target + matrix.T @ vector
    large = np.full((8, 16), np.nan)
    copy_in(large, matrix)
    np.testing.assert_array_equal(large[:6, :9], matrix)
    assert np.all(large[:6, 9 : padded(9)] == 0.0)
    add_vector_product(target, large, vector, 6)
    np.testing.assert_allclose(target, expected, rtol=1e-14, atol=1e-14)


@compiled
def sum_rows(
    target: FloatArray, source: FloatArray, other: FloatArray, vector: FloatArray, out: FloatArray
) -> None:
    """Rows: target[1] = source[2] - 3 other[0], out[1] = source[0]; vector = out[0] + source' vector."""
    set_row_sum(target, 1, source, 2, -3.0, other, 0)
    copy_row_out(out, 1, source, 0)
    set_vector_sum(target[0], out[0], source, vector, 3)


@pytest.mark.parametrize("m", [1, 8, 12, 21, 30])
def test_operations_on_rows_stay_inside_them(m: int) -> None:
    rng = np.random.default_rng(m)
    source, other, vector = rng.normal(size=(3, m)), rng.normal(size=(2, m)), rng.normal(size=3)
    start = rng.normal(size=m)
    target, out = np.full((3, padded(m)), 7.0), np.full((3, m), 7.0)
    out[0] = start
    sum_rows(target, in_padding(source), in_padding(other), vector, out)
    np.testing.assert_allclose(target[0, :m], start + source.T @ vector, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(target[1, :m], source[2] - 3.0 * other[0], rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(out, [start, source[0], np.full(m, 7.0)])
    assert np.all(target[2] == 7.0)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 12, 17])
def test_factor_and_solutions(n: int) -> None:
    rng = np.random.default_rng(n)
    matrix = random_positive(rng, n)
    factor, inverse_pivots = in_padding(np.triu(matrix)), np.zeros(n)
    assert factorize(factor, inverse_pivots, n)
    cholesky = np.linalg.cholesky(matrix)
    np.testing.assert_allclose(inverse_pivots, np.diag(cholesky) ** -2, rtol=1e-10)
    upper = (cholesky / np.diag(cholesky)).T
    np.testing.assert_allclose(np.triu(factor[:, :n], 1), np.triu(upper, 1), rtol=1e-10, atol=1e-10)

    right_side = rng.normal(size=(n + 2, 30))
    many, one = in_padding(right_side), right_side[:, 2].copy()
    solve_in_place(factor, inverse_pivots, many, n)
    solve_vector_in_place(factor, inverse_pivots, one, n)
    expected = np.linalg.solve(matrix, right_side[:n])
    np.testing.assert_allclose(many[:n, :30], expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(one[:n], expected[:, 2], rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(many[n:, :30], right_side[n:])


@pytest.mark.parametrize(
    "matrix",
    [
        np.array([[0.0]]),
        np.array([[-1.0]]),
        np.array([[np.nan]]),
        np.array([[np.inf]]),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.array([[1.0, 1.0], [1.0, 1.0]]),
        np.array([[1.0, np.nan], [np.nan, 1.0]]),
    ],
)
def test_factorize_refuses_what_is_not_positive_definite(matrix: np.ndarray) -> None:
    n = len(matrix)
    assert not factorize(in_padding(matrix), np.zeros(n), n)
