"""Screw motion: exponential and logarithm of poses, screw parameters, interpolation, and their derivatives.

A twist xi is a dual vector, a rotation vector and a translation-like vector, in rad and m, and exp(xi) stands
for the pose exp(1/2 (xi_r + eps xi_d)). With it the kinematics (8) at a constant dual velocity w over a time
h are solved by q exp(h w). By the transference principle each formula is that for rotations, in dual numbers.
"""

from dq_space_arm_env.algebra import dual_quaternion, dual_vectors, quaternion, vectors
from dq_space_arm_env.algebra._series import logarithm_coefficients, stumpff
from dq_space_arm_env.algebra._types import Components, DualQuaternion, DualVector, Matrix6, Scalar, Vector
from dq_space_arm_env.algebra.scalars import cos, select, sin

__all__ = [
    "dexp",
    "dexp_inverse",
    "exponential",
    "exponential_left_jacobian",
    "exponential_minus_identity",
    "exponential_right_jacobian",
    "from_screw_parameters",
    "interpolate",
    "logarithm",
    "power",
    "screw_parameters",
]

# A rotation below this angle, in rad, counts as none in `screw_parameters`: its axis would be out of range.
_PURE_TRANSLATION_BELOW = 1e-150


def exponential(twist: Components) -> DualQuaternion:
    """Return the pose exp(1/2 (xi_r + eps xi_d)).

    Args:
        twist: xi, rotation vector then translation-like vector, shape (6,), rad and m.

    Returns:
        Unit dual quaternion, shape (8,), dimensionless and m.
    """
    scalar, _, rest = _exponential_parts(twist)
    return (scalar, *rest)


def exponential_minus_identity(twist: Components) -> DualQuaternion:
    """Return exp(1/2 (xi_r + eps xi_d)) - 1, to all digits however small the twist.

    Args:
        twist: xi, rotation vector then translation-like vector, shape (6,), rad and m.

    Returns:
        Dual quaternion, shape (8,), dimensionless and m.
    """
    _, scalar_minus_one, rest = _exponential_parts(twist)
    return (scalar_minus_one, *rest)


def _exponential_parts(twist: Components) -> tuple[Scalar, Scalar, tuple[Scalar, ...]]:
    """Return the first number of the exponential, the same less 1, and the seven others."""
    u = vectors.scale(0.5, dual_vectors.real_part(twist))
    w = vectors.scale(0.5, dual_vectors.dual_part(twist))
    # The half angle squared is the dual number u.u + 2 eps u.w; c0' = -c1 / 2, c1' = -(c2 - c3) / 2.
    square = vectors.dot(u, u)
    c0, c1, c2, c3, _, _ = stumpff(square)
    along = vectors.dot(u, w)
    real = vectors.scale(c1, u)
    dual = vectors.subtract(vectors.scale(c1, w), vectors.scale((c2 - c3) * along, u))
    return c0, -square * c2, (*real, -c1 * along, *dual)


def logarithm(q: Components) -> DualVector:
    """Return the twist of the shortest screw motion, the inverse of `exponential`.

    Args:
        q: Unit dual quaternion, shape (8,), dimensionless and m; q and -q give the same.

    Returns:
        Twist whose rotation vector has length at most pi, shape (6,), rad and m.
    """
    unit = dual_quaternion.canonical(q)
    real = quaternion.to_vector(dual_quaternion.real_part(unit))
    dual = quaternion.to_vector(dual_quaternion.dual_part(unit))
    first, second = logarithm_coefficients(unit[0], vectors.dot(real, real))
    return dual_vectors.from_parts(
        vectors.scale(2.0 * first, real),
        vectors.subtract(vectors.scale(2.0 * first, dual), vectors.scale(2.0 * second * unit[4], real)),
    )


def power(q: Components, exponent: Scalar) -> DualQuaternion:
    """Return the pose a given fraction along the shortest screw motion from the identity to q.

    Args:
        q: Unit dual quaternion, shape (8,), dimensionless and m.
        exponent: Fraction, 0 for the identity and 1 for q, shape (), dimensionless.

    Returns:
        Unit dual quaternion, shape (8,), dimensionless and m.
    """
    return exponential(dual_vectors.scale(exponent, logarithm(q)))


