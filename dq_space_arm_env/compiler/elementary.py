"""Sine, cosine and arctangent as straight-line vector arithmetic.

A call into the C math library would force the compiler out of its vector registers, once per lane. These
versions use only operations that exist as vector instructions, and compute the same bits in a scalar register
as in every lane of a vector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dq_space_arm_env.compiler.vector_builder import VectorBuilder


@dataclass(frozen=True)
class _Coefficients:
    """Coefficients by precision."""

    # pi/2 in three pieces (Cody & Waite). The first two are short: their products with an integer quotient
    # are exact up to 2^20 in double and 2^12 in single precision, so the reduced argument keeps its digits up
    # to angles of about 1e6 and 6e3 rad.
    half_pi: tuple[float, float, float]
    # Taylor coefficients in x^2; on [-pi/4, pi/4] the first neglected term is below half a unit in the last
    # place.
    sine: tuple[float, ...]
    cosine: tuple[float, ...]
    # Minimax coefficients on |x| < 7/16 (Sun fdlibm, s_atan.c and s_atanf.c): atan(x) = x - x^3 P(x^2).
    arctangent: tuple[float, ...]


def _sine_series(terms: int) -> tuple[float, ...]:
    return tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(1, terms + 1))


def _cosine_series(terms: int) -> tuple[float, ...]:
    return tuple((-1.0) ** k / math.factorial(2 * k) for k in range(1, terms + 1))


_COEFFICIENTS = {
    "float64": _Coefficients(
        half_pi=(
            float.fromhex("0x1.921fb544p+0"),
            float.fromhex("0x1.0b4611a6p-34"),
            float.fromhex("0x1.3198a2e037073p-69"),
        ),
        sine=_sine_series(8),
        cosine=_cosine_series(8),
        arctangent=(
            3.33333333333329318027e-01,
            -1.99999999998764832476e-01,
            1.42857142725034663711e-01,
            -1.11111104054623557880e-01,
            9.09088713343650656196e-02,
            -7.69187620504482999495e-02,
            6.66107313738753120669e-02,
            -5.83357013379057348645e-02,
            4.97687799461593236017e-02,
            -3.65315727442169155270e-02,
            1.62858201153657823623e-02,
        ),
    ),
    "float32": _Coefficients(
        half_pi=(float.fromhex("0x1.92p+0"), float.fromhex("0x1.fb4p-12"), float.fromhex("0x1.4442d2p-24")),
        sine=_sine_series(4),
        cosine=_cosine_series(5),
        arctangent=(
            3.3333328366e-01,
            -1.9999158382e-01,
            1.4253635705e-01,
            -1.0648017377e-01,
            6.1687607318e-02,
        ),
    ),
}


def _horner(builder: VectorBuilder, x: str, coefficients: tuple[float, ...]) -> str:
    """Evaluate coefficients[0] + x coefficients[1] + ... ."""
    result = builder.constant(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        result = builder.multiply_add(result, x, builder.constant(coefficient))
    return result


def sine_cosine(builder: VectorBuilder, x: str) -> tuple[str, str]:
    """Emit sine and cosine of x rad, to about one unit in the last place up to 1e6 (6e3 in float32)."""
    coefficients = _COEFFICIENTS[builder.target.precision]
    quotient = builder.round(builder.multiply(x, builder.constant(2.0 / math.pi)))
    reduced = x
    for piece in coefficients.half_pi:
        reduced = builder.multiply_add(quotient, builder.constant(-piece), reduced)
    square = builder.multiply(reduced, reduced)
    cube = builder.multiply(reduced, square)
    sine = builder.multiply_add(cube, _horner(builder, square, coefficients.sine), reduced)
    cosine = builder.multiply_add(
        square, _horner(builder, square, coefficients.cosine), builder.constant(1.0)
    )
    # The quotient modulo 4 names the quadrant: odd ones swap sine and cosine, the signs follow.
    quarter = builder.floor(builder.multiply(quotient, builder.constant(0.25)))
    quadrant = builder.multiply_add(quarter, builder.constant(-4.0), quotient)
    one, two, three = (builder.constant(c) for c in (1.0, 2.0, 3.0))
    is_one, is_two, is_three = (builder.compare("==", quadrant, c) for c in (one, two, three))
    odd = builder.either(is_one, is_three)
    swapped_sine = builder.select(odd, cosine, sine)
    swapped_cosine = builder.select(odd, sine, cosine)
    return (
        builder.negate_if(builder.either(is_two, is_three), swapped_sine),
        builder.negate_if(builder.either(is_one, is_two), swapped_cosine),
    )


def arctangent2(builder: VectorBuilder, y: str, x: str) -> str:
    """Emit the angle of the point (x, y) in (-pi, pi], to a few units in the last place; 0 at the origin."""
    zero = builder.constant(0.0)
    magnitude_y, magnitude_x = builder.absolute(y), builder.absolute(x)
    steep = builder.compare(">", magnitude_y, magnitude_x)
    numerator = builder.select(steep, magnitude_x, magnitude_y)
    denominator = builder.select(steep, magnitude_y, magnitude_x)
    # atan(n/d) = pi/4 + atan((n - d)/(n + d)) keeps the argument of the polynomial below 7/16.
    far = builder.compare(">", numerator, builder.multiply(denominator, builder.constant(0.4140625)))
    top = builder.select(far, builder.subtract(numerator, denominator), numerator)
    bottom = builder.select(far, builder.add(numerator, denominator), denominator)
    bottom = builder.select(builder.compare("==", bottom, zero), builder.constant(1.0), bottom)
    ratio = builder.divide(top, bottom)
    square = builder.multiply(ratio, ratio)
    polynomial = _horner(builder, square, _COEFFICIENTS[builder.target.precision].arctangent)
    angle = builder.multiply_add(builder.negate(builder.multiply(ratio, square)), polynomial, ratio)
    angle = builder.select(far, builder.add(angle, builder.constant(math.pi / 4)), angle)
    angle = builder.select(steep, builder.subtract(builder.constant(math.pi / 2), angle), angle)
    angle = builder.select(
        builder.compare("<", x, zero), builder.subtract(builder.constant(math.pi), angle), angle
    )
    return builder.negate_if(builder.compare("<", y, zero), angle)
