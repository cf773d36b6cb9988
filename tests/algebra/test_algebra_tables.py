"""Tables I and II of the paper, its operators and identities (1)-(8), and the dual inertia matrix (10)."""

import numpy as np
import pytest
from algebra_strategies import (
    DUAL_QUATERNIONS,
    DUAL_VECTORS,
    NUMBERS,
    QUATERNIONS,
    REPRODUCIBLE,
    VECTOR_DUAL_QUATERNIONS,
    VECTORS,
    unit_dual_quaternions,
    unit_quaternions,
)
from hypothesis import given

from dq_space_arm_env.algebra import dual_matrices as dm
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses, rotations, screw, vectors
from dq_space_arm_env.algebra import quaternion as qn


def assert_equal(actual, expected, scale=1.0):
    """Compare to rounding; `scale` is the size of the largest term on the way."""
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-14 * scale)


def size(*operands):
    """Return the product of the norms, at least 1."""
    return max(1.0, float(np.prod([1.0 + np.linalg.norm(operand) for operand in operands])))


class TestTableI:
    def test_hamilton_relations(self):
        """i^2 = j^2 = k^2 = ijk = -1, and 1 is neutral: with bilinearity that fixes the product."""
        one, i, j, k = np.eye(4)
        minus_one = (-1.0, 0.0, 0.0, 0.0)
        assert qn.multiply(i, i) == qn.multiply(j, j) == qn.multiply(k, k) == minus_one
        assert qn.multiply(qn.multiply(i, j), k) == minus_one
        for unit in (one, i, j, k):
            assert qn.multiply(one, unit) == qn.multiply(unit, one) == tuple(unit)

    @REPRODUCIBLE
    @given(QUATERNIONS, QUATERNIONS)
    def test_definitions(self, a, b):
        """Every row of the table, in terms of 3-vectors."""
        a_vector, b_vector = np.array(a[1:]), np.array(b[1:])
        cross = a[0] * b_vector + b[0] * a_vector + np.cross(a_vector, b_vector)
        scale = size(a, b)
        assert_equal(qn.add(a, b), np.add(a, b))
        assert_equal(qn.subtract(a, b), np.subtract(a, b))
        assert_equal(qn.scale(b[0], a), b[0] * np.array(a), scale)
        assert_equal(qn.multiply(a, b), [a[0] * b[0] - a_vector @ b_vector, *cross], scale)
        assert_equal(qn.conjugate(a), [a[0], *-a_vector])
        assert_equal(qn.dot(a, b), [np.dot(a, b), 0.0, 0.0, 0.0], scale)
        assert_equal(qn.cross(a, b), [0.0, *cross], scale)
        assert_equal(qn.norm(a), np.linalg.norm(a), scale)
        assert qn.vector_part(a) == (0.0, *a[1:]) == qn.from_vector(qn.to_vector(a))

    @REPRODUCIBLE
    @given(QUATERNIONS, QUATERNIONS)
    def test_matrices(self, a, b):
        """(1), and the 4 x 4 blocks of [.]_L and [.]_R."""
        scale = size(a, b)
        assert_equal(qn.matrix_multiply(qn.left_matrix(a), b), qn.multiply(a, b), scale)
        assert_equal(qn.matrix_multiply(qn.right_matrix(b), a), qn.multiply(a, b), scale)
        s, t = qn.vector_part(a), qn.vector_part(b)
        assert_equal(qn.matrix_multiply(qn.cross_matrix(s), t), qn.cross(s, t), scale)
        assert_equal(np.array(qn.cross_matrix(a))[0], 0.0)
        assert_equal(np.array(qn.cross_matrix(a))[:, 0], 0.0)


