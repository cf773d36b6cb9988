"""Conversions of rotations and poses, and the pose error (31)."""

import math

import numpy as np
import pytest
from algebra_strategies import (
    ANGLES,
    REPRODUCIBLE,
    VECTORS,
    unit_dual_quaternions,
    unit_quaternions,
)
from hypothesis import given
from hypothesis import strategies as st

from dq_space_arm_env.algebra import dual_quaternion, poses, quaternion, rotations, vectors

EPSILON = 2.0**-52

# The paper's target: r^I = (0, -4, 5) m, axes x_D = (0, -1, 0), y_D = (0, 0, 1), z_D = (-1, 0, 0).
TARGET = (0.5, 0.5, -0.5, -0.5, 0.25, 2.25, 0.25, 2.25)
TARGET_MATRIX = ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
TARGET_POSITION = (0.0, -4.0, 5.0)


def assert_same_rotation(actual, expected, tolerance=4.0 * EPSILON):
    """Compare q with q or -q."""
    sign = math.copysign(1.0, np.dot(actual, expected))
    np.testing.assert_allclose(np.multiply(sign, actual), expected, rtol=0.0, atol=tolerance)


def rotation_about(axis, angle):
    """Return the elementary rotation matrix as textbooks print it."""
    c, s = math.cos(angle), math.sin(angle)
    matrices = {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(matrices[axis])


class TestRotationMatrix:
    @REPRODUCIBLE
    @given(unit_quaternions(), VECTORS)
    def test_takes_body_to_reference_axes(self, q, v):
        """v^Y = R v^X = q v^X q*, with a proper orthogonal R."""
        matrix = np.array(rotations.to_matrix(q))
        expected = quaternion.adjoint(q, quaternion.from_vector(v))[1:]
        np.testing.assert_allclose(matrix @ v, expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(rotations.rotate(q, v), expected, rtol=0, atol=1e-13)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=1e-15 * 4)
        assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-14)

    @REPRODUCIBLE
    @given(unit_quaternions())
    def test_round_trip(self, q):
        assert_same_rotation(rotations.from_matrix(rotations.to_matrix(q)), q)

    def test_small_rotations_keep_their_digits(self):
        """The vector part of a tiny rotation is exact relative to itself."""
        for size in (1e-3, 1e-8, 1e-100, 1e-300):
            q = quaternion.normalize((1.0, size, -2.0 * size, 3.0 * size))
            back = rotations.from_matrix(rotations.to_matrix(q))
            # The matrix itself is rounded: 2 (q1 q2 - q0 q3) carries an error of eps times q0 q3.
            np.testing.assert_allclose(back, q, rtol=max(4.0 * EPSILON, 4.0 * EPSILON * size))

    def test_against_scipy(self):
        transform = pytest.importorskip("scipy.spatial.transform")
        matrices = transform.Rotation.random(50, random_state=1).as_matrix()
        for matrix in matrices:
            expected = np.roll(transform.Rotation.from_matrix(matrix).as_quat(), 1)
            assert_same_rotation(rotations.from_matrix(matrix), expected, 1e-15)


