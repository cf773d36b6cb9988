"""What a Runge-Kutta-Munthe-Kaas step is made of: the tableau, the twists of its stages, and Omega."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra.dual_vectors import cross as dual_cross
from dq_space_arm_env.compiler.symbols import symbols
from dq_space_arm_env.integrators.field import PoseCoordinates, VectorField

Scalar = Any

# Butcher tableau: stage i starts at y + OFFSETS[i] h k_{i-1}; the step is h sum WEIGHTS[i] k_i.
OFFSETS = (0.0, 0.5, 0.5, 1.0)
WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def advance(y: Sequence[Scalar], stages: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """Y + h (k1 + 2 k2 + 2 k3 + k4) / 6."""
    sixth = h * (1 / 6)
    return [
        entry + sixth * (k1 + 2.0 * (k2 + k3) + k4) for entry, k1, k2, k3, k4 in zip(y, *stages, strict=True)
    ]


def stage_twists(
    pose: PoseCoordinates, y: Sequence[Scalar], stages: Sequence[Sequence[Scalar]], h: Scalar
) -> list[list[Scalar]]:
    """Free entries of the base twist at the four stages."""
    twists = [[y[i] for i in pose.twist_indices]]
    for offset, k in zip(OFFSETS[1:], stages, strict=False):
        twists.append([y[i] + offset * h * k[i] for i in pose.twist_indices])
    return twists


def pose_increment(pose: PoseCoordinates, twists: Sequence[Sequence[Scalar]], h: Scalar) -> list[Scalar]:
    """Omega after one step, 6 numbers; stage i starts from Omega_i = OFFSETS[i] h w_{i-1}."""
    slopes: list[Sequence[Scalar]] = []
    for offset, free in zip(OFFSETS, twists, strict=True):
        omega = pose.full_twist(free)
        slopes.append(stage_slope([offset * h * entry for entry in slopes[-1]], omega) if slopes else omega)
    return advance([0.0] * 6, slopes, h)


def stage_slope(start: Sequence[Scalar], omega: Sequence[Scalar]) -> list[Scalar]:
    """Omega' = dexp^-1(omega) at Omega = start, 6 numbers.

    The series may stop after the second commutator without losing order 4. For twists the commutator is the
    dual cross product.
    """
    once = dual_cross(start, omega)
    twice = dual_cross(start, once)
    return [w + 0.5 * a + (1 / 12) * b for w, a, b in zip(omega, once, twice, strict=True)]


def stage_pattern(field: VectorField) -> Any:
    """Sparsity that the derivative of any stage's rates with respect to (y, u) stays within."""
    y = symbols("y", field.n_y)
    u = symbols("u", field.n_u)
    _, by_y, by_u = field.linearized_rates(y, u)
    direct = casadi.horzcat(by_y.sparsity(), by_u.sparsity())
    identity = casadi.horzcat(casadi.Sparsity.diag(field.n_y), casadi.Sparsity(field.n_y, field.n_u))
    pattern = direct
    while True:
        product = casadi.mtimes(casadi.DM(by_y.sparsity(), 1), casadi.DM(pattern.unite(identity), 1))
        grown = direct.unite(casadi.sparsify(product).sparsity())
        if grown == pattern:
            return pattern
        pattern = grown