class TestTableII:
    @REPRODUCIBLE
    @given(DUAL_QUATERNIONS, DUAL_QUATERNIONS, NUMBERS)
    def test_definitions(self, a, b, factor):
        """Every row of the table, in terms of Table I."""
        (ar, ad), (br, bd) = (a[:4], a[4:]), (b[:4], b[4:])
        scale = size(a, b, [factor])
        assert (dq.real_part(a), dq.dual_part(a), dq.from_parts(ar, ad)) == (ar, ad, a)
        assert_equal(dq.add(a, b), np.add(a, b))
        assert_equal(dq.subtract(a, b), np.subtract(a, b))
        assert_equal(dq.scale(factor, a), factor * np.array(a), scale)
        assert_equal(dq.conjugate(a), qn.conjugate(ar) + qn.conjugate(ad))
        for dual_operation, operation in ((dq.dot, qn.dot), (dq.cross, qn.cross), (dq.multiply, qn.multiply)):
            expected = operation(ar, br) + qn.add(operation(ad, br), operation(ar, bd))
            assert_equal(dual_operation(a, b), expected, scale)
        assert_equal(dq.circle(a, b), [np.dot(a, b), *[0.0] * 7], scale)
        assert dq.swap(a) == ad + ar
        assert_equal(dq.norm(a), np.linalg.norm(a), scale)
        assert dq.vector_part(a) == (0.0, *a[1:4], 0.0, *a[5:]) == dq.from_vector(dq.to_vector(a))


class TestIdentities:
    @REPRODUCIBLE
    @given(DUAL_QUATERNIONS, DUAL_QUATERNIONS)
    def test_3(self, a, b):
        """a^s o b^s = a o b = b o a."""
        scale = size(a, b)
        assert_equal(dq.circle(dq.swap(a), dq.swap(b)), dq.circle(a, b), scale)
        assert_equal(dq.circle(b, a), dq.circle(a, b), scale)

    @REPRODUCIBLE
    @given(DUAL_QUATERNIONS, DUAL_QUATERNIONS, DUAL_QUATERNIONS)
    def test_4(self, a, b, c):
        """a o (bc) = b^s o (a^s c*) = c^s o (b* a^s), for all dual quaternions."""
        scale = size(a, b, c)
        expected = dq.circle(a, dq.multiply(b, c))
        a_swapped = dq.swap(a)
        assert_equal(dq.circle(dq.swap(b), dq.multiply(a_swapped, dq.conjugate(c))), expected, scale)
        assert_equal(dq.circle(dq.swap(c), dq.multiply(dq.conjugate(b), a_swapped)), expected, scale)

    @REPRODUCIBLE
    @given(VECTOR_DUAL_QUATERNIONS, VECTOR_DUAL_QUATERNIONS, VECTOR_DUAL_QUATERNIONS)
    def test_5(self, a, b, c):
        """a o (b x c) = b^s o (c x a^s) = c^s o (a^s x b), for vector dual quaternions."""
        scale = size(a, b, c)
        expected = dq.circle(a, dq.cross(b, c))
        assert_equal(dq.circle(dq.swap(b), dq.cross(c, dq.swap(a))), expected, scale)
        assert_equal(dq.circle(dq.swap(c), dq.cross(dq.swap(a), b)), expected, scale)


