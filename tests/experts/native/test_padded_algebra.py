import numpy as np
import pytest

from experts.native import padded_algebra
from experts.native.compilation import compiled
from experts.native.padded_algebra import FloatArray, nonzero_rows, padded, padded_zeros
from experts.native.vector_tiles import copy_in, copy_row, copy_row_out, set_row_sum, set_vector_sum

# Parts of loops, each compiled as a loop that Python can call.
add_vector_product = compiled(padded_algebra.add_vector_product.py_func)
factorize = compiled(padded_algebra.factorize.py_func)
mirror_upper = compiled(padded_algebra.mirror_upper.py_func)
set_product_sum = compiled(padded_algebra.set_product_sum.py_func)
set_product_sum_upper = compiled(padded_algebra.set_product_sum_upper.py_func)
set_symmetric_product = compiled(padded_algebra.set_symmetric_product.py_func)
substitute = compiled(padded_algebra.substitute.py_func)

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


@compiled
def copy_rows(target: FloatArray, source: FloatArray, other: FloatArray) -> None:
    """The matrix into padded rows; its second row over the first of another one."""
    copy_in(target, source)
    copy_row(other, 0, target, 1)


@pytest.mark.parametrize(("n", "m", "depth"), SIZES)
def test_product_sum_starts_from_columns_that_may_be_few(n: int, m: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    left, right = rng.normal(size=(depth, n)), rng.normal(size=(depth, m))
    for columns in {1, m // 2 + 1, m}:
        start, target = rng.normal(size=(n, columns)), np.full((n, padded(m)), np.nan)
        set_product_sum(target, start, in_padding(left), in_padding(right), depth)
        expected = left.T @ right
        expected[:, :columns] += start
        np.testing.assert_allclose(target[:, :m], expected, rtol=1e-13, atol=1e-13)
    set_product_sum(target, target, in_padding(left), in_padding(right), depth)
    np.testing.assert_allclose(target[:, :m], expected + left.T @ right, rtol=1e-13, atol=1e-13)


def test_product_is_blind_to_what_padding_and_further_rows_hold() -> None:
    rng = np.random.default_rng(0)
    left, right, target = rng.normal(size=(5, 3)), rng.normal(size=(5, 11)), padded_zeros(3, 11)
    set_product_sum(target, np.zeros((3, 1)), in_padding(left, np.nan), in_padding(right, np.nan), 5)
    np.testing.assert_allclose(target[:, :11], left.T @ right, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("n", "m", "depth"), SIZES)
def test_product_over_nonzero_rows_is_that_over_all(n: int, m: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    pattern = rng.uniform(size=(depth, n)) < 0.2
    left, right = np.where(pattern, rng.normal(size=(depth, n)), 0.0), in_padding(rng.normal(size=(depth, m)))
    start, found, expected = rng.normal(size=(n, m)), padded_zeros(n, m), padded_zeros(n, m)
    set_product_sum(found, start, in_padding(left), right, nonzero_rows(pattern))
    set_product_sum(expected, start, in_padding(left), right, depth)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 9), (4, 8), (8, 33), (12, 21), (21, 40), (22, 50)])
def test_symmetric_product_reads_the_upper_triangle(n: int, m: int) -> None:
    rng = np.random.default_rng(n)
    symmetric, right = random_positive(rng, n), rng.normal(size=(n, m))
    upper, target = np.where(np.tri(n, k=-1) > 0, np.nan, symmetric), padded_zeros(n, m)
    set_symmetric_product(target, in_padding(upper), in_padding(right))
    np.testing.assert_allclose(target[:, :m], symmetric @ right, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("n", [1, 4, 12, 21])
def test_product_sum_upper_and_mirror(n: int) -> None:
    rng = np.random.default_rng(n)
    weights, factor = random_positive(rng, n), rng.normal(size=(n, n))
    start, target = random_positive(rng, n), padded_zeros(n, n)
    set_product_sum_upper(target, start, in_padding(factor), in_padding(weights @ factor), n)
    mirror_upper(target, n)
    expected = start + factor.T @ weights @ factor
    np.testing.assert_allclose(target[:n, :n], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(target[:n, :n], target[:n, :n].T)


def test_add_vector_product_and_copy() -> None:
    rng = np.random.default_rng(3)
    matrix, vector, target = rng.normal(size=(6, 9)), rng.normal(size=6), rng.normal(size=9)
    expected = target + matrix.T @ vector
    large, longer = np.full((8, padded(9)), np.nan), np.zeros((1, padded(9) + 8))
    copy_rows(large, matrix, longer)
    np.testing.assert_array_equal(large[:6, :9], matrix)
    assert np.all(large[:6, 9:] == 0.0)
    np.testing.assert_array_equal(longer[0, :9], matrix[1])
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
    matrix, right_side = random_positive(rng, n), rng.normal(size=(n + 2, 30))
    factor, inverse_pivots = padded_zeros(n + 2, padded(n) + 30), np.zeros(n)
    factor[:n, :n], factor[:, padded(n) : padded(n) + 30] = np.triu(matrix), right_side
    assert factorize(factor, inverse_pivots, n)
    pivots = np.diag(np.linalg.cholesky(matrix))
    np.testing.assert_allclose(inverse_pivots, pivots**-2, rtol=1e-10)
    upper = pivots[:, np.newaxis] * np.linalg.cholesky(matrix).T
    np.testing.assert_allclose(np.triu(factor[:n, :n]), upper, rtol=1e-10, atol=1e-10)

    substitute(factor, inverse_pivots, padded(n), n)
    many = factor[:, padded(n) :]
    expected = np.linalg.solve(matrix, right_side[:n])
    np.testing.assert_allclose(many[:n, :30], -expected, rtol=1e-10, atol=1e-10)
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