def interpolate(start: Components, end: Components, fraction: Scalar) -> DualQuaternion:
    """Return the pose a given fraction along the shortest screw motion from one pose to another (ScLERP).

    Args:
        start: Pose at fraction 0, shape (8,), dimensionless and m.
        end: Pose at fraction 1, shape (8,), dimensionless and m.
        fraction: Fraction of the way, shape (), dimensionless.

    Returns:
        Unit dual quaternion, shape (8,), dimensionless and m; at fraction 1 it is `end` or -`end`.
    """
    difference = dual_quaternion.multiply(dual_quaternion.conjugate(start), end)
    return dual_quaternion.multiply(start, power(difference, fraction))


def screw_parameters(q: Components) -> tuple[Scalar, Scalar, Vector, Vector]:
    """Return the angle, translation, direction and moment of the shortest screw motion of a pose (Chasles).

    The pitch is translation / angle. A point p of the axis has p x direction = moment; direction x moment is
    the point nearest to the origin. The parameters are the same in both frames of the pose.

    Args:
        q: Unit dual quaternion, shape (8,), dimensionless and m.

    Returns:
        The angle in [0, pi], shape (), rad; the translation along the axis, shape (), m; the direction of the
        axis, shape (3,), dimensionless; and its moment about the origin, shape (3,), m. A pure translation
        has angle 0, the direction of the translation, and moment 0; the identity has direction (1, 0, 0).
    """
    twist = logarithm(q)
    linear = dual_vectors.dual_part(twist)
    rotation_axis, angle = vectors.direction_and_length(dual_vectors.real_part(twist))
    translation_axis, distance = vectors.direction_and_length(linear)

    is_pure = angle < _PURE_TRANSLATION_BELOW
    normal = vectors.cross(rotation_axis, vectors.cross(linear, rotation_axis))
    moment_scale = select(is_pure, 0.0, 1.0) / select(is_pure, 1.0, angle)
    return (
        select(is_pure, 0.0, angle),
        select(is_pure, distance, vectors.dot(rotation_axis, linear)),
        (
            select(is_pure, translation_axis[0], rotation_axis[0]),
            select(is_pure, translation_axis[1], rotation_axis[1]),
            select(is_pure, translation_axis[2], rotation_axis[2]),
        ),
        vectors.scale(moment_scale, normal),
    )


def from_screw_parameters(
    angle: Scalar, translation: Scalar, direction: Components, moment: Components
) -> DualQuaternion:
    """Return the pose of a screw motion, cos + sin (l + eps m) of half of angle + eps translation.

    Args:
        angle: Rotation about the axis, shape (), rad.
        translation: Translation along the axis, shape (), m.
        direction: Unit vector l along the axis, shape (3,), dimensionless.
        moment: Moment m of the axis about the origin, perpendicular to l, shape (3,), m.

    Returns:
        Unit dual quaternion, shape (8,), dimensionless and m.
    """
    cosine, sine = cos(0.5 * angle), sin(0.5 * angle)
    half = 0.5 * translation
    real = vectors.scale(sine, direction)
    dual = vectors.add(vectors.scale(half * cosine, direction), vectors.scale(sine, moment))
    return (cosine, real[0], real[1], real[2], -half * sine, dual[0], dual[1], dual[2])


