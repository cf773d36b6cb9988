"""Random arguments for the tests of the algebra, the same in every run."""

import math

from hypothesis import assume, settings
from hypothesis import strategies as st

from dq_space_arm_env.algebra import poses, quaternion, rotations

REPRODUCIBLE = settings(derandomize=True, deadline=None, max_examples=100)

NUMBERS = st.floats(-10.0, 10.0)
ANGLES = st.floats(-math.pi, math.pi)

VECTORS = st.tuples(*[NUMBERS] * 3)
QUATERNIONS = st.tuples(*[NUMBERS] * 4)
DUAL_VECTORS = st.tuples(*[NUMBERS] * 6)
DUAL_QUATERNIONS = st.tuples(*[NUMBERS] * 8)
VECTOR_DUAL_QUATERNIONS = st.builds(lambda v: (0.0, *v[:3], 0.0, *v[3:]), DUAL_VECTORS)


@st.composite
def unit_quaternions(draw):
    """Draw a rotation, often a special one, since hypothesis likes zeros and ones."""
    q = draw(QUATERNIONS)
    assume(quaternion.norm(q) > 1e-3)
    return quaternion.normalize(q)


@st.composite
def unit_dual_quaternions(draw):
    """Draw a pose within 17 m of the origin."""
    return poses.from_rotation_and_position(draw(unit_quaternions()), draw(VECTORS))


@st.composite
def twists(draw, largest_angle=3.1):
    """Draw a twist whose rotation is below half a turn, so that the logarithm returns it."""
    axis, _ = rotations.to_axis_angle(draw(unit_quaternions()))
    angle = draw(st.floats(0.0, largest_angle))
    return (*(angle * component for component in axis), *draw(VECTORS))
