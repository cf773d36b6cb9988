"""Butcher tableaus: every order condition, and SciPy's copies of those that it has."""

import numpy as np
import pytest
from rooted_trees import defects, elementary_weights, symmetry, trees
from scipy.integrate import RK45
from scipy.integrate._ivp import dop853_coefficients

from dq_space_arm_env.integrators.tableaus import (
    CALVO_6,
    DORMAND_PRINCE_5,
    DORMAND_PRINCE_8,
    DORMAND_PRINCE_DENSE,
)

TABLEAUS = {"calvo 6": CALVO_6, "dormand-prince 5": DORMAND_PRINCE_5, "dormand-prince 8": DORMAND_PRINCE_8}


def square(tableau):
    a = np.zeros((len(tableau.stages), len(tableau.stages)))
    for i, row in enumerate(tableau.stages):
        a[i, : len(row)] = row
    return a


def test_there_are_as_many_rooted_trees_as_counted_by_cayley():
    assert [len(trees(n)) for n in range(1, 10)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]


@pytest.mark.parametrize("name", TABLEAUS)
def test_a_tableau_meets_all_conditions_up_to_its_order_and_not_those_of_the_next(name):
    tableau = TABLEAUS[name]
    a, b = square(tableau), np.array(tableau.weights)
    assert [len(row) for row in tableau.stages] == list(range(len(b)))
    for size in range(1, tableau.order + 1):
        assert np.abs(defects(size, a, b)).max() < 1e-14, size
    assert np.abs(defects(tableau.order + 1, a, b)).max() > 1e-7


@pytest.mark.parametrize("name", TABLEAUS)
def test_the_embedded_solution_has_order_4_or_5(name):
    tableau = TABLEAUS[name].with_end
    a, embedded = square(tableau), np.array(tableau.weights) - np.array(tableau.error)
    order = 4 if name == "dormand-prince 5" else 5
    for size in range(1, order + 1):
        assert np.abs(defects(size, a, embedded)).max() < 1e-14
    assert np.abs(defects(order + 1, a, embedded)).max() > 1e-4


def test_the_error_of_calvos_method_is_scaled_like_that_of_dormand_and_prince():
    sizes = []
    for tableau, order in ((CALVO_6.with_end, 6), (DORMAND_PRINCE_5, 5)):
        conditions = [elementary_weights(tree, square(tableau)) / symmetry(tree) for tree in trees(order)]
        sizes.append(float(np.linalg.norm(np.array(conditions) @ tableau.error)))
    assert sizes == pytest.approx([1e-3, 1.18e-3], rel=1e-2)


def test_the_last_stage_of_dormand_and_prince_starts_where_the_step_ends():
    assert (*DORMAND_PRINCE_5.stages[-1], 0.0) == DORMAND_PRINCE_5.weights


@pytest.mark.parametrize("theta", [0.1, 0.35, 0.5, 0.8, 1.0])
def test_the_dense_output_has_order_4_anywhere_in_the_step(theta):
    a, powers = square(DORMAND_PRINCE_5), theta ** np.arange(1, 5)
    b = np.array(DORMAND_PRINCE_DENSE) @ powers
    for size in range(1, 5):
        assert np.abs(defects(size, a, b, theta)).max() < 1e-14


def test_the_dense_output_joins_smoothly():
    """It ends with the weights of the step, and begins and ends with the first and the last stage's rates."""
    dense = np.array(DORMAND_PRINCE_DENSE)
    np.testing.assert_allclose(dense.sum(axis=1), DORMAND_PRINCE_5.weights, rtol=0, atol=1e-14)
    np.testing.assert_allclose(dense[:, 0], np.eye(7)[0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(dense @ np.arange(1, 5), np.eye(7)[6], rtol=0, atol=2e-14)


def test_coefficients_are_those_of_scipy():
    a, b = dop853_coefficients.A[:12, :12], dop853_coefficients.B
    np.testing.assert_array_equal(square(DORMAND_PRINCE_8), a)
    np.testing.assert_array_equal(DORMAND_PRINCE_8.weights, b)
    np.testing.assert_allclose(DORMAND_PRINCE_8.error, dop853_coefficients.E5[:12], rtol=0, atol=1e-16)
    np.testing.assert_array_equal(square(DORMAND_PRINCE_5)[:6, :5], RK45.A)
    np.testing.assert_allclose(DORMAND_PRINCE_5.error, -RK45.E, rtol=0, atol=1e-16)
    np.testing.assert_array_equal(DORMAND_PRINCE_DENSE, RK45.P)
