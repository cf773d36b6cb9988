"""Screw motion: exponential and logarithm of poses, interpolation, and their derivatives.

A twist xi is a dual vector, a rotation vector and a translation-like vector, in rad and m, and exp(xi) stands
for the pose exp(1/2 (xi_r + eps xi_d)). With it the kinematics (8) at a constant dual velocity w over a time
h are solved by q exp(h w). By the transference principle each formula is that for rotations, in dual numbers.
"""

from dq_space_arm_env.algebra import dual_quaternion, dual_vectors, quaternion, vectors
from dq_space_arm_env.algebra._series import logarithm_coefficients, stumpff
from dq_space_arm_env.algebra._types import Components, DualQuaternion, DualVector, Matrix6, Scalar

__all__ = [
    "exponential",
    "exponential_minus_identity",
    "exponential_right_jacobian",
    "interpolate",
    "logarithm",
    "power",
]


def exponential(twist: Components) -> DualQuaternion:
    """Return the pose exp(1/2 (xi_r + eps xi_d)): (6,) -> (8,)."""
    scalar, _, rest = _exponential_parts(twist)
    return (scalar, *rest)


def exponential_minus_identity(twist: Components) -> DualQuaternion:
    """Return exp(1/2 (xi_r + eps xi_d)) - 1, to all digits however small the twist: (6,) -> (8,)."""
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
    """Return the twist of the shortest screw motion, the inverse of `exponential`: (8,) -> (6,).

    Both q and -q give the same result.
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

    (8,), () -> (8,).
    """
    return exponential(dual_vectors.scale(exponent, logarithm(q)))


def interpolate(start: Components, end: Components, fraction: Scalar) -> DualQuaternion:
    """Return the pose a given fraction along the shortest screw motion from one pose to another (ScLERP).

    (8,), (8,), () -> (8,).

    At fraction 1 it is `end` or -`end`.
    """
    difference = dual_quaternion.multiply(dual_quaternion.conjugate(start), end)
    return dual_quaternion.multiply(start, power(difference, fraction))


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


def exponential_right_jacobian(twist: Components) -> Matrix6:
    """Return the matrix J with exp(xi + d) = exp(xi) exp(J d) to first order in d: (6,) -> (6, 6)."""
    angular, linear = dual_vectors.real_part(twist), dual_vectors.dual_part(twist)
    # J = 1 - a ad + b ad^2 over the dual numbers, with a = c2 and b = c3 of |xi_r|^2 + 2 eps xi_r.xi_d;
    # 2 c2' = 2 c4 - c3, 2 c3' = 3 c5 - c4.
    _, _, c2, c3, c4, c5 = stumpff(vectors.dot(angular, angular))
    along = vectors.dot(angular, linear)
    coefficients = (-c2, c3, -(along * (2.0 * c4 - c3)), along * (3.0 * c5 - c4))
    x = _ad_polynomial(twist, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), *coefficients)
    y = _ad_polynomial(twist, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), *coefficients)
    z = _ad_polynomial(twist, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), *coefficients)
    # The map is linear over the dual numbers: J (eps x) = eps J x.
    return (
        (x[0], y[0], z[0], 0.0, 0.0, 0.0),
        (x[1], y[1], z[1], 0.0, 0.0, 0.0),
        (x[2], y[2], z[2], 0.0, 0.0, 0.0),
        (x[3], y[3], z[3], x[0], y[0], z[0]),
        (x[4], y[4], z[4], x[1], y[1], z[1]),
        (x[5], y[5], z[5], x[2], y[2], z[2]),
    )
