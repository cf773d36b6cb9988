"""Dual quaternions: Table II of the paper, frame changes (7) and the kinematics (8).

A dual quaternion is a tuple of 8 scalars: the real part (4), then the dual part (4), each with its scalar
first. A unit dual quaternion q_{X/Y} is the pose of frame X with respect to frame Y. A twist or a wrench is a
vector dual quaternion: its components 0 and 4 are zero. `dual_vectors` has the same without these two slots.
"""

from dq_space_arm_env.algebra import quaternion
from dq_space_arm_env.algebra._types import Components, DualQuaternion, DualVector, Quaternion, Scalar
from dq_space_arm_env.algebra.scalars import safe_sqrt, sqrt

__all__ = [
    "IDENTITY",
    "ZERO",
    "add",
    "adjoint",
    "canonical",
    "circle",
    "conjugate",
    "cross",
    "derivative",
    "derivative_from_reference",
    "dot",
    "dual_part",
    "from_parts",
    "from_vector",
    "inverse_adjoint",
    "multiply",
    "norm",
    "normalize",
    "real_part",
    "scale",
    "subtract",
    "swap",
    "to_vector",
    "vector_part",
]

IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def real_part(a: Components) -> Quaternion:
    """Return the real part a_r; of a pose, the rotation: (8,) -> (4,)."""
    return (a[0], a[1], a[2], a[3])


def dual_part(a: Components) -> Quaternion:
    """Return the dual part a_d; of a pose, half the position times the rotation: (8,) -> (4,)."""
    return (a[4], a[5], a[6], a[7])


def from_parts(real: Components, dual: Components) -> DualQuaternion:
    """Return real + eps dual: (4,), (4,) -> (8,)."""
    return (real[0], real[1], real[2], real[3], dual[0], dual[1], dual[2], dual[3])


def add(a: Components, b: Components) -> DualQuaternion:
    """Return a + b (Table II): (8,), (8,) -> (8,)."""
    return from_parts(
        quaternion.add(real_part(a), real_part(b)),
        quaternion.add(dual_part(a), dual_part(b)),
    )


def subtract(a: Components, b: Components) -> DualQuaternion:
    """Return a - b: (8,), (8,) -> (8,)."""
    return from_parts(
        quaternion.subtract(real_part(a), real_part(b)),
        quaternion.subtract(dual_part(a), dual_part(b)),
    )


def scale(factor: Scalar, a: Components) -> DualQuaternion:
    """Return factor * a (Table II): (), (8,) -> (8,)."""
    return from_parts(quaternion.scale(factor, real_part(a)), quaternion.scale(factor, dual_part(a)))


def multiply(a: Components, b: Components) -> DualQuaternion:
    """Return the product ab (Table II); of poses, q_{Z/X} = q_{Y/X} q_{Z/Y}: (8,), (8,) -> (8,)."""
    return from_parts(
        quaternion.multiply(real_part(a), real_part(b)),
        quaternion.add(
            quaternion.multiply(dual_part(a), real_part(b)),
            quaternion.multiply(real_part(a), dual_part(b)),
        ),
    )


def conjugate(a: Components) -> DualQuaternion:
    """Return the conjugate a* (Table II); of a pose, the inverse: q_{X/Y}* = q_{Y/X}: (8,) -> (8,)."""
    return from_parts(quaternion.conjugate(real_part(a)), quaternion.conjugate(dual_part(a)))


def dot(a: Components, b: Components) -> DualQuaternion:
    """Return the dot product of a and b (Table II), a dual quaternion with zero vector parts.

    (8,), (8,) -> (8,).
    """
    return from_parts(
        quaternion.dot(real_part(a), real_part(b)),
        quaternion.add(
            quaternion.dot(dual_part(a), real_part(b)),
            quaternion.dot(real_part(a), dual_part(b)),
        ),
    )


