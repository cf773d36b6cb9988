"""The box QP against an enumeration of all active sets, and against its optimality conditions."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experts.ddp import box_qp as box_qp_module
from experts.ddp.box_qp import NOT_POSITIVE_DEFINITE, SOLVED, box_qp_workspace
from experts.native.compilation import compiled
from experts.native.padded_algebra import padded_zeros

Vector = np.ndarray
box_qp = compiled(box_qp_module.box_qp.py_func)  # a part of the backward pass, called from Python here


def solve(
    hessian: Vector, gradient: Vector, lower: Vector, upper: Vector, guess: Vector | None = None
) -> tuple[int, Vector, Vector, Vector]:
    """Status, minimizer, indices of the free components, their block of the Hessian put together again."""
    n = len(gradient)
    work = box_qp_workspace(n)
    minimizer = np.zeros(n) if guess is None else guess.copy()
    padded_hessian = padded_zeros(n, n)
    padded_hessian[:, :n] = hessian
    status, n_free = box_qp(padded_hessian, gradient, lower, upper, minimizer, work)
    factor = np.triu(work.system[:n_free, :n_free])
    block = (factor.T * work.inverse_pivots[:n_free]) @ factor
    return status, minimizer, work.free[:n_free].copy(), block


def enumerate_active_sets(hessian: Vector, gradient: Vector, lower: Vector, upper: Vector) -> Vector:
    """Minimizer by brute force: every component at its lower bound, free, or at its upper bound."""
    best, best_value = np.full(len(gradient), np.nan), np.inf
    for pattern in itertools.product((-1, 0, 1), repeat=len(gradient)):
        sides = np.array(pattern)
        x = np.where(sides < 0, lower, np.where(sides > 0, upper, 0.0))
        if not np.all(np.isfinite(x)):
            continue
        free = sides == 0
        if free.any():
            x[free] = np.linalg.solve(hessian[np.ix_(free, free)], -(gradient + hessian @ x)[free])
        value = 0.5 * x @ hessian @ x + gradient @ x
        if np.all((lower - 1e-12 <= x) & (x <= upper + 1e-12)) and value < best_value:
            best, best_value = x, value
    return best


def random_problem(seed: int) -> tuple[Vector, Vector, Vector, Vector]:
    """Badly scaled, with zero-width and one-sided boxes among them."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    scale = 10.0 ** rng.uniform(-2.0, 2.0, size=n)
    root = rng.normal(size=(n + 2, n)) * scale
    lower, upper = -rng.exponential(size=n) / scale, rng.exponential(size=n) / scale
    if seed % 3 == 0:
        lower[0] = 0.0
    if seed % 4 == 0:
        upper[-1] = np.inf
    if seed % 5 == 0:
        lower[:] = -np.inf
    if seed % 7 == 0:
        lower[0] = upper[0] = 0.1 / scale[0]
    return root.T @ root, rng.normal(size=n) * scale * 10.0 ** rng.uniform(-1.0, 1.5), lower, upper


@pytest.mark.parametrize("seed", range(150))
def test_minimizer_agrees_with_enumeration(seed: int) -> None:
    hessian, gradient, lower, upper = random_problem(seed)
    guess = np.random.default_rng(seed).normal(size=len(gradient))
    status, x, free, block = solve(hessian, gradient, lower, upper, guess)
    expected = enumerate_active_sets(hessian, gradient, lower, upper)
    scale = np.sqrt(np.diag(hessian))
    assert status == SOLVED
    np.testing.assert_allclose(x * scale, expected * scale, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(block, hessian[np.ix_(free, free)], rtol=1e-9, atol=1e-12)


@settings(derandomize=True, max_examples=100, deadline=None)
@given(st.integers(0, 10_000), st.integers(6, 14))
def test_optimality_conditions(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n + 3, n))
    hessian, gradient = root.T @ root, 5.0 * rng.normal(size=n)
    lower, upper = -rng.exponential(0.3, size=n), rng.exponential(0.3, size=n)
    status, x, free, _ = solve(hessian, gradient, lower, upper)
    slope = gradient + hessian @ x
    clamped = np.setdiff1d(np.arange(n), free)
    assert status == SOLVED
    assert np.all((lower <= x) & (x <= upper))
    assert np.linalg.norm(slope[free]) <= 1e-8 * np.linalg.norm(gradient)
    assert np.all(np.where(x == lower, slope, -slope)[clamped] > 0.0)
    assert np.all(((x == lower) | (x == upper))[clamped])


def test_component_on_its_bound_without_slope_stays_free() -> None:
    status, x, free, _ = solve(np.eye(2), np.array([-1.0, -3.0]), np.zeros(2), np.ones(2))
    assert status == SOLVED
    assert x.tolist() == [1.0, 1.0]
    assert free.tolist() == [0]


@pytest.mark.parametrize("curvature", [2.0, -2.0])
def test_component_without_room_is_held_where_no_slope_holds_it(curvature: float) -> None:
    limits = np.array([1.0, 0.0])
    status, x, free, _ = solve(np.array([[2.0, 1.0], [1.0, curvature]]), np.zeros(2), -limits, limits)
    assert status == SOLVED
    assert x.tolist() == [0.0, 0.0]
    assert free.tolist() == [0]


@pytest.mark.parametrize("factor", [1e-20, 1e20])
def test_result_does_not_depend_on_the_unit_of_the_cost(factor: float) -> None:
    hessian, gradient, lower, upper = random_problem(1)
    _, x, free, _ = solve(hessian, gradient, lower, upper)
    _, scaled_x, scaled_free, _ = solve(factor * hessian, factor * gradient, lower, upper)
    assert scaled_free.tolist() == free.tolist()
    np.testing.assert_allclose(scaled_x, x, rtol=1e-9)


@pytest.mark.parametrize("hessian", [np.diag([1.0, -1.0]), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_hessian_that_is_not_positive_definite_is_reported(hessian: Vector) -> None:
    status, *_ = solve(hessian, np.ones(2), -np.ones(2), np.ones(2))
    assert status == NOT_POSITIVE_DEFINITE
