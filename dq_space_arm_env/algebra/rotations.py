"""Rotations as unit quaternions: from and to rotation vectors, matrices, 3-2-1 Euler angles, axis and angle.

The unit quaternion q_{X/Y} of these functions, its rotation matrix R and its Euler angles all describe the
orientation of frame X with respect to frame Y: v^Y = R v^X. No conversion has a singular point: where the
answer is not unique, at gimbal lock or for the axis of no rotation, the docstring says which one is returned.
"""

import math

from dq_space_arm_env.algebra import quaternion, vectors
from dq_space_arm_env.algebra._series import logarithm_coefficients, stumpff
from dq_space_arm_env.algebra._types import Components, Matrix3, Quaternion, Scalar, Vector
from dq_space_arm_env.algebra.scalars import arctan2, cos, safe_sqrt, select, sin

__all__ = [
    "angle",
    "exponential",
    "from_axis_angle",
    "from_euler_321",
    "from_matrix",
    "logarithm",
    "rotate",
    "to_axis_angle",
    "to_euler_321",
    "to_matrix",
]

# Of a unit quaternion, squared: below, the Euler angles are at gimbal lock up to rounding.
_GIMBAL_LOCK_BELOW = 1e-30


def exponential(rotation_vector: Components) -> Quaternion:
    """Return exp(v / 2), the rotation by |v| about v: the solution of (2) after unit time at velocity v.

    (3,) -> (4,).
    """
    half = vectors.scale(0.5, rotation_vector)
    c0, c1, _, _, _, _ = stumpff(vectors.dot(half, half))
    return (c0, c1 * half[0], c1 * half[1], c1 * half[2])


def logarithm(q: Components) -> Vector:
    """Return the rotation vector of the shortest rotation, the inverse of `exponential`: (4,) -> (3,).

    Both q and -q give the same result.
    """
    unit = quaternion.canonical(q)
    sine = quaternion.to_vector(unit)
    half_angle_over_sine, _ = logarithm_coefficients(unit[0], vectors.dot(sine, sine))
    return vectors.scale(2.0 * half_angle_over_sine, sine)


def rotate(q: Components, v: Components) -> Vector:
    """Return the vector part of q v q*: with q_{X/Y} it takes v^X to v^Y: (4,), (3,) -> (3,)."""
    axis = quaternion.to_vector(q)
    twice = vectors.scale(2.0, vectors.cross(axis, v))
    return vectors.add(v, vectors.add(vectors.scale(q[0], twice), vectors.cross(axis, twice)))


def angle(q: Components) -> Scalar:
    """Return the angle of the shortest rotation: (4,) -> ().

    Both q and -q give the same result.
    """
    return 2.0 * arctan2(vectors.norm(quaternion.to_vector(q)), abs(q[0]))


def from_axis_angle(axis: Components, angle: Scalar) -> Quaternion:
    """Return the rotation by an angle about an axis: (3,), () -> (4,)."""
    sine = sin(0.5 * angle)
    return (cos(0.5 * angle), sine * axis[0], sine * axis[1], sine * axis[2])


def to_axis_angle(q: Components) -> tuple[Vector, Scalar]:
    """Return the axis and the angle of the shortest rotation: (4,) -> (3,), ().

    Both q and -q give the same result.
    """
    unit = quaternion.canonical(q)
    axis, sine = vectors.direction_and_length(quaternion.to_vector(unit))
    return axis, 2.0 * arctan2(sine, unit[0])


def to_matrix(q: Components) -> Matrix3:
    """Return the rotation matrix R of q_{X/Y}, v^Y = R v^X: (4,) -> (3, 3)."""
    xx, yy, zz = 2.0 * q[1] * q[1], 2.0 * q[2] * q[2], 2.0 * q[3] * q[3]
    xy, yz, zx = 2.0 * q[1] * q[2], 2.0 * q[2] * q[3], 2.0 * q[3] * q[1]
    wx, wy, wz = 2.0 * q[0] * q[1], 2.0 * q[0] * q[2], 2.0 * q[0] * q[3]
    return (
        (1.0 - (yy + zz), xy - wz, zx + wy),
        (xy + wz, 1.0 - (zz + xx), yz - wx),
        (zx - wy, yz + wx, 1.0 - (xx + yy)),
    )


def _select_quaternion(condition: Scalar, if_true: Quaternion, if_false: Quaternion) -> Quaternion:
    """Return one of two quaternions, chosen by a condition."""
    return (
        select(condition, if_true[0], if_false[0]),
        select(condition, if_true[1], if_false[1]),
        select(condition, if_true[2], if_false[2]),
        select(condition, if_true[3], if_false[3]),
    )


