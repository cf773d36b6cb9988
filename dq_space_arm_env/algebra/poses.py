"""Poses as unit dual quaternions: from and to rotation and position, and the error between two poses (31).

The pose q_{X/Y} = q_r + eps q_d has q_d = 1/2 q_r r^X = 1/2 r^Y q_r, r being the position of the origin of X
relative to that of Y. Each `from_...` takes what the `to_...` of the same name returns, position r^Y last.
"""

from dq_space_arm_env.algebra import dual_quaternion, quaternion, rotations, vectors
from dq_space_arm_env.algebra._types import Components, DualQuaternion, Matrix3, Quaternion, Scalar, Vector

__all__ = [
    "body_position",
    "error_angle",
    "error_distance",
    "error_pose",
    "from_axis_angle",
    "from_euler_321",
    "from_matrix",
    "from_rotation_and_body_position",
    "from_rotation_and_position",
    "position",
    "to_axis_angle",
    "to_euler_321",
    "to_matrix",
    "to_rotation_and_position",
]


def position(q: Components) -> Vector:
    """Return the position r^Y = 2 q_d q_r* of the pose q_{X/Y}, in the axes of the reference frame Y.

    (8,) -> (3,).
    """
    real, dual = dual_quaternion.real_part(q), dual_quaternion.dual_part(q)
    half = quaternion.multiply(dual, quaternion.conjugate(real))
    return vectors.scale(2.0, quaternion.to_vector(half))


def body_position(q: Components) -> Vector:
    """Return the position r^X = 2 q_r* q_d of the pose q_{X/Y}, in the body axes X.

    (8,) -> (3,).
    """
    real, dual = dual_quaternion.real_part(q), dual_quaternion.dual_part(q)
    half = quaternion.multiply(quaternion.conjugate(real), dual)
    return vectors.scale(2.0, quaternion.to_vector(half))


def from_rotation_and_position(rotation: Components, position: Components) -> DualQuaternion:
    """Return the pose of a rotation and a position in reference axes, q_d = 1/2 r^Y q_r.

    (4,), (3,) -> (8,).
    """
    half = quaternion.from_vector(vectors.scale(0.5, position))
    return dual_quaternion.from_parts(rotation, quaternion.multiply(half, rotation))


def from_rotation_and_body_position(rotation: Components, position: Components) -> DualQuaternion:
    """Return the pose of a rotation and a position in body axes, q_d = 1/2 q_r r^X: (4,), (3,) -> (8,)."""
    half = quaternion.from_vector(vectors.scale(0.5, position))
    return dual_quaternion.from_parts(rotation, quaternion.multiply(rotation, half))


def to_rotation_and_position(q: Components) -> tuple[Quaternion, Vector]:
    """Return the rotation and the position in reference axes: (8,) -> (4,), (3,)."""
    return dual_quaternion.real_part(q), position(q)


def from_matrix(matrix: Components, position: Components) -> DualQuaternion:
    """Return the pose of a rotation matrix and a position: (3, 3), (3,) -> (8,)."""
    return from_rotation_and_position(rotations.from_matrix(matrix), position)


def to_matrix(q: Components) -> tuple[Matrix3, Vector]:
    """Return the rotation matrix and the position, as `dual_vectors.transform` takes them.

    (8,) -> (3, 3), (3,).
    """
    return rotations.to_matrix(dual_quaternion.real_part(q)), position(q)


def from_euler_321(psi: Scalar, theta: Scalar, phi: Scalar, position: Components) -> DualQuaternion:
    """Return the pose of 3-2-1 Euler angles and a position: (), (), (), (3,) -> (8,)."""
    return from_rotation_and_position(rotations.from_euler_321(psi, theta, phi), position)


def to_euler_321(q: Components) -> tuple[Scalar, Scalar, Scalar, Vector]:
    """Return the 3-2-1 Euler angles and the position; phi is 0 at gimbal lock: (8,) -> (), (3,)."""
    psi, theta, phi = rotations.to_euler_321(dual_quaternion.real_part(q))
    return psi, theta, phi, position(q)


def from_axis_angle(axis: Components, angle: Scalar, position: Components) -> DualQuaternion:
    """Return the pose of a rotation by an angle about an axis, and a position: (3,), (), (3,) -> (8,)."""
    return from_rotation_and_position(rotations.from_axis_angle(axis, angle), position)


def to_axis_angle(q: Components) -> tuple[Vector, Scalar, Vector]:
    """Return the axis and the angle of the shortest rotation, and the position: (8,) -> (3,), (), (3,)."""
    axis, angle = rotations.to_axis_angle(dual_quaternion.real_part(q))
    return axis, angle, position(q)


def error_pose(actual: Components, desired: Components) -> DualQuaternion:
    """Return the error q_{D/G} = q_{G/I}* q_{D/I} of (31): (8,), (8,) -> (8,).

    Its `position` is the position error in the axes of G.
    """
    return dual_quaternion.multiply(dual_quaternion.conjugate(actual), desired)


def error_angle(actual: Components, desired: Components) -> Scalar:
    """Return the Euler angle of the error (31), that of the shortest rotation: (8,), (8,) -> ()."""
    actual_inverse = quaternion.conjugate(dual_quaternion.real_part(actual))
    return rotations.angle(quaternion.multiply(actual_inverse, dual_quaternion.real_part(desired)))


def error_distance(actual: Components, desired: Components) -> Scalar:
    """Return the length of the position error of (31): (8,), (8,) -> ()."""
    return vectors.norm(vectors.subtract(position(desired), position(actual)))
