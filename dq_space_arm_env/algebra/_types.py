"""The types of the algebra: flat tuples of plain scalars.

There are no classes. A quaternion is a tuple of 4 scalars, a dual quaternion a tuple of 8, a
3-vector a tuple of 3, a dual vector (twist, wrench) a tuple of 6 and a matrix a tuple of row tuples. That is
what lets the same function run on floats, on NumPy batches and under CasADi.
"""

from typing import Any, Protocol

# A float, a NumPy array (a batch of values) or a CasADi SX: they share arithmetic but no base type.
Scalar = Any

Vector = tuple[Scalar, Scalar, Scalar]
Quaternion = tuple[Scalar, Scalar, Scalar, Scalar]
DualVector = tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]
DualQuaternion = tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]

Matrix3 = tuple[Vector, Vector, Vector]
Matrix4 = tuple[Quaternion, Quaternion, Quaternion, Quaternion]
Matrix6 = tuple[DualVector, DualVector, DualVector, DualVector, DualVector, DualVector]
Matrix8 = tuple[
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
    DualQuaternion,
]


class Components(Protocol):
    """A function's argument: anything indexed by component, the component axis first."""

    def __getitem__(self, index: int, /) -> Any:
        """Return one component, or one row of a matrix."""
