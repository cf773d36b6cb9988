"""The algebra of the paper, written once over plain scalars: quaternions, dual quaternions, poses, screws.

Every function takes and returns flat tuples of scalars. A scalar may be a float, a NumPy array (a batch: the
component axis comes first) or a CasADi symbol; see `scalars`. Docstrings give the shapes as NumPy signatures,
for example `(3, 3), (3,) -> (3,)`. Units are SI and rad: a pose is dimensionless (real part) and m (dual
part), a twist rad/s and m/s, its integral rad and m; the other functions keep the units of their arguments.

    vectors          3-vectors and 3 x 3 matrices
    quaternion       Table I, (1), (2)
    rotations        unit quaternions from and to matrices, angles, rotation vectors
    dual_quaternion  Table II, (7), (8)
    dual_matrices    8 x 8 matrices: (6), [a]_L, [b]_R, H(M), dual inertia (10), adjoint
    dual_vectors     twists and wrenches as 6 numbers
    poses            unit dual quaternions from and to rotation and position, pose error (31)
    screw            exponential, its Jacobian, logarithm, interpolation
    symbolic         CasADi matrices, for tracing
"""

from dq_space_arm_env.algebra import (
    dual_matrices,
    dual_quaternion,
    dual_vectors,
    poses,
    quaternion,
    rotations,
    scalars,
    screw,
    vectors,
)
from dq_space_arm_env.algebra.dual_quaternion import adjoint, conjugate, inverse_adjoint, multiply, normalize
from dq_space_arm_env.algebra.poses import error_angle, error_distance, error_pose, position
from dq_space_arm_env.algebra.screw import exponential, interpolate, logarithm

__all__ = [
    "adjoint",
    "conjugate",
    "dual_matrices",
    "dual_quaternion",
    "dual_vectors",
    "error_angle",
    "error_distance",
    "error_pose",
    "exponential",
    "interpolate",
    "inverse_adjoint",
    "logarithm",
    "multiply",
    "normalize",
    "poses",
    "position",
    "quaternion",
    "rotations",
    "scalars",
    "screw",
    "vectors",
]