def cross(a: Components, b: Components) -> DualQuaternion:
    """Return the cross product of a and b (Table II): (8,), (8,) -> (8,)."""
    return from_parts(
        quaternion.cross(real_part(a), real_part(b)),
        quaternion.add(
            quaternion.cross(dual_part(a), real_part(b)),
            quaternion.cross(real_part(a), dual_part(b)),
        ),
    )


def circle(a: Components, b: Components) -> DualQuaternion:
    """Return the circle product of a and b (Table II), the sum of the 8 products in component 0.

    (8,), (8,) -> (8,).
    """
    return from_parts(
        quaternion.add(
            quaternion.dot(real_part(a), real_part(b)),
            quaternion.dot(dual_part(a), dual_part(b)),
        ),
        (0.0, 0.0, 0.0, 0.0),
    )


def swap(a: Components) -> DualQuaternion:
    """Return a^s = a_d + eps a_r (Table II): (8,) -> (8,)."""
    return from_parts(dual_part(a), real_part(a))


def norm(a: Components) -> Scalar:
    """Return the norm sqrt(a o a) (Table II); its derivative at the origin is taken as 0: (8,) -> ().

    Of a pose at position r it is sqrt(1 + |r|^2 / 4), not 1: "unit" means q* q = 1.
    """
    return safe_sqrt(circle(a, a)[0])


def vector_part(a: Components) -> DualQuaternion:
    """Return vec(a) (Table II): both scalar components set to zero: (8,) -> (8,)."""
    return from_parts(quaternion.vector_part(real_part(a)), quaternion.vector_part(dual_part(a)))


def from_vector(v: Components) -> DualQuaternion:
    """Return the vector dual quaternion of a dual vector: (6,) -> (8,)."""
    return (0.0, v[0], v[1], v[2], 0.0, v[3], v[4], v[5])


def to_vector(a: Components) -> DualVector:
    """Return the dual vector in a dual quaternion, dropping its scalar components: (8,) -> (6,)."""
    return (a[1], a[2], a[3], a[5], a[6], a[7])


def adjoint(q: Components, s: Components) -> DualQuaternion:
    """Return Ad(q) s = q s q*: with q_{X/Y} it takes s^X to s^Y, a twist as well as a wrench.

    (8,), (8,) -> (8,).
    """
    return multiply(multiply(q, s), conjugate(q))


def inverse_adjoint(q: Components, s: Components) -> DualQuaternion:
    """Return q* s q, the frame change of (7): with q_{Y/X} it takes s^X to s^Y. The inverse of `adjoint`.

    (8,), (8,) -> (8,).
    """
    return multiply(multiply(conjugate(q), s), q)


def derivative(q: Components, velocity: Components) -> DualQuaternion:
    """Return the time derivative 1/2 q_{X/Y} w^X of (8): (8,), (6,) -> (8,)."""
    return scale(0.5, multiply(q, from_vector(velocity)))


def derivative_from_reference(q: Components, velocity: Components) -> DualQuaternion:
    """Return the time derivative 1/2 w^Y q_{X/Y} of (8): (8,), (6,) -> (8,)."""
    return scale(0.5, multiply(from_vector(velocity), q))


def normalize(a: Components) -> DualQuaternion:
    """Return the unit dual quaternion a (a* a)^(-1/2): unit real part, dual part orthogonal to it.

    (8,) -> (8,).
    """
    real, dual = real_part(a), dual_part(a)
    inverse_norm = 1.0 / sqrt(quaternion.dot(real, real)[0])
    unit = quaternion.scale(inverse_norm, real)
    dual = quaternion.scale(inverse_norm, dual)
    along = quaternion.dot(unit, dual)[0]
    return from_parts(unit, quaternion.subtract(dual, quaternion.scale(along, unit)))


def canonical(q: Components) -> DualQuaternion:
    """Return the one of q and -q, which are the same pose, whose first nonzero component is positive.

    (8,) -> (8,).
    """
    return scale(quaternion.sign(real_part(q)), q)
