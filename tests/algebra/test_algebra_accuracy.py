"""Rounding errors of the algebra against mpmath with 50 digits, at and around every hard point.

The references are power series of the algebra itself, exp X = sum X^n / n!, in which nothing divides by zero
and 50 digits outlast every cancellation. An error is counted in units of 2^-52 of the size of the result.
"""

import itertools
import math

import mpmath
import numpy as np
import pytest

from dq_space_arm_env.algebra import _series, dual_quaternion, poses, quaternion, rotations, screw, vectors

EPSILON = 2.0**-52
DIGITS = 50

# Half angles at which a formula changes, angles at which a formula may fail, and what lies next to them.
TINY = [1e-307, 1e-300, 1e-200, 1e-160, 1e-154, 1e-100, 1e-20, 1e-16, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2, 0.1]
CRITICAL = [2.0 * math.atan(0.125), 1.0, 2.0, math.pi, 2.0 * math.pi]
NEIGHBORS = [0.0, 4e-16, 1e-12, 1e-8, 1e-4]
ANGLES = sorted(
    {*TINY, 0.5, 1.5, 2.5, 3.0, *(c + side * d for c in CRITICAL for d in NEIGHBORS for side in (-1.0, 1.0))}
)
SHORT_ANGLES = [angle for angle in ANGLES if angle <= math.pi]
DIRECTIONS = [(1.0, 0.0, 0.0), (0.0, -0.8, 0.6), (0.48, 0.6, -0.64)]  # each has another largest component
TRANSLATIONS = [
    (0.0, 0.0, 0.0),
    (1e-300, 2e-300, 0.0),
    (1e-9, -2e-9, 3e-9),
    (1.0, -2.0, 0.5),
    (3e9, 1e9, -2e9),
]


@pytest.fixture(autouse=True)
def _digits():
    with mpmath.workdps(DIGITS):
        yield


def exact(values):
    """Return floats as mpmath numbers."""
    return tuple(mpmath.mpf(float(value)) for value in values)


def length(values):
    return mpmath.sqrt(mpmath.fsum(value * value for value in values))


def error(actual, expected, size):
    """Return the distance of two tuples, in units of 2^-52 of `size`."""
    return float(length([a - e for a, e in zip(actual, expected, strict=True)]) / size / EPSILON)


def terms_needed(angle):
    """Return n such that |angle|^n / n! is beyond the digits of the reference."""
    return next(n for n in range(1, 100) if angle**n / mpmath.factorial(n) < mpmath.mpf(10) ** -DIGITS)


def exact_exponential(twist):
    """Return exp(1/2 xi) by its power series."""
    half = dual_quaternion.from_vector([component / 2 for component in exact(twist)])
    term = total = exact(dual_quaternion.IDENTITY)
    for n in range(1, 2 + terms_needed(length(half[:4]))):
        term = dual_quaternion.scale(mpmath.mpf(1) / n, dual_quaternion.multiply(term, half))
        total = dual_quaternion.add(total, term)
    return total


def exact_right_jacobian(twist):
    """Return the blocks J and Q of sum (-ad)^n / (n + 1)! = [[J, 0], [Q, J]], arrays of mpmath numbers."""
    w, v = (np.array(vectors.skew_matrix(exact(part))) for part in (twist[:3], twist[3:]))
    real_term = real = np.full((3, 3), mpmath.mpf(0)) + np.eye(3, dtype=int)
    dual_term = dual = np.full((3, 3), mpmath.mpf(0))
    for n in range(1, 2 + terms_needed(length(exact(twist[:3])))):
        real_term, dual_term = -real_term @ w / (n + 1), -(dual_term @ w + real_term @ v) / (n + 1)
        real, dual = real + real_term, dual + dual_term
    return real, dual


def twists(angles, translations=TRANSLATIONS):
    for angle, direction, translation in itertools.product(angles, DIRECTIONS, translations):
        yield (*(angle * component for component in direction), *translation)


def test_stumpff_functions():
    """c0 and c1 to 2 units in the last place, c2 and c3 to 5; c4 and c5, which weigh less, to 100."""
    bounds = [2.0, 2.0, 4.0, 5.0, 25.0, 100.0]
    generator = np.random.default_rng(5)
    samples = [*np.logspace(-320, 0, 30), *generator.uniform(0.0, 12.0, 200), 1.0, 1.0 - 1e-16, 1.0 + 4e-16]
    for s in samples:
        for k, value in enumerate(_series.stumpff(float(s))):
            series = mpmath.nsum(
                lambda j, k=k, s=s: (-mpmath.mpf(s)) ** int(j) / mpmath.factorial(2 * j + k), [0, 40]
            )
            size = 1.0 if k < 2 else abs(series)
            assert error([value], [series], size) <= bounds[k], (k, s)


@pytest.mark.slow
def test_exponential():
    """Real and dual part to 4 units; of small angles, the vector part relative to itself."""
    for twist in twists(ANGLES):
        q, expected = screw.exponential(twist), exact_exponential(twist)
        assert error(q[:4], expected[:4], 1.0) <= 3.0, twist
        if length(exact(twist[:3])) < 3.0:
            assert error(q[1:4], expected[1:4], length(expected[1:4])) <= 3.0, twist
        if any(twist[3:]):
            assert error(q[4:], expected[4:], length(exact(twist[3:])) / 2) <= 4.0, twist


