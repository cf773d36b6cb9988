"""Operations on 3-vectors and 3 x 3 matrices, as far as rotations need them.

A vector is a tuple of 3 scalars, a matrix a tuple of 3 rows.
"""

from dq_space_arm_env.algebra._types import Components, Matrix3, Scalar, Vector
from dq_space_arm_env.algebra.scalars import maximum, safe_sqrt, select, sqrt

__all__ = [
    "add",
    "cross",
    "direction_and_length",
    "dot",
    "matrix_product",
    "matrix_vector",
    "norm",
    "scale",
    "skew_matrix",
    "subtract",
    "transpose",
    "transposed_matrix_vector",
]


def add(a: Components, b: Components) -> Vector:
    """Return a + b: (3,), (3,) -> (3,)."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Components, b: Components) -> Vector:
    """Return a - b: (3,), (3,) -> (3,)."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(factor: Scalar, a: Components) -> Vector:
    """Return factor * a: (), (3,) -> (3,)."""
    return (factor * a[0], factor * a[1], factor * a[2])


def dot(a: Components, b: Components) -> Scalar:
    """Return the scalar product of a and b: (3,), (3,) -> ()."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Components, b: Components) -> Vector:
    """Return the vector product a x b: (3,), (3,) -> (3,)."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def norm(a: Components) -> Scalar:
    """Return the length of a; its derivative at the origin is taken as 0: (3,) -> ().

    The squares underflow for a length below 1e-154: there `direction_and_length` is accurate.
    """
    return safe_sqrt(dot(a, a))


def direction_and_length(a: Components) -> tuple[Vector, Scalar]:
    """Return the unit vector along a, and the length of a, without overflow or underflow.

    (3,) -> (3,), ().

    The zero vector is given the direction (1, 0, 0).
    """
    largest = maximum(abs(a[0]), maximum(abs(a[1]), abs(a[2])))
    is_nonzero = largest > 0.0
    divisor = select(is_nonzero, largest, 1.0)
    scaled = (select(is_nonzero, a[0] / divisor, 1.0), a[1] / divisor, a[2] / divisor)
    scaled_length = sqrt(dot(scaled, scaled))
    direction = (scaled[0] / scaled_length, scaled[1] / scaled_length, scaled[2] / scaled_length)
    return direction, largest * scaled_length


def skew_matrix(a: Components) -> Matrix3:
    """Return the matrix [a]^x with [a]^x b = a x b, the block of (1): (3,) -> (3, 3)."""
    return ((0.0, -a[2], a[1]), (a[2], 0.0, -a[0]), (-a[1], a[0], 0.0))


def transpose(matrix: Components) -> Matrix3:
    """Return the transpose: (3, 3) -> (3, 3)."""
    return (
        (matrix[0][0], matrix[1][0], matrix[2][0]),
        (matrix[0][1], matrix[1][1], matrix[2][1]),
        (matrix[0][2], matrix[1][2], matrix[2][2]),
    )


def matrix_vector(matrix: Components, a: Components) -> Vector:
    """Return the product of a matrix and a vector: (3, 3), (3,) -> (3,)."""
    return (dot(matrix[0], a), dot(matrix[1], a), dot(matrix[2], a))


def transposed_matrix_vector(matrix: Components, a: Components) -> Vector:
    """Return the product of the transpose of a matrix and a vector: (3, 3), (3,) -> (3,)."""
    return matrix_vector(transpose(matrix), a)


def matrix_product(left: Components, right: Components) -> Matrix3:
    """Return the product of two matrices: (3, 3), (3, 3) -> (3, 3)."""
    columns = transpose(right)
    return (
        matrix_vector(columns, left[0]),
        matrix_vector(columns, left[1]),
        matrix_vector(columns, left[2]),
    )
