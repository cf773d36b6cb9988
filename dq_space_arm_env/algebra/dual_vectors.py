"""Dual vectors, the 6 numbers of a twist or a wrench: what the equations of motion use most.

A dual vector a = a_r + eps a_d is the tuple (a_r, a_d). A twist has its angular velocity in a_r and its
linear velocity in a_d; a wrench of the paper has its force in a_r and its torque in a_d. Both change frames
by the same map. `dual_quaternion.from_vector` adds the two scalar slots of a vector dual quaternion.
"""

from dq_space_arm_env.algebra import vectors
from dq_space_arm_env.algebra._types import Components, DualVector, Matrix6, Scalar, Vector

__all__ = [
    "add",
    "cross",
    "dual_part",
    "from_parts",
    "inverse_transform",
    "real_part",
    "scale",
    "subtract",
    "transform",
    "transform_matrix",
]


def real_part(a: Components) -> Vector:
    """Return the real part a_r: (6,) -> (3,)."""
    return (a[0], a[1], a[2])


def dual_part(a: Components) -> Vector:
    """Return the dual part a_d: (6,) -> (3,)."""
    return (a[3], a[4], a[5])


def from_parts(real: Components, dual: Components) -> DualVector:
    """Return real + eps dual: (3,), (3,) -> (6,)."""
    return (real[0], real[1], real[2], dual[0], dual[1], dual[2])


def add(a: Components, b: Components) -> DualVector:
    """Return a + b: (6,), (6,) -> (6,)."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5])


def subtract(a: Components, b: Components) -> DualVector:
    """Return a - b: (6,), (6,) -> (6,)."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3], a[4] - b[4], a[5] - b[5])


def scale(factor: Scalar, a: Components) -> DualVector:
    """Return factor * a: (), (6,) -> (6,)."""
    return (factor * a[0], factor * a[1], factor * a[2], factor * a[3], factor * a[4], factor * a[5])


def cross(a: Components, b: Components) -> DualVector:
    """Return a x b = a_r x b_r + eps (a_d x b_r + a_r x b_d), the cross product of Table II.

    (6,), (6,) -> (6,).
    """
    return from_parts(
        vectors.cross(real_part(a), real_part(b)),
        vectors.add(vectors.cross(dual_part(a), real_part(b)), vectors.cross(real_part(a), dual_part(b))),
    )


def transform(rotation_matrix: Components, position: Components, s: Components) -> DualVector:
    """Return Ad(q) s = R s_r + eps (R s_d + p x R s_r), which takes s^X to s^Y for the pose q = q_{X/Y}.

    (3, 3), (3,), (6,) -> (6,).
    """
    real = vectors.matrix_vector(rotation_matrix, real_part(s))
    dual = vectors.matrix_vector(rotation_matrix, dual_part(s))
    return from_parts(real, vectors.add(dual, vectors.cross(position, real)))


def inverse_transform(rotation_matrix: Components, position: Components, s: Components) -> DualVector:
    """Return Ad(q*) s = R^T s_r + eps R^T (s_d - p x s_r), which takes s^Y to s^X for the pose q = q_{X/Y}.

    (3, 3), (3,), (6,) -> (6,).
    """
    moved = vectors.subtract(dual_part(s), vectors.cross(position, real_part(s)))
    return from_parts(
        vectors.transposed_matrix_vector(rotation_matrix, real_part(s)),
        vectors.transposed_matrix_vector(rotation_matrix, moved),
    )


def transform_matrix(rotation_matrix: Components, position: Components) -> Matrix6:
    """Return the matrix [[R, 0], [[p]^x R, R]] of `transform`: (3, 3), (3,) -> (6, 6)."""
    r = rotation_matrix
    moved = vectors.matrix_product(vectors.skew_matrix(position), r)
    zero = (0.0, 0.0, 0.0)
    return (
        from_parts(r[0], zero),
        from_parts(r[1], zero),
        from_parts(r[2], zero),
        from_parts(moved[0], r[0]),
        from_parts(moved[1], r[1]),
        from_parts(moved[2], r[2]),
    )
