"""The torque-free rigid body in as many digits as wanted, by its power series.

Euler's equations and the quaternion's kinematics are quadratic, so the coefficients of their power series
follow one from another by products of series; the solution is continued from expansion to expansion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

try:
    import mpmath
except ModuleNotFoundError as error:
    raise ModuleNotFoundError('the references need mpmath: pip install "dq-space-arm[test]"') from error

Number = Any  # an mpmath number
_TURN_PER_EXPANSION = 0.25  # rad; the series converge to about 1.5 rad
_GUARD_DIGITS = 10


def torque_free_motion(
    inertia: Sequence[float],
    angular_velocity: Sequence[float],
    rotation: Sequence[float],
    time: float,
    digits: int = 30,
) -> tuple[list[Number], list[Number]]:
    """Turn a rigid body that no torque acts on.

    Args:
        inertia: Principal moments, 3, kg m^2.
        angular_velocity: At time 0 in principal axes, 3, rad/s.
        rotation: Unit quaternion of the body's attitude at time 0, scalar first, 4.
        time: How long, s.
        digits: Number of correct digits.

    Returns:
        Unit quaternion, 4 mpmath numbers, and angular velocity, 3, at that time.
    """
    with mpmath.workdps(digits + _GUARD_DIGITS):
        moments = [mpmath.mpf(moment) for moment in inertia]
        omega = [mpmath.mpf(rate) for rate in angular_velocity]
        q = [mpmath.mpf(entry) for entry in rotation]
        largest = max(moments) / min(moments) * mpmath.norm(omega)
        expansions = max(int(mpmath.ceil(largest * abs(time) / _TURN_PER_EXPANSION)), 1)
        step = mpmath.mpf(time) / expansions
        terms = int(1.3 * (digits + _GUARD_DIGITS))
        for _ in range(expansions):
            q, omega = _continued(moments, omega, q, step, terms)
        return q, omega


def _continued(
    moments: Sequence[Number], omega: Sequence[Number], q: Sequence[Number], step: Number, terms: int
) -> tuple[list[Number], list[Number]]:
    """Sum the power series around a state at a time step after it."""
    w = [[entry] for entry in omega]  # coefficients of each component
    r = [[entry] for entry in q]

    def product(a: list[Number], b: list[Number], order: int) -> Number:
        return mpmath.fdot(a[: order + 1], b[order::-1])

    for n in range(terms):
        # I_1 w_1' = (I_2 - I_3) w_2 w_3, and so on around
        change = [
            (moments[(i + 1) % 3] - moments[(i + 2) % 3])
            / moments[i]
            * product(w[(i + 1) % 3], w[(i + 2) % 3], n)
            for i in range(3)
        ]
        # q' = 1/2 q (0, omega)
        turned = [
            -product(r[1], w[0], n) - product(r[2], w[1], n) - product(r[3], w[2], n),
            product(r[0], w[0], n) + product(r[2], w[2], n) - product(r[3], w[1], n),
            product(r[0], w[1], n) + product(r[3], w[0], n) - product(r[1], w[2], n),
            product(r[0], w[2], n) + product(r[1], w[1], n) - product(r[2], w[0], n),
        ]
        for series, value in zip(w, change, strict=True):
            series.append(value / (n + 1))
        for series, value in zip(r, turned, strict=True):
            series.append(value / (2 * (n + 1)))
    powers = [step**n for n in range(terms + 1)]
    return [mpmath.fdot(series, powers) for series in r], [mpmath.fdot(series, powers) for series in w]
