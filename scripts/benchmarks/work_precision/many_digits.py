"""Traced graphs and the torque-free rigid body in as many digits as mpmath is set to.

Euler's equations and the quaternion's kinematics are quadratic: the coefficients of their power series follow
one from another by products of series, and the solution is continued from expansion to expansion.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dq_space_arm_env.compiler.graph import Graph

try:
    import mpmath
except ModuleNotFoundError as error:
    raise ModuleNotFoundError('the references need mpmath: pip install "dq-space-arm[test]"') from error

Number = Any  # an mpmath number

_OPERATIONS: Mapping[str, Callable[..., Number]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "negate": operator.neg,
    "square": lambda a: a * a,
    "twice": lambda a: a + a,
    "invert": lambda a: 1 / a,
    "sqrt": mpmath.sqrt,
    "sin": mpmath.sin,
    "cos": mpmath.cos,
}


def evaluate(graph: Graph, *inputs: Sequence[Number]) -> list[list[Number]]:
    """Evaluate a graph without branches, of arithmetic, roots, sines and cosines, on scalars."""
    values: list[Number] = []
    for node in graph.nodes:
        if node.operation == "constant":
            values.append(mpmath.mpf(node.constant))
        elif node.operation == "input":
            values.append(mpmath.mpf(inputs[node.slot[0]][node.slot[1]]))
        else:
            values.append(_OPERATIONS[node.operation](*(values[index] for index in node.arguments)))
    return [[values[index] for index in indices] for indices in graph.results]


_TURN_PER_EXPANSION = 0.25  # rad; the series converge to about 1.5 rad
_GUARD_DIGITS = 10


def torque_free_motion(
    inertia: Sequence[float],
    angular_velocity: Sequence[float],
    rotation: Sequence[float],
    time: float,
    digits: int = 30,
) -> tuple[list[Number], list[Number]]:
    """Unit quaternion and angular velocity of a torque-free body after a time [s], from principal moments."""
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