def from_matrix(matrix: Components) -> Quaternion:
    """Return the quaternion q_{X/Y} of a rotation matrix R, v^Y = R v^X: (3, 3) -> (4,).

    S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1 (1978): R gives the products
    4 q_i q_j; the row of the largest q_i is a multiple of q that involves no cancellation.
    """
    m = matrix
    ww = 1.0 + m[0][0] + m[1][1] + m[2][2]
    xx = 1.0 + m[0][0] - m[1][1] - m[2][2]
    yy = 1.0 - m[0][0] + m[1][1] - m[2][2]
    zz = 1.0 - m[0][0] - m[1][1] + m[2][2]
    wx, wy, wz = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, yz, zx = m[1][0] + m[0][1], m[2][1] + m[1][2], m[0][2] + m[2][0]

    best_of_wx = _select_quaternion(ww < xx, (wx, xx, xy, zx), (ww, wx, wy, wz))
    best_of_yz = _select_quaternion(yy < zz, (wz, zx, yz, zz), (wy, xy, yy, yz))
    largest_of_wx = select(ww < xx, xx, ww)
    largest_of_yz = select(yy < zz, zz, yy)
    best = _select_quaternion(largest_of_wx < largest_of_yz, best_of_yz, best_of_wx)
    return quaternion.canonical(quaternion.normalize(best))


def from_euler_321(psi: Scalar, theta: Scalar, phi: Scalar) -> Quaternion:
    """Return the rotation C_3 Rz(psi) Ry(theta) Rx(phi): yaw, then pitch, then roll, about the moving axes.

    (), (), () -> (4,).
    """
    cos_psi, sin_psi = cos(0.5 * psi), sin(0.5 * psi)
    cos_theta, sin_theta = cos(0.5 * theta), sin(0.5 * theta)
    cos_phi, sin_phi = cos(0.5 * phi), sin(0.5 * phi)
    return (
        cos_psi * cos_theta * cos_phi + sin_psi * sin_theta * sin_phi,
        cos_psi * cos_theta * sin_phi - sin_psi * sin_theta * cos_phi,
        cos_psi * sin_theta * cos_phi + sin_psi * cos_theta * sin_phi,
        sin_psi * cos_theta * cos_phi - cos_psi * sin_theta * sin_phi,
    )


def _wrap(x: Scalar) -> Scalar:
    """Return the angle x of [-2 pi, 2 pi] in [-pi, pi]."""
    return select(math.pi < x, x - math.tau, select(x < -math.pi, x + math.tau, x))


def to_euler_321(q: Components) -> tuple[Scalar, Scalar, Scalar]:
    """Return the angles psi, theta, phi of a rotation, the inverse of `from_euler_321`: (4,) -> (3,).

    E. Bernardes and S. Viollet, "Quaternion to Euler angles conversion: a direct, general and computationally
    efficient method", PLoS ONE 17 (2022): the sum and the difference of psi and phi come from one arctangent
    each. At theta = +-pi/2 only one of the two is defined; there phi is set to 0.

    Both q and -q give the same result.
    """
    # (sum_x, sum_y) points along half of phi + psi, (difference_x, difference_y) along half of phi - psi.
    # Their lengths are sqrt(2) times sin and cos of pi/4 - theta/2.
    sum_y, sum_x = q[1] + q[3], q[0] - q[2]
    difference_y, difference_x = q[1] - q[3], q[0] + q[2]
    sum_squared = sum_y * sum_y + sum_x * sum_x
    difference_squared = difference_y * difference_y + difference_x * difference_x

    is_locked_up = sum_squared < _GIMBAL_LOCK_BELOW
    is_locked_down = difference_squared < _GIMBAL_LOCK_BELOW
    half_sum = arctan2(select(is_locked_up, 0.0, sum_y), select(is_locked_up, 1.0, sum_x))
    half_difference = arctan2(
        select(is_locked_down, 0.0, difference_y), select(is_locked_down, 1.0, difference_x)
    )
    # phi = half_sum + half_difference = 0
    half_sum = select(is_locked_up, -half_difference, half_sum)
    half_difference = select(is_locked_down, -half_sum, half_difference)

    sine = 2.0 * (q[0] * q[2] - q[1] * q[3])
    cosine = safe_sqrt(sum_squared) * safe_sqrt(difference_squared)
    return _wrap(half_sum - half_difference), arctan2(sine, cosine), _wrap(half_sum + half_difference)