class TestDualMatrices:
    @REPRODUCIBLE
    @given(DUAL_QUATERNIONS, DUAL_QUATERNIONS)
    def test_left_and_right(self, a, b):
        """ab = [a]_L b = [b]_R a."""
        assert_equal(dm.matrix_multiply(dm.left_matrix(a), b), dq.multiply(a, b), size(a, b))
        assert_equal(dm.matrix_multiply(dm.right_matrix(b), a), dq.multiply(a, b), size(a, b))

    @REPRODUCIBLE
    @given(VECTOR_DUAL_QUATERNIONS, VECTOR_DUAL_QUATERNIONS)
    def test_6(self, s, b):
        """[s]^x b = s x b."""
        assert_equal(dm.matrix_multiply(dm.cross_matrix(s), b), dq.cross(s, b), size(s, b))

    def test_swap_columns(self):
        """H(M) a = M a^s."""
        generator = np.random.default_rng(1)
        matrix, a = generator.normal(size=(8, 8)), generator.normal(size=8)
        assert_equal(np.array(dm.swap_columns(matrix)) @ a, matrix @ dq.swap(a), 10.0)
        assert_equal(dm.matrix_multiply(matrix, a), matrix @ a, 10.0)

    def test_10(self):
        """M (w^s) is the dual momentum m v + eps J w."""
        mass, inertia = 3.0, np.array([[2.0, 0.1, 0.2], [0.1, 3.0, 0.3], [0.2, 0.3, 4.0]])
        matrix = dm.dual_inertia_matrix(mass, inertia)
        expected = np.zeros((8, 8))
        expected[0, 0] = expected[4, 4] = 1.0
        expected[1:4, 1:4], expected[5:, 5:] = mass * np.eye(3), inertia
        np.testing.assert_array_equal(matrix, expected)
        w, v = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -3.0])
        momentum = dm.matrix_multiply(matrix, dq.swap(dq.from_vector([*w, *v])))
        assert_equal(momentum, [0.0, *mass * v, 0.0, *inertia @ w], 10.0)

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), DUAL_QUATERNIONS)
    def test_adjoint_matrix(self, q, s):
        """Ad(q) = [q]_L [q*]_R."""
        expected = np.array(dm.left_matrix(q)) @ np.array(dm.right_matrix(dq.conjugate(q)))
        assert_equal(dm.adjoint_matrix(q), expected, size(q, q))
        assert_equal(expected @ s, dq.adjoint(q, s), size(q, q, s))


class TestFrameChanges:
    @REPRODUCIBLE
    @given(unit_quaternions(), VECTORS)
    def test_rotation(self, q, v):
        """s^Y = q_{Y/X}* s^X q_{Y/X}, and its inverse."""
        s = qn.from_vector(v)
        scale = size(v)
        assert_equal(qn.inverse_adjoint(q, s), qn.adjoint(qn.conjugate(q), s), scale)
        assert_equal(qn.inverse_adjoint(q, qn.adjoint(q, s)), s, scale)
        assert_equal(qn.adjoint(q, s), (0.0, *rotations.rotate(q, v)), scale)

    @REPRODUCIBLE
    @given(VECTORS, DUAL_VECTORS)
    def test_7_of_a_translation(self, r, velocity):
        """q_{X/Y}* w^Y q_{X/Y} = w + eps (v + w x r), for parallel axes."""
        q = poses.from_rotation_and_position(qn.IDENTITY, r)
        w, v = velocity[:3], velocity[3:]
        expected = (0.0, *w, 0.0, *np.add(v, np.cross(w, r)))
        assert_equal(dq.inverse_adjoint(q, dq.from_vector(velocity)), expected, size(r, r, velocity))

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), DUAL_VECTORS)
    def test_7_on_six_numbers(self, q, s):
        """`transform` and `inverse_transform` are Ad(q) and Ad(q*) on vector dual quaternions."""
        matrix, position = poses.to_matrix(q)
        scale = size(q, q, s)
        moved = dual_vectors.transform(matrix, position, s)
        assert_equal(dq.from_vector(moved), dq.adjoint(q, dq.from_vector(s)), scale)
        assert_equal(dual_vectors.inverse_transform(matrix, position, moved), s, scale)
        assert_equal(np.array(dual_vectors.transform_matrix(matrix, position)) @ s, moved, scale)
        inverse = dual_vectors.inverse_transform(matrix, position, s)
        assert_equal(dq.from_vector(inverse), dq.inverse_adjoint(q, dq.from_vector(s)), scale)

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), DUAL_VECTORS, DUAL_VECTORS)
    def test_power_is_the_same_in_all_frames(self, q, wrench, velocity):
        """W^s o w does not change when the same adjoint moves both."""
        wrench, velocity = dq.from_vector(wrench), dq.from_vector(velocity)
        power = dq.circle(dq.swap(wrench), velocity)
        moved = dq.circle(dq.swap(dq.adjoint(q, wrench)), dq.adjoint(q, velocity))
        assert_equal(moved, power, size(q, q, q, q, wrench, velocity))


