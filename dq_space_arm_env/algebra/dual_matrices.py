"""The 8 x 8 matrices of the paper: [s]^x (6), [a]_L, [b]_R, H(M), the dual inertia (10), and the adjoint.

A matrix is a tuple of 8 rows of 8 scalars. Zeros and ones are plain constants, so that they vanish from a
trace.
"""

from dq_space_arm_env.algebra import dual_quaternion, quaternion
from dq_space_arm_env.algebra._types import Components, DualQuaternion, Matrix4, Matrix8, Scalar

__all__ = [
    "adjoint_matrix",
    "cross_matrix",
    "dual_inertia_matrix",
    "left_matrix",
    "matrix_multiply",
    "right_matrix",
    "swap_columns",
]

_ZERO = ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))


def _from_blocks(real: Matrix4, dual: Matrix4) -> Matrix8:
    """Return the matrix [[real, 0], [dual, real]] of a linear map over the dual numbers."""
    join = dual_quaternion.from_parts
    return (
        join(real[0], _ZERO[0]),
        join(real[1], _ZERO[1]),
        join(real[2], _ZERO[2]),
        join(real[3], _ZERO[3]),
        join(dual[0], real[0]),
        join(dual[1], real[1]),
        join(dual[2], real[2]),
        join(dual[3], real[3]),
    )


def cross_matrix(s: Components) -> Matrix8:
    """Return the matrix [s]^x of (6): for vector dual quaternions s and b, [s]^x b = s x b.

    (8,) -> (8, 8).

    The scalar components of `s` are not used.
    """
    return _from_blocks(
        quaternion.cross_matrix(dual_quaternion.real_part(s)),
        quaternion.cross_matrix(dual_quaternion.dual_part(s)),
    )


def left_matrix(a: Components) -> Matrix8:
    """Return the matrix [a]_L with [a]_L b = ab for every dual quaternion b: (8,) -> (8, 8)."""
    return _from_blocks(
        quaternion.left_matrix(dual_quaternion.real_part(a)),
        quaternion.left_matrix(dual_quaternion.dual_part(a)),
    )


def right_matrix(b: Components) -> Matrix8:
    """Return the matrix [b]_R with [b]_R a = ab for every dual quaternion a: (8,) -> (8, 8)."""
    return _from_blocks(
        quaternion.right_matrix(dual_quaternion.real_part(b)),
        quaternion.right_matrix(dual_quaternion.dual_part(b)),
    )


def matrix_multiply(matrix: Components, a: Components) -> DualQuaternion:
    """Return the product of a matrix and the components of a dual quaternion, the star of (9).

    (8, 8), (8,) -> (8,).
    """
    product = dual_quaternion.circle
    return (
        product(matrix[0], a)[0],
        product(matrix[1], a)[0],
        product(matrix[2], a)[0],
        product(matrix[3], a)[0],
        product(matrix[4], a)[0],
        product(matrix[5], a)[0],
        product(matrix[6], a)[0],
        product(matrix[7], a)[0],
    )


def swap_columns(matrix: Components) -> Matrix8:
    """Return H(M), the matrix with H(M) a = M a^s for every dual quaternion a: (8, 8) -> (8, 8)."""
    swap = dual_quaternion.swap
    return (
        swap(matrix[0]),
        swap(matrix[1]),
        swap(matrix[2]),
        swap(matrix[3]),
        swap(matrix[4]),
        swap(matrix[5]),
        swap(matrix[6]),
        swap(matrix[7]),
    )


def dual_inertia_matrix(mass: Scalar, inertia: Components) -> Matrix8:
    """Return the dual inertia matrix M of (10); M (w)^s is the dual momentum m v + eps J w.

    (), (3, 3) -> (8, 8).

    Its two scalar slots are 1.
    """
    return (
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, mass, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, mass, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, mass, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, inertia[0][0], inertia[0][1], inertia[0][2]),
        (0.0, 0.0, 0.0, 0.0, 0.0, inertia[1][0], inertia[1][1], inertia[1][2]),
        (0.0, 0.0, 0.0, 0.0, 0.0, inertia[2][0], inertia[2][1], inertia[2][2]),
    )


def adjoint_matrix(q: Components) -> Matrix8:
    """Return the matrix [q]_L [q*]_R of Ad(q) s = q s q*: (8,) -> (8, 8)."""
    real = quaternion.left_matrix(dual_quaternion.real_part(q))
    dual = quaternion.left_matrix(dual_quaternion.dual_part(q))
    # [q*]_R is the transpose of [q]_R, hence row times [q*]_R is the quaternion product of the row with q.
    row_0 = dual_quaternion.multiply(dual_quaternion.from_parts(real[0], dual[0]), q)
    row_1 = dual_quaternion.multiply(dual_quaternion.from_parts(real[1], dual[1]), q)
    row_2 = dual_quaternion.multiply(dual_quaternion.from_parts(real[2], dual[2]), q)
    row_3 = dual_quaternion.multiply(dual_quaternion.from_parts(real[3], dual[3]), q)
    return _from_blocks(
        (
            dual_quaternion.real_part(row_0),
            dual_quaternion.real_part(row_1),
            dual_quaternion.real_part(row_2),
            dual_quaternion.real_part(row_3),
        ),
        (
            dual_quaternion.dual_part(row_0),
            dual_quaternion.dual_part(row_1),
            dual_quaternion.dual_part(row_2),
            dual_quaternion.dual_part(row_3),
        ),
    )