def _dexp_coefficients(twist: Components) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return a, b and their dual parts; the right Jacobian is 1 - a ad + b ad^2 over the dual numbers."""
    angular, linear = dual_vectors.real_part(twist), dual_vectors.dual_part(twist)
    # a = c2 and b = c3 of the dual number |xi_r|^2 + 2 eps xi_r.xi_d; 2 c2' = 2 c4 - c3, 2 c3' = 3 c5 - c4.
    _, _, c2, c3, c4, c5 = stumpff(vectors.dot(angular, angular))
    along = vectors.dot(angular, linear)
    return c2, c3, along * (2.0 * c4 - c3), along * (3.0 * c5 - c4)


def _ad_polynomial(
    twist: Components, vector: Components, a: Scalar, b: Scalar, a_dual: Scalar, b_dual: Scalar
) -> DualVector:
    """Return vector + (a + eps a_dual) xi x vector + (b + eps b_dual) xi x (xi x vector)."""
    once = dual_vectors.cross(twist, vector)
    twice = dual_vectors.cross(twist, once)
    dual = vectors.add(
        vectors.scale(a_dual, dual_vectors.real_part(once)),
        vectors.scale(b_dual, dual_vectors.real_part(twice)),
    )
    total = dual_vectors.add(
        vector, dual_vectors.add(dual_vectors.scale(a, once), dual_vectors.scale(b, twice))
    )
    return dual_vectors.add(total, (0.0, 0.0, 0.0, dual[0], dual[1], dual[2]))


def dexp(twist: Components, rate: Components) -> DualVector:
    """Return the right Jacobian of the exponential times a vector: the dual velocity of q exp(xi(t)).

    Args:
        twist: xi, shape (6,), rad and m.
        rate: Time derivative of xi, shape (6,), rad/s and m/s.

    Returns:
        Dual velocity in the moving frame, shape (6,), rad/s and m/s.
    """
    a, b, a_dual, b_dual = _dexp_coefficients(twist)
    return _ad_polynomial(twist, rate, -a, b, -a_dual, b_dual)


def dexp_inverse(twist: Components, velocity: Components) -> DualVector:
    """Return the inverse right Jacobian times a vector: the rate of xi for a dual velocity of q exp(xi(t)).

    It is 1 + ad/2 + c ad^2 over the dual numbers, with c = (1 - (t/2) cot(t/2)) / t^2 and t the dual angle.

    Args:
        twist: xi with a rotation of less than 2 pi, shape (6,), rad and m.
        velocity: Dual velocity in the moving frame, shape (6,), rad/s and m/s.

    Returns:
        Time derivative of xi, shape (6,), rad/s and m/s.
    """
    angular, linear = dual_vectors.real_part(twist), dual_vectors.dual_part(twist)
    # c = g / (4 c1), g = c2 - c3, of the half angle squared; g' = (3 c4 - c3 - 3 c5) / 2 and c1' = -g / 2.
    _, c1, c2, c3, c4, c5 = stumpff(0.25 * vectors.dot(angular, angular))
    ratio = (c2 - c3) / c1
    slope = (0.5 * (3.0 * (c4 - c5) - c3) / c1 + 0.5 * ratio * ratio) / 16.0
    return _ad_polynomial(twist, velocity, 0.5, 0.25 * ratio, 0.0, 2.0 * slope * vectors.dot(angular, linear))


def _jacobian(twist: Components, a: Scalar, b: Scalar, a_dual: Scalar, b_dual: Scalar) -> Matrix6:
    """Return the matrix of `_ad_polynomial`, made of its values on the unit vectors."""
    x = _ad_polynomial(twist, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), a, b, a_dual, b_dual)
    y = _ad_polynomial(twist, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), a, b, a_dual, b_dual)
    z = _ad_polynomial(twist, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), a, b, a_dual, b_dual)
    # The map is linear over the dual numbers: eps x is sent to eps times what x is sent to.
    return (
        (x[0], y[0], z[0], 0.0, 0.0, 0.0),
        (x[1], y[1], z[1], 0.0, 0.0, 0.0),
        (x[2], y[2], z[2], 0.0, 0.0, 0.0),
        (x[3], y[3], z[3], x[0], y[0], z[0]),
        (x[4], y[4], z[4], x[1], y[1], z[1]),
        (x[5], y[5], z[5], x[2], y[2], z[2]),
    )


def exponential_right_jacobian(twist: Components) -> Matrix6:
    """Return the matrix J with exp(xi + d) = exp(xi) exp(J d) to first order in d.

    Args:
        twist: xi, shape (6,), rad and m.

    Returns:
        Right Jacobian, shape (6, 6), dimensionless and m.
    """
    a, b, a_dual, b_dual = _dexp_coefficients(twist)
    return _jacobian(twist, -a, b, -a_dual, b_dual)


def exponential_left_jacobian(twist: Components) -> Matrix6:
    """Return the matrix J with exp(xi + d) = exp(J d) exp(xi) to first order in d.

    Args:
        twist: xi, shape (6,), rad and m.

    Returns:
        Left Jacobian, shape (6, 6), dimensionless and m.
    """
    a, b, a_dual, b_dual = _dexp_coefficients(twist)
    return _jacobian(twist, a, b, a_dual, b_dual)