class TestKinematics:
    @REPRODUCIBLE
    @given(unit_quaternions(), VECTORS)
    def test_2(self, q, w):
        """1/2 q_{X/Y} w^X = 1/2 w^Y q_{X/Y}, and it is the derivative of q exp(t w / 2)."""
        derivative = qn.derivative(q, w)
        assert_equal(derivative, qn.derivative_from_reference(q, rotations.rotate(q, w)), size(w))
        step = 1e-6
        later = qn.multiply(q, rotations.exponential(vectors.scale(step, w)))
        earlier = qn.multiply(q, rotations.exponential(vectors.scale(-step, w)))
        difference = np.subtract(later, earlier) / (2.0 * step)
        np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-8)

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), DUAL_VECTORS)
    def test_8(self, q, w):
        """1/2 q_{X/Y} w^X = 1/2 w^Y q_{X/Y}, and it is the derivative of q exp(t w / 2)."""
        derivative = dq.derivative(q, w)
        w_reference = dq.to_vector(dq.adjoint(q, dq.from_vector(w)))
        assert_equal(derivative, dq.derivative_from_reference(q, w_reference), size(q, q, q, w))
        step = 1e-6
        later = dq.multiply(q, screw.exponential(dual_vectors.scale(step, w)))
        earlier = dq.multiply(q, screw.exponential(dual_vectors.scale(-step, w)))
        difference = np.subtract(later, earlier) / (2.0 * step)
        np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-7)


class TestNormalization:
    @REPRODUCIBLE
    @given(unit_dual_quaternions(), DUAL_QUATERNIONS)
    def test_result_is_unit(self, q, error):
        """q* q = 1, from anywhere near a pose."""
        unit = dq.normalize(dq.add(q, dq.scale(0.03, error)))
        assert_equal(dq.multiply(dq.conjugate(unit), unit), dq.IDENTITY, size(unit, unit))
        assert_equal(dq.normalize(unit), unit, size(unit))

    @pytest.mark.parametrize(
        ("q", "expected"),
        [
            ((-0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5)),
            ((0.0, -1.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)),
            ((-0.0, 0.0, -0.6, 0.8), (0.0, 0.0, 0.6, -0.8)),
            ((0.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 1.0)),
        ],
    )
    def test_canonical_sign(self, q, expected):
        assert qn.canonical(q) == qn.canonical(expected) == expected
        assert dq.canonical((*q, 1.0, 2.0, 3.0, 4.0))[4] == -1.0


def test_dual_vectors_are_vector_dual_quaternions():
    generator = np.random.default_rng(2)
    a, b = generator.normal(size=(2, 6))
    assert_equal(dual_vectors.add(a, b), a + b)
    assert_equal(dual_vectors.subtract(a, b), a - b)
    assert_equal(dual_vectors.scale(-3.0, a), -3.0 * a, 10.0)
    expected = dq.cross(dq.from_vector(a), dq.from_vector(b))
    assert_equal(dq.from_vector(dual_vectors.cross(a, b)), expected, 10.0)
    assert dual_vectors.from_parts(dual_vectors.real_part(a), dual_vectors.dual_part(a)) == tuple(a)


def test_vectors_and_matrices():
    """The 3-vector helpers against NumPy."""
    generator = np.random.default_rng(3)
    a, b = generator.normal(size=(2, 3))
    left, right = generator.normal(size=(2, 3, 3))
    assert_equal(vectors.add(a, b), a + b)
    assert_equal(vectors.subtract(a, b), a - b)
    assert_equal(vectors.scale(2.5, a), 2.5 * a)
    assert_equal(vectors.dot(a, b), a @ b)
    assert_equal(vectors.cross(a, b), np.cross(a, b))
    assert_equal(vectors.norm(a), np.linalg.norm(a))
    assert_equal(np.array(vectors.skew_matrix(a)) @ b, np.cross(a, b))
    assert_equal(vectors.transpose(left), left.T)
    assert_equal(vectors.matrix_vector(left, a), left @ a)
    assert_equal(vectors.transposed_matrix_vector(left, a), left.T @ a)
    assert_equal(vectors.matrix_product(left, right), left @ right)