class TestEulerAngles:
    @REPRODUCIBLE
    @given(ANGLES, ANGLES, ANGLES)
    def test_is_a_product_of_elementary_rotations(self, psi, theta, phi):
        """C_3 Rz(psi) Ry(theta) Rx(phi), the wrist of the paper."""
        expected = rotation_about("z", psi) @ rotation_about("y", theta) @ rotation_about("x", phi)
        matrix = rotations.to_matrix(rotations.from_euler_321(psi, theta, phi))
        np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-15 * 2)

    @REPRODUCIBLE
    @given(unit_quaternions())
    def test_angles_reproduce_the_rotation(self, q):
        psi, theta, phi = rotations.to_euler_321(q)
        assert abs(psi) <= math.pi
        assert abs(theta) <= math.pi / 2.0
        assert abs(phi) <= math.pi
        assert_same_rotation(rotations.from_euler_321(psi, theta, phi), q, 8.0 * EPSILON)
        opposite = rotations.to_euler_321(quaternion.scale(-1.0, q))
        assert_same_rotation(rotations.from_euler_321(*opposite), q, 8.0 * EPSILON)

    @pytest.mark.parametrize("side", [1.0, -1.0])
    @REPRODUCIBLE
    @given(psi=ANGLES, phi=ANGLES, exponent=st.floats(-20.0, -1.0))
    def test_next_to_gimbal_lock(self, side, psi, phi, exponent):
        """The angles reproduce the rotation however near the lock, and theta stays accurate."""
        theta = side * (math.pi / 2.0 - 10.0**exponent)
        q = rotations.from_euler_321(psi, theta, phi)
        angles = rotations.to_euler_321(q)
        assert_same_rotation(rotations.from_euler_321(*angles), q, 8.0 * EPSILON)
        assert angles[1] == pytest.approx(theta, abs=4.0 * EPSILON)

    @pytest.mark.parametrize("side", [1.0, -1.0])
    @REPRODUCIBLE
    @given(psi=ANGLES, phi=ANGLES)
    def test_at_gimbal_lock_phi_is_zero(self, side, psi, phi):
        q = rotations.from_euler_321(psi, side * math.pi / 2.0, phi)
        angles = rotations.to_euler_321(q)
        assert angles[1] == pytest.approx(side * math.pi / 2.0, abs=4.0 * EPSILON)
        assert angles[2] == 0.0
        assert_same_rotation(rotations.from_euler_321(*angles), q, 8.0 * EPSILON)

    @pytest.mark.parametrize("index", [0, 1, 2])
    @pytest.mark.parametrize("angle", [1e-300, 1e-20, 1e-9, 1e-3, 1.0])
    def test_single_small_angle_is_exact(self, index, angle):
        angles = angle * np.eye(3)[index]
        back = rotations.to_euler_321(rotations.from_euler_321(*angles.tolist()))
        np.testing.assert_allclose(back, angles, rtol=4.0 * EPSILON, atol=0.0)

    def test_against_scipy(self):
        transform = pytest.importorskip("scipy.spatial.transform")
        for rotation in transform.Rotation.random(50, random_state=2):
            q = np.roll(rotation.as_quat(), 1)
            np.testing.assert_allclose(
                rotations.to_euler_321(q), rotation.as_euler("ZYX"), rtol=0, atol=4e-15
            )


class TestAxisAngle:
    @REPRODUCIBLE
    @given(unit_quaternions())
    def test_round_trip(self, q):
        axis, angle = rotations.to_axis_angle(q)
        assert vectors.norm(axis) == pytest.approx(1.0, abs=4.0 * EPSILON)
        assert 0.0 <= angle <= math.pi
        assert angle == pytest.approx(rotations.angle(q), rel=4.0 * EPSILON)
        assert_same_rotation(rotations.from_axis_angle(axis, angle), q)
        assert rotations.to_axis_angle(quaternion.scale(-1.0, q)) == (axis, angle)

    def test_identity_has_the_x_axis(self):
        assert rotations.to_axis_angle(quaternion.IDENTITY) == ((1.0, 0.0, 0.0), 0.0)

    def test_direction_and_length_neither_overflows_nor_underflows(self):
        for size in (1e-300, 1e-200, 1.0, 1e200, 1e300):
            direction, length = vectors.direction_and_length((3.0 * size, 0.0, -4.0 * size))
            np.testing.assert_allclose(direction, (0.6, 0.0, -0.8), rtol=4.0 * EPSILON)
            assert length == pytest.approx(5.0 * size, rel=4.0 * EPSILON)


