"""Poses as a scene file writes them: position and rotation, or a unit dual quaternion."""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.validation.fields import Eight, Finite, Position, Three, Vector3, read_numbers
from dq_space_arm_env.validation.problems import Model, problem

Quaternion = tuple[float, float, float, float]
Matrix3 = tuple[Three, Three, Three]

# Entries that a planar base keeps of its pose (q_r0, q_r3, q_d1, q_d2) and velocity (omega_z, v_x, v_y).
PLANAR_POSE = (0, 3, 5, 6)
PLANAR_TWIST = (2, 3, 4)

_UNIT_TOLERANCE = 1e-6
# Normalizing twice must change nothing, or a scene would not survive its own YAML: what one normalization
# leaves of |q| - 1 is below this, and is left alone.
_ROUNDING = 8 * 2.0**-53
_SNAP = 4e-16


def _snap(number: float) -> float:
    """Round to 0 or +-1 what equals it up to rounding errors."""
    nearest = round(number)
    return float(nearest) if abs(number - nearest) < _SNAP else number


def _normalized(q: Quaternion) -> Quaternion:
    norm = math.hypot(*q)
    if abs(norm - 1.0) <= _ROUNDING:
        return q
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


class AxisAngle(Model):
    """A rotation as axis and angle."""

    axis: Vector3 = Field(description="rotation axis, 3 numbers of any length but zero, in the outer frame")
    angle: Finite = Field(description="rotation angle about the axis, degrees")

    @field_validator("axis")
    @classmethod
    def _has_direction(cls, axis: Three) -> Three:
        if not 0 < math.hypot(*axis) < math.inf:
            raise problem("must not have zero (or infinite) length: it gives a direction")
        return axis

    def quaternion(self) -> Quaternion:
        """Write the rotation as a unit quaternion."""
        length = math.hypot(*self.axis)
        direction = [component / length for component in self.axis]
        # Whole turns are taken off in degrees, where that is exact; each changes the sign of the quaternion.
        angle = math.remainder(self.angle, 360.0)
        sign = 1.0 if math.remainder(self.angle - angle, 720.0) == 0 else -1.0
        quaternion = rotations.from_axis_angle(direction, math.radians(angle))
        w, x, y, z = (sign * _snap(component) + 0.0 for component in quaternion)  # no -0.0
        return (w, x, y, z)


def _read_rotation(value: Any) -> Quaternion:
    if isinstance(value, dict | AxisAngle):
        return AxisAngle.model_validate(value).quaternion()
    if not isinstance(value, list | tuple | np.ndarray):
        raise problem("must be a unit quaternion [w, x, y, z] or {axis: [x, y, z], angle: degrees}")
    w, x, y, z = read_numbers(value, 4)
    norm = math.hypot(w, x, y, z)
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise problem(f"must be a unit quaternion [w, x, y, z]: |q| = {norm:.9g}, should be 1 within 1e-6")
    return _normalized((w, x, y, z))


def _read_dual_quaternion(value: Any) -> Eight:
    numbers = read_numbers(value, 8)
    w, x, y, z, d0, d1, d2, d3 = numbers
    norm = math.hypot(w, x, y, z)
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise problem(f"not a unit dual quaternion: |q_r| = {norm:.9g}, should be 1")
    product = w * d0 + x * d1 + y * d2 + z * d3
    if abs(product) > _UNIT_TOLERANCE:
        raise problem(f"not a unit dual quaternion: q_r . q_d = {product:.9g}, should be 0")
    rotation = _normalized((w, x, y, z))
    scale = 1.0 if rotation == (w, x, y, z) else 1.0 / norm
    return (*rotation, d0 * scale, d1 * scale, d2 * scale, d3 * scale)


class _DualQuaternionForm(Model):
    """A pose written as `{dual_quaternion: [8 numbers]}`."""

    dual_quaternion: Annotated[Eight, BeforeValidator(_read_dual_quaternion)] = Field(
        description="unit dual quaternion, 8 numbers: real part [w, x, y, z], then dual part, m"
    )


def _position_and_rotation(dual_quaternion: Eight) -> dict[str, tuple[float, ...]]:
    """Split a unit dual quaternion into rotation q_r and position r = 2 q_d q_r*."""
    rotation, position = poses.to_rotation_and_position(dual_quaternion)
    return {"position": position, "rotation": rotation}


class Pose(Model):
    """Pose of a frame with respect to an outer frame.

    Written as `{position: [x, y, z], rotation: [w, x, y, z]}`, where the rotation may also be
    `{axis: [x, y, z], angle: degrees}`; as `{dual_quaternion: [8 numbers]}`; or as a plain list of 8 numbers.
    The sign of the quaternion is kept as given: q and -q are one pose, but not one cost.
    """

    _other_keys: ClassVar[tuple[str, ...]] = ("dual_quaternion",)

    position: Position = Field(
        default=(0.0, 0.0, 0.0), description="origin of the frame in the outer frame, m"
    )
    rotation: Annotated[Quaternion, BeforeValidator(_read_rotation)] = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="rotation q_{frame/outer}: unit quaternion [w, x, y, z], or {axis, angle in degrees}",
    )

    @model_validator(mode="before")
    @classmethod
    def _accept_dual_quaternion(cls, data: Any) -> Any:
        if isinstance(data, np.ndarray):
            data = data.tolist()
        if isinstance(data, list | tuple):
            if len(data) != 8:
                forms = "8 finite numbers, or {position: [x, y, z]} with a rotation if any"
                raise problem(f"must be {forms}; it has {len(data)}")
            return _position_and_rotation(_read_dual_quaternion(data))
        if not isinstance(data, dict) or "dual_quaternion" not in data:
            return data
        others = [key for key in ("position", "rotation") if key in data]
        if others:
            raise problem(
                f"give either dual_quaternion or position and rotation: remove {' and '.join(others)}"
            )
        return _position_and_rotation(_DualQuaternionForm.model_validate(data).dual_quaternion)

    @property
    def dual_quaternion(self) -> Eight:
        """The pose as unit dual quaternion q_r + eps q_d, q_d = 1/2 r^Y q_r: shape (8,), real part first."""
        return poses.from_rotation_and_position(self.rotation, self.position)

    @property
    def rotation_matrix(self) -> Matrix3:
        """Rotation matrix from the frame's axes to the outer axes, 3x3, dimensionless."""
        # Exact zeros and ones vanish from the traced code; 1e-16 would stay and cost an operation.
        (a, b, c), (d, e, f), (g, h, i) = rotations.to_matrix(self.rotation)
        return (
            (_snap(a), _snap(b), _snap(c)),
            (_snap(d), _snap(e), _snap(f)),
            (_snap(g), _snap(h), _snap(i)),
        )
