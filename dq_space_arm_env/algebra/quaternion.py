"""Quaternions: Table I of the paper, the operators of (1) and the kinematics (2).

A quaternion is a tuple of 4 scalars (a0, a1, a2, a3), scalar part first, with Hamilton's product. A unit
quaternion q_{X/Y} is the orientation of frame X with respect to frame Y; `rotations` converts it.
"""

from dq_space_arm_env.algebra import vectors
from dq_space_arm_env.algebra._types import Components, Matrix4, Quaternion, Scalar, Vector
from dq_space_arm_env.algebra.scalars import safe_sqrt, select, sqrt

__all__ = [
    "IDENTITY",
    "add",
    "adjoint",
    "canonical",
    "conjugate",
    "cross",
    "cross_matrix",
    "derivative",
    "derivative_from_reference",
    "dot",
    "from_vector",
    "inverse_adjoint",
    "left_matrix",
    "matrix_multiply",
    "multiply",
    "norm",
    "normalize",
    "right_matrix",
    "scale",
    "sign",
    "subtract",
    "to_vector",
    "vector_part",
]

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def add(a: Components, b: Components) -> Quaternion:
    """Return a + b (Table I): (4,), (4,) -> (4,)."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3])


def subtract(a: Components, b: Components) -> Quaternion:
    """Return a - b: (4,), (4,) -> (4,)."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3])


def scale(factor: Scalar, a: Components) -> Quaternion:
    """Return factor * a (Table I): (), (4,) -> (4,)."""
    return (factor * a[0], factor * a[1], factor * a[2], factor * a[3])


def multiply(a: Components, b: Components) -> Quaternion:
    """Return the product ab (Table I): (4,), (4,) -> (4,)."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3],
        a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1],
    )


def conjugate(a: Components) -> Quaternion:
    """Return the conjugate a* (Table I); of a unit quaternion, the inverse: q_{X/Y}* = q_{Y/X}.

    (4,) -> (4,).
    """
    return (a[0], -a[1], -a[2], -a[3])


def dot(a: Components, b: Components) -> Quaternion:
    """Return the dot product of a and b (Table I), a quaternion with zero vector part: (4,), (4,) -> (4,)."""
    return (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3], 0.0, 0.0, 0.0)


def cross(a: Components, b: Components) -> Quaternion:
    """Return the cross product of a and b (Table I); of vector quaternions, the usual one.

    (4,), (4,) -> (4,).
    """
    return (
        0.0,
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3],
        a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1],
    )


def norm(a: Components) -> Scalar:
    """Return the norm sqrt(a . a) (Table I); its derivative at the origin is taken as 0: (4,) -> ()."""
    return safe_sqrt(dot(a, a)[0])


def vector_part(a: Components) -> Quaternion:
    """Return the vector part (0, a1, a2, a3): (4,) -> (4,)."""
    return (0.0, a[1], a[2], a[3])


def from_vector(v: Components) -> Quaternion:
    """Return the vector quaternion (0, v): (3,) -> (4,)."""
    return (0.0, v[0], v[1], v[2])


def to_vector(a: Components) -> Vector:
    """Return the three components of the vector part: (4,) -> (3,)."""
    return (a[1], a[2], a[3])


def cross_matrix(s: Components) -> Matrix4:
    """Return the matrix [s]^x of (1): for vector quaternions s and b, [s]^x b = s x b: (4,) -> (4, 4).

    The scalar part of `s` is not used.
    """
    block = vectors.skew_matrix(to_vector(s))
    return ((0.0, 0.0, 0.0, 0.0), (0.0, *block[0]), (0.0, *block[1]), (0.0, *block[2]))


def left_matrix(a: Components) -> Matrix4:
    """Return the matrix [a]_L with [a]_L b = ab for every quaternion b: (4,) -> (4, 4)."""
    return (
        (a[0], -a[1], -a[2], -a[3]),
        (a[1], a[0], -a[3], a[2]),
        (a[2], a[3], a[0], -a[1]),
        (a[3], -a[2], a[1], a[0]),
    )


def right_matrix(b: Components) -> Matrix4:
    """Return the matrix [b]_R with [b]_R a = ab for every quaternion a: (4,) -> (4, 4)."""
    return (
        (b[0], -b[1], -b[2], -b[3]),
        (b[1], b[0], b[3], -b[2]),
        (b[2], -b[3], b[0], b[1]),
        (b[3], b[2], -b[1], b[0]),
    )


def matrix_multiply(matrix: Components, a: Components) -> Quaternion:
    """Return the product of a matrix and the components of a quaternion: (4, 4), (4,) -> (4,)."""
    return (dot(matrix[0], a)[0], dot(matrix[1], a)[0], dot(matrix[2], a)[0], dot(matrix[3], a)[0])


def adjoint(q: Components, s: Components) -> Quaternion:
    """Return Ad(q) s = q s q*: with q_{X/Y} it takes s^X to s^Y: (4,), (4,) -> (4,)."""
    return multiply(multiply(q, s), conjugate(q))


def inverse_adjoint(q: Components, s: Components) -> Quaternion:
    """Return q* s q, the inverse of `adjoint`: with q_{Y/X} it takes s^X to s^Y: (4,), (4,) -> (4,)."""
    return multiply(multiply(conjugate(q), s), q)


def derivative(q: Components, angular_velocity: Components) -> Quaternion:
    """Return the time derivative 1/2 q_{X/Y} w^X of (2): (4,), (3,) -> (4,)."""
    return scale(0.5, multiply(q, from_vector(angular_velocity)))


def derivative_from_reference(q: Components, angular_velocity: Components) -> Quaternion:
    """Return the time derivative 1/2 w^Y q_{X/Y} of (2): (4,), (3,) -> (4,)."""
    return scale(0.5, multiply(from_vector(angular_velocity), q))


def normalize(a: Components) -> Quaternion:
    """Return a divided by its norm: (4,) -> (4,)."""
    return scale(1.0 / sqrt(dot(a, a)[0]), a)


def sign(q: Components) -> Scalar:
    """Return the sign, 1 or -1, of the first nonzero component, which distinguishes q from -q: (4,) -> ().

    It is 1 for the zero quaternion.
    """
    first = select(q[2] == 0.0, q[3], q[2])
    first = select(q[1] == 0.0, first, q[1])
    first = select(q[0] == 0.0, first, q[0])
    return select(first < 0.0, -1.0, 1.0)


def canonical(q: Components) -> Quaternion:
    """Return the one of q and -q, which are the same rotation, whose first nonzero component is positive.

    (4,) -> (4,).
    """
    return scale(sign(q), q)