class TestPoses:
    def test_target_of_the_paper(self):
        matrix, position = poses.to_matrix(TARGET)
        assert matrix == TARGET_MATRIX
        assert position == TARGET_POSITION
        assert poses.from_matrix(TARGET_MATRIX, TARGET_POSITION) == TARGET
        assert dual_quaternion.multiply(dual_quaternion.conjugate(TARGET), TARGET) == dual_quaternion.IDENTITY

    @REPRODUCIBLE
    @given(unit_quaternions(), VECTORS)
    def test_positions(self, rotation, r):
        """q_d = 1/2 q_r r^X = 1/2 r^Y q_r, r^X = 2 q_r* q_d, r^Y = 2 q_d q_r*."""
        q = poses.from_rotation_and_position(rotation, r)
        assert dual_quaternion.real_part(q) == rotation
        np.testing.assert_allclose(poses.position(q), r, rtol=0, atol=1e-14)
        body_position = poses.body_position(q)
        np.testing.assert_allclose(rotations.rotate(rotation, body_position), r, rtol=0, atol=2e-14)
        back = poses.from_rotation_and_body_position(rotation, body_position)
        np.testing.assert_allclose(back, q, rtol=0, atol=1e-14)

    @pytest.mark.parametrize("form", ["rotation_and_position", "matrix", "euler_321", "axis_angle"])
    @REPRODUCIBLE
    @given(q=unit_dual_quaternions())
    def test_round_trips(self, form, q):
        convert, convert_back = getattr(poses, f"to_{form}"), getattr(poses, f"from_{form}")
        assert_same_rotation(convert_back(*convert(q)), q, 1e-13)

    @REPRODUCIBLE
    @given(unit_dual_quaternions(), unit_dual_quaternions())
    def test_composition(self, q_yx, q_zy):
        """q_{Z/X} = q_{Y/X} q_{Z/Y}: rotation matrices multiply, positions add in the same axes."""
        (r_yx, p_yx), (r_zy, p_zy) = poses.to_matrix(q_yx), poses.to_matrix(q_zy)
        matrix, position = poses.to_matrix(dual_quaternion.multiply(q_yx, q_zy))
        np.testing.assert_allclose(matrix, np.array(r_yx) @ r_zy, rtol=0, atol=1e-14)
        np.testing.assert_allclose(position, p_yx + np.array(r_yx) @ p_zy, rtol=0, atol=1e-13)


class TestPoseError:
    @REPRODUCIBLE
    @given(unit_dual_quaternions(), unit_dual_quaternions())
    def test_31(self, actual, desired):
        """q_{D/G} = q_{G/I}* q_{D/I}; its angle is 2 acos |q_r0|, its position is 2 q_d q_r*."""
        error = poses.error_pose(actual, desired)
        np.testing.assert_allclose(dual_quaternion.multiply(actual, error), desired, rtol=0, atol=2e-14)
        in_reference_axes = np.subtract(poses.position(desired), poses.position(actual))
        in_body_axes = rotations.rotate(quaternion.conjugate(actual[:4]), in_reference_axes)
        np.testing.assert_allclose(poses.position(error), in_body_axes, rtol=0, atol=1e-13)
        distance, angle = np.linalg.norm(in_reference_axes), 2.0 * math.acos(min(1.0, abs(error[0])))
        assert poses.error_distance(actual, desired) == pytest.approx(distance, abs=1e-13)
        assert poses.error_angle(actual, desired) == pytest.approx(angle, abs=1e-7)

    @pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-12, 1e-8, 1e-3, 1.0, math.pi - 1e-9, math.pi])
    def test_angle_keeps_its_digits(self, angle):
        """2 acos(q_r0) would return 0 for a nanoradian."""
        desired = poses.from_axis_angle((0.0, 0.6, 0.8), angle, (1.0, 2.0, 3.0))
        measured = poses.error_angle(dual_quaternion.IDENTITY, desired)
        # Squares of less than 1e-308 underflow to 0.
        assert measured == pytest.approx(angle, rel=4.0 * EPSILON, abs=1e-150)
        assert poses.error_angle(dual_quaternion.scale(-1.0, dual_quaternion.IDENTITY), desired) == measured
