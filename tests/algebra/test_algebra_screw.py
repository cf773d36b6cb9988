"""Exponential, logarithm, screw parameters and interpolation of poses, and their derivatives."""

import itertools
import math

import casadi
import numpy as np
import pytest
from algebra_strategies import (
    NUMBERS,
    REPRODUCIBLE,
    twists,
    unit_dual_quaternions,
)
from hypothesis import given
from hypothesis import strategies as st

from dq_space_arm_env.algebra import (
    dual_quaternion,
    dual_vectors,
    poses,
    quaternion,
    rotations,
    screw,
    vectors,
)

EPSILON = 2.0**-52
HALF_TURN = (0.0, 0.6, 0.0, 0.8)


def assert_same_pose(actual, expected, tolerance=1e-13):
    """Compare q with q or -q."""
    sign = math.copysign(1.0, np.dot(actual[:4], expected[:4]))
    np.testing.assert_allclose(np.multiply(sign, actual), expected, rtol=0.0, atol=tolerance)


class TestExponentialAndLogarithm:
    @REPRODUCIBLE
    @given(unit_dual_quaternions())
    def test_exponential_of_logarithm(self, q):
        assert_same_pose(screw.exponential(screw.logarithm(q)), q)

    @REPRODUCIBLE
    @given(twists())
    def test_logarithm_of_exponential(self, twist):
        q = screw.exponential(twist)
        np.testing.assert_allclose(screw.logarithm(q), twist, rtol=0.0, atol=1e-13)
        assert screw.logarithm(dual_quaternion.scale(-1.0, q)) == screw.logarithm(q)

    @REPRODUCIBLE
    @given(twists(), NUMBERS, NUMBERS)
    def test_one_parameter_group(self, twist, s, t):
        """exp(s xi) exp(t xi) = exp((s + t) xi)."""
        both = [screw.exponential(dual_vectors.scale(factor, twist)) for factor in (s, t, s + t)]
        np.testing.assert_allclose(dual_quaternion.multiply(*both[:2]), both[2], rtol=0.0, atol=3e-13)

    @REPRODUCIBLE
    @given(twists())
    def test_real_part_is_the_exponential_of_the_rotation(self, twist):
        q = screw.exponential(twist)
        assert q[:4] == rotations.exponential(twist[:3])
        assert screw.logarithm(q)[:3] == rotations.logarithm(q[:4])

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), twists())
    def test_adjoint_of_an_exponential(self, q, twist):
        """q exp(xi) q* = exp(Ad(q) xi)."""
        moved = dual_quaternion.to_vector(dual_quaternion.adjoint(q, dual_quaternion.from_vector(twist)))
        expected = dual_quaternion.adjoint(q, screw.exponential(twist))
        np.testing.assert_allclose(screw.exponential(moved), expected, rtol=0.0, atol=4e-14)

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_exact_half_turn(self, sign):
        """At q_r0 = 0 the sign of q must not show: the first component of the axis is taken positive."""
        q = poses.from_rotation_and_position(HALF_TURN, (1.0, -2.0, 0.5))
        twist = screw.logarithm(dual_quaternion.scale(sign, q))
        np.testing.assert_allclose(twist[:3], math.pi * np.array(HALF_TURN[1:]), rtol=2.0 * EPSILON)
        assert twist == screw.logarithm(q)
        assert_same_pose(screw.exponential(twist), q, 8.0 * EPSILON)

    def test_pure_translation_is_exact(self):
        q = screw.exponential((0.0, 0.0, 0.0, 1e8, -2e-300, 3.0))
        assert q == (1.0, 0.0, 0.0, 0.0, 0.0, 0.5e8, -1e-300, 1.5)
        assert screw.logarithm(q) == (0.0, 0.0, 0.0, 1e8, -2e-300, 3.0)

    def test_against_pinocchio(self):
        pinocchio = pytest.importorskip("pinocchio")
        generator = np.random.default_rng(4)
        for twist in generator.normal(size=(20, 6)):
            placement = pinocchio.exp6(pinocchio.Motion(twist[3:], twist[:3]))
            matrix, position = poses.to_matrix(screw.exponential(twist))
            np.testing.assert_allclose(matrix, placement.rotation, rtol=0, atol=1e-14)
            np.testing.assert_allclose(position, placement.translation, rtol=0, atol=1e-14)
            order = [3, 4, 5, 0, 1, 2]
            expected = pinocchio.Jexp6(pinocchio.Motion(twist[3:], twist[:3]))[np.ix_(order, order)]
            np.testing.assert_allclose(screw.exponential_right_jacobian(twist), expected, rtol=0, atol=4e-15)


