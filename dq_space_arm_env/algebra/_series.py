"""Coefficients of the exponential and the logarithm that a formula as written would divide by zero for.

Each is a smooth function of a squared angle. Near zero it is evaluated by its power series, elsewhere in
closed form, and `select` picks; the closed form is fed a harmless argument where it is not picked.
"""

import math

from dq_space_arm_env.algebra._types import Scalar
from dq_space_arm_env.algebra.scalars import arctan2, cos, select, sin, sqrt

# Below this squared angle (1 rad) the series is used. There its first omitted term is below 1e-17 of the
# first, and the cancellation in the closed forms has cost at most 2 digits, those of c5, which weighs least.
_SERIES_BELOW = 1.0
_C4_SERIES = tuple((-1.0) ** j / math.factorial(2 * j + 4) for j in reversed(range(8)))
_C5_SERIES = tuple((-1.0) ** j / math.factorial(2 * j + 5) for j in reversed(range(8)))

# b(z) = 1/3 - z/5 + z^2/7 - ..., so that arctan(x) / x = 1 - x^2 b(x^2). Below x = 1/8 its first omitted term
# is below 1e-17 of the first.
_ARCTAN_SERIES_BELOW = 1.0 / 64.0
_ARCTAN_SERIES = tuple((-1.0) ** j / (2 * j + 3) for j in reversed(range(9)))


def _polynomial(x: Scalar, coefficients: tuple[float, ...]) -> Scalar:
    """Return the polynomial with the given coefficients, the highest power first, by Horner's rule."""
    value: Scalar = coefficients[0]
    for coefficient in coefficients[1:]:
        value = coefficient + x * value
    return value


def stumpff(s: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Return the Stumpff functions c_k(s) = sum_j (-s)^j / (2 j + k)!, k = 0..5: () -> (6,).

    With t = sqrt(s) they are c0 = cos t, c1 = sin t / t, c2 = (1 - cos t) / t^2, c3 = (t - sin t) / t^3, c4 =
    (1/2 - c2) / t^2, c5 = (1/6 - c3) / t^2. Their derivatives are dc_k/ds = (k c_{k+2} - c_{k+1}) / 2.
    """
    is_small = s < _SERIES_BELOW

    x = select(is_small, s, 0.0)
    small4 = _polynomial(x, _C4_SERIES)
    small5 = _polynomial(x, _C5_SERIES)
    small2 = 0.5 - x * small4
    small3 = 1.0 / 6.0 - x * small5
    small0 = 1.0 - x * small2
    small1 = 1.0 - x * small3

    y = select(is_small, 1.0, s)
    t = sqrt(y)
    large0 = cos(t)
    large1 = sin(t) / t
    large2 = (1.0 - large0) / y
    large3 = (1.0 - large1) / y
    large4 = (0.5 - large2) / y
    large5 = (1.0 / 6.0 - large3) / y

    return (
        select(is_small, small0, large0),
        select(is_small, small1, large1),
        select(is_small, small2, large2),
        select(is_small, small3, large3),
        select(is_small, small4, large4),
        select(is_small, small5, large5),
    )


def logarithm_coefficients(cosine: Scalar, sine_squared: Scalar) -> tuple[Scalar, Scalar]:
    """Return h / sin h and (sin h - h cos h) / sin^3 h for an angle h in [0, pi/2]: (), () -> (2,)."""
    is_small = sine_squared < _ARCTAN_SERIES_BELOW * cosine * cosine

    small_cosine = select(is_small, cosine, 1.0)
    x_squared = select(is_small, sine_squared, 0.0) / (small_cosine * small_cosine)
    b = _polynomial(x_squared, _ARCTAN_SERIES)
    small_first = (1.0 - x_squared * b) / small_cosine
    small_second = b / (small_cosine * small_cosine)

    large_sine_squared = select(is_small, 1.0, sine_squared)
    sine = sqrt(large_sine_squared)
    large_first = arctan2(sine, select(is_small, 1.0, cosine)) / sine
    large_second = (1.0 - large_first * cosine) / large_sine_squared

    return select(is_small, small_first, large_first), select(is_small, small_second, large_second)