def test_exponential_minus_identity():
    """The scalar to 4 units of itself, however close cos to 1; the rest is that of the exponential."""
    for twist in twists(ANGLES):
        q = screw.exponential_minus_identity(twist)
        assert q[1:] == screw.exponential(twist)[1:], twist
        if any(twist[:3]):
            scalar = -2 * mpmath.sin(length(exact(twist[:3])) / 4) ** 2
            size = max(abs(scalar), mpmath.mpf(10) ** -300)  # below, doubles have fewer digits
            assert error(q[:1], [scalar], size) <= 4.0, twist
        else:
            assert q[0] == 0.0


@pytest.mark.slow
def test_logarithm():
    """Rotation and translation each relative to itself, from 1e-307 rad up to and including pi."""
    for twist in twists(SHORT_ANGLES):
        q = tuple(float(component) for component in exact_exponential(twist))
        result = screw.logarithm(q)
        assert error(result[:3], exact(twist[:3]), length(exact(twist[:3]))) <= 4.0, twist
        if max(map(abs, twist[3:])) > 1e-290:
            assert error(result[3:], exact(twist[3:]), length(exact(twist[3:]))) <= 4.0, twist
        assert screw.logarithm(dual_quaternion.scale(-1.0, q)) == result


def test_subnormal_rotations():
    """Where floats lose digits to underflow, the errors are a few of the smallest float."""
    for size in (5e-324, 1e-320, 1e-310):
        twist = (size, -3.0 * size, 0.0, 1.0, 2.0, 3.0)
        back = screw.logarithm(screw.exponential(twist))
        np.testing.assert_allclose(back[:3], twist[:3], rtol=0.0, atol=2e-323)
        assert back[3:] == twist[3:]


def test_beyond_half_a_turn():
    """Of exp(xi), pi < |xi_r| < 2 pi, the logarithm is the rotation the other way round."""
    for angle in (math.pi + 1e-9, 4.0, 2.0 * math.pi - 1e-6):
        twist = screw.logarithm(screw.exponential((0.0, 0.6 * angle, 0.8 * angle, 0.0, 0.6, 0.8)))
        expected = np.multiply(angle - 2.0 * math.pi, (0.0, 0.6, 0.8))
        np.testing.assert_allclose(twist[:3], expected, rtol=0.0, atol=8.0 * EPSILON)


@pytest.mark.slow
def test_right_jacobian():
    for twist in twists(ANGLES[::2], TRANSLATIONS[::2]):
        actual, (real, dual) = screw.exponential_right_jacobian(twist), exact_right_jacobian(twist)
        for row in range(3):
            assert error(actual[row][:3], real[row], 1.0) <= 4.0, twist
            assert error(actual[row + 3][:3], dual[row], length(exact(twist[3:])) or 1.0) <= 16.0, twist


def test_rotation_matrix_round_trip():
    """Shepperd's method from the exactly rounded matrix: 2 units, and half turns need no special case."""
    for twist in twists(SHORT_ANGLES):
        if any(twist[3:]):
            continue
        q = exact_exponential(twist)[:4]
        matrix = tuple(tuple(float(entry) for entry in row) for row in rotations.to_matrix(q))
        actual = rotations.from_matrix(matrix)
        assert error(actual, quaternion.canonical(q), 1.0) <= 2.0, twist


def test_axis_angle():
    """Angle and axis relative to themselves, from 1e-307 rad to pi."""
    for angle in SHORT_ANGLES:
        for direction in DIRECTIONS:
            v = exact([angle * component for component in direction])
            q = tuple(map(float, exact_exponential((*map(float, v), 0.0, 0.0, 0.0))[:4]))
            axis, measured = rotations.to_axis_angle(q)
            assert error([measured], [length(v)], length(v)) <= 4.0, v
            assert error(axis, [component / length(v) for component in v], 1.0) <= 4.0, v


def test_positions_far_away():
    """A position keeps its digits whatever its size."""
    for twist in twists([0.3, 2.0, math.pi]):
        rotation = rotations.exponential(twist[:3])
        position = twist[3:]
        back = poses.position(poses.from_rotation_and_position(rotation, position))
        if max(map(abs, position)) > 1e-290:
            assert error(back, exact(position), length(exact(position))) <= 4.0, twist


def test_normalize():
    generator = np.random.default_rng(6)
    for a in generator.normal(size=(50, 8)):
        b = exact(a)
        real, dual = b[:4], b[4:]
        norm = length(real)
        along = mpmath.fsum(r * d for r, d in zip(real, dual, strict=True)) / norm**3
        expected = [r / norm for r in real]
        expected += [d / norm - along * r for r, d in zip(real, dual, strict=True)]
        assert error(dual_quaternion.normalize(a), expected, length(dual) / norm + 1.0) <= 4.0