class TestInterpolation:
    @REPRODUCIBLE
    @given(unit_dual_quaternions(), unit_dual_quaternions(), st.floats(0.0, 1.0))
    def test_constant_velocity_on_the_shortest_screw(self, start, end, fraction):
        """The twist from the start grows in proportion, for `end` and -`end` alike."""
        whole = screw.logarithm(poses.error_pose(start, end))
        between = screw.interpolate(start, end, fraction)
        part = screw.logarithm(poses.error_pose(start, between))
        np.testing.assert_allclose(part, dual_vectors.scale(fraction, whole), rtol=0, atol=7e-14)
        assert_same_pose(screw.interpolate(start, dual_quaternion.scale(-1.0, end), fraction), between)

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), unit_dual_quaternions(), unit_dual_quaternions())
    def test_frame_invariance(self, start, end, q):
        """Moving both ends by q moves every pose between by q."""
        moved = screw.interpolate(dual_quaternion.multiply(q, start), dual_quaternion.multiply(q, end), 0.3)
        expected = dual_quaternion.multiply(q, screw.interpolate(start, end, 0.3))
        if rotations.angle(poses.error_pose(start, end)[:4]) < 3.1:
            assert_same_pose(moved, expected, 3e-14)

    @REPRODUCIBLE
    @given(twists(largest_angle=1.0))
    def test_power(self, twist):
        """The cube of q^(1/3) is q, and q^-1 = q*."""
        q = screw.exponential(twist)
        root = screw.power(q, 1.0 / 3.0)
        cube = dual_quaternion.multiply(root, dual_quaternion.multiply(root, root))
        np.testing.assert_allclose(cube, q, rtol=0, atol=2e-14)
        np.testing.assert_allclose(screw.power(q, -1.0), dual_quaternion.conjugate(q), rtol=0, atol=1e-14)


