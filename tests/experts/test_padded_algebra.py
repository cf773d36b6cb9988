import numpy as np
import pytest

from experts.padded_algebra import (
    TILE_ROWS,
    add_product_upper,
    add_vector_product,
    copy_block,
    factorize,
    mirror_upper,
    padded,
    set_product,
    solve_in_place,
    solve_vector_in_place,
)

SIZES = [(1, 1, 1), (3, 5, 4), (8, 8, 8), (21, 12, 21), (12, 21, 9)]


def in_padding(matrix: np.ndarray, filler: float = 0.0) -> np.ndarray:
    """The matrix in the corner of one with padded rows and columns."""
    result = np.full((padded(matrix.shape[0]), padded(matrix.shape[1])), filler)
    result[: matrix.shape[0], : matrix.shape[1]] = matrix
    return result


def random_positive(rng: np.random.Generator, n: int, condition: float = 1e3) -> np.ndarray:
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return (basis * np.geomspace(1.0, condition, n)) @ basis.T


@pytest.mark.parametrize(("size", "expected"), [(1, 8), (8, 8), (9, 16), (21, 24)])
def test_padded_rounds_up_to_whole_vectors(size: int, expected: int) -> None:
    assert padded(size) == expected
    assert padded(size) % TILE_ROWS == 0


@pytest.mark.parametrize(("n", "m", "depth"), SIZES)
def test_set_product(n: int, m: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    left, right = rng.normal(size=(depth, n)), rng.normal(size=(depth, m))
    target = np.full((padded(n), padded(m)), np.nan)
    set_product(target, in_padding(left), in_padding(right), depth)
    np.testing.assert_allclose(target[:n, :m], left.T @ right, rtol=1e-13, atol=1e-13)


def test_product_is_blind_to_what_padding_and_further_rows_hold() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=(5, 3)), rng.normal(size=(5, 11))
    target = np.zeros((8, 16))
    set_product(target, in_padding(left, np.nan), in_padding(right, np.nan), 5)
    np.testing.assert_allclose(target[:3, :11], left.T @ right, rtol=1e-13, atol=1e-13)


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
    large = np.zeros((8, 16))
    copy_block(large, matrix)
    np.testing.assert_array_equal(large[:6, :9], matrix)
    add_vector_product(target, large, vector, 6)
    np.testing.assert_allclose(target, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 12, 17])
def test_cholesky_factor_and_solutions(n: int) -> None:
    rng = np.random.default_rng(n)
    matrix = random_positive(rng, n)
    factor, inverse_diagonal = in_padding(np.triu(matrix)), np.zeros(n)
    assert factorize(factor, inverse_diagonal, n)
    upper = np.linalg.cholesky(matrix).T
    np.testing.assert_allclose(np.triu(factor[:n, :n]), upper, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(inverse_diagonal, 1.0 / np.diag(upper), rtol=1e-10)

    right_side = rng.normal(size=(n, 5))
    many, one = in_padding(right_side), right_side[:, 2].copy()
    solve_in_place(factor, inverse_diagonal, many, n)
    solve_vector_in_place(factor, inverse_diagonal, one, n)
    expected = np.linalg.solve(matrix, right_side)
    np.testing.assert_allclose(many[:n, :5], expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(one, expected[:, 2], rtol=1e-10, atol=1e-10)


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