class TestDerivativesUnderCasadi:
    """Exact derivatives at and around the points where the closed forms divide zero by zero."""

    @staticmethod
    def jacobian_of(function, size):
        x = casadi.SX.sym("x", size)
        outputs = casadi.vertcat(*function(casadi.vertsplit(x)))
        jacobian = casadi.Function("jacobian", [x], [casadi.jacobian(outputs, x)])
        return lambda point: jacobian(point).full()

    @pytest.mark.parametrize("r", [np.zeros(3), np.array([1.0, 2.0, 3.0])])
    def test_exponential_of_a_pure_translation(self, r):
        """At xi = (0, r), d q_d0 = -1/4 r . d xi_r."""
        expected = np.zeros((8, 6))
        expected[1:4, :3] = expected[5:, 3:] = 0.5 * np.eye(3)
        expected[4, :3] = -0.25 * r
        jacobian = self.jacobian_of(screw.exponential, 6)([0.0, 0.0, 0.0, *r])
        np.testing.assert_array_equal(jacobian, expected)

    def test_logarithm_at_the_identity(self):
        expected = np.zeros((6, 8))
        expected[:3, 1:4] = expected[3:, 5:] = 2.0 * np.eye(3)
        for sign in (1.0, -1.0):
            jacobian = self.jacobian_of(screw.logarithm, 8)(sign * np.array(dual_quaternion.IDENTITY))
            np.testing.assert_array_equal(jacobian, sign * expected)

    @pytest.mark.parametrize(
        "twist",
        [
            np.zeros(6),
            np.array([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]),
            np.array([1e-200, 0.0, 0.0, 1.0, 2.0, 3.0]),
            np.array([0.0, 1e-9, 0.0, 1.0, 2.0, 3.0]),
            *(
                np.array([*np.multiply(angle, (0.48, 0.6, 0.64)), 1.0, -2.0, 0.5])
                for angle in (1e-4, 0.2486, 0.2488, 0.9999, 1.0001, 1.999, 2.001, 3.0, math.pi)
            ),
        ],
    )
    def test_against_the_jacobians(self, twist):
        """d/dd log(exp(xi) exp(d)) = J_r^-1(xi) and d/dd log(exp(xi)* exp(xi + d)) = J_r(xi), at d = 0."""
        pose = screw.exponential(tuple(twist))

        def after(d):
            return screw.logarithm(dual_quaternion.multiply(pose, screw.exponential(d)))

        def difference(d):
            moved = screw.exponential(dual_vectors.add(tuple(twist), d))
            return screw.logarithm(dual_quaternion.multiply(dual_quaternion.conjugate(pose), moved))

        expected = np.array(screw.exponential_right_jacobian(tuple(twist)))
        np.testing.assert_allclose(self.jacobian_of(difference, 6)(np.zeros(6)), expected, rtol=0, atol=1e-14)
        jacobian = self.jacobian_of(after, 6)(np.zeros(6))
        np.testing.assert_allclose(jacobian, np.linalg.inv(expected), rtol=0, atol=1e-14)

    @pytest.mark.parametrize("function", [poses.error_angle, poses.error_distance, screw.logarithm])
    def test_finite_without_error(self, function):
        """The error of a pose with itself has a finite gradient, 0 for the angle and the distance."""
        poses_at_rest = [dual_quaternion.IDENTITY, (0.5, 0.5, -0.5, -0.5, 0.25, 2.25, 0.25, 2.25)]
        for desired in poses_at_rest:

            def error(q, desired=desired):
                if function is screw.logarithm:
                    return function(poses.error_pose(q, desired))
                return [function(q, desired)]

            jacobian = self.jacobian_of(error, 8)(desired)
            assert np.isfinite(jacobian).all()
            if function is not screw.logarithm:
                assert not jacobian.any()

    @pytest.mark.parametrize("module", [vectors, quaternion, dual_quaternion])
    def test_norm_at_zero(self, module):
        size = {vectors: 3, quaternion: 4, dual_quaternion: 8}[module]
        gradient = self.jacobian_of(lambda a: [module.norm(a)], size)
        np.testing.assert_array_equal(gradient(np.zeros(size)), 0.0)
        np.testing.assert_allclose(gradient(np.full(size, 2.0)), 1.0 / math.sqrt(size))

    def test_second_derivatives(self):
        """The Hessian of the exponential, against differences of its gradient, in the series and outside."""
        x = casadi.SX.sym("x", 6)
        output = casadi.dot(casadi.vertcat(*screw.exponential(casadi.vertsplit(x))), casadi.DM(range(1, 9)))
        hessian = casadi.Function("hessian", [x], [casadi.hessian(output, x)[0]])
        gradient = casadi.Function("gradient", [x], [casadi.gradient(output, x)])
        step = 1e-5
        for angle, unit in itertools.product((0.0, 1.0, 3.0), range(6)):
            point = np.array([0.6 * angle, 0.0, 0.8 * angle, 1.0, 2.0, 3.0])
            shift = step * np.eye(6)[unit]
            difference = (gradient(point + shift) - gradient(point - shift)) / (2.0 * step)
            np.testing.assert_allclose(
                hessian(point).full()[:, unit], difference.full()[:, 0], rtol=0, atol=1e-9
            )
