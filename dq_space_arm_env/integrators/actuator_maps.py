"""A step of chains of actuators, exact: linear in what is on the way, k, and in the commands, u.

A first-order lag a' = (v - a) / T follows a command v, constant over a step h, to

    a+ = e a + (1 - e) v,  e = exp(-h / T),  and drives the motion by its mean  v + (a - v) (1 - e) T / h,

bounded for any h / T; where T goes to zero both are v, those of an ideal actuator. A delay of d steps holds d
commands back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from dq_space_arm_env.algebra.symbolic import dense_entries
from dq_space_arm_env.scene.actuator_chains import Chain

Matrix = Any
Scalar = Any


@dataclass(frozen=True)
class ActuatorMaps:
    """The maps w = P k + Q u, which the motion sees, and k+ = F k + G u, sparse SX."""

    p: Matrix
    q: Matrix
    f: Matrix
    g: Matrix

    @classmethod
    def of(cls, chains: Sequence[Chain], n_u: int, h: Scalar) -> ActuatorMaps:
        """Maps of a step of h seconds."""
        n_k = sum(len(chain.names) for chain in chains)
        # Rows of v, what an actuator follows, by (k, u).
        p, q = casadi.SX(n_u, n_k), casadi.SX.eye(n_u)
        f, g, first = casadi.SX(n_k, n_k), casadi.SX(n_k, n_u), 0
        for chain in chains:
            i, last = chain.control, first + chain.delay
            if chain.delay:
                q[i, i], p[i, first] = 0.0, 1.0
                for place in range(first, last - 1):
                    f[place, place + 1] = 1.0
                g[last - 1, i] = 1.0
            if chain.time_constant is not None:
                x = h * (1.0 / chain.time_constant)
                e, missed = casadi.exp(-x), -casadi.expm1(-x)  # e and 1 - e
                share = missed / x
                f[last, :], g[last, :] = missed * p[i, :], missed * q[i, :]
                f[last, last] = e
                p[i, :], q[i, :] = (1.0 - share) * p[i, :], (1.0 - share) * q[i, :]
                p[i, last] = share
            first += len(chain.names)
        return cls(*(casadi.sparsify(each) for each in (p, q, f, g)))

    def applied(self, left: Matrix, right: Matrix, k: Matrix, u: Matrix) -> list[Scalar]:
        """A map by (k, u) of their values."""
        return dense_entries(casadi.mtimes(left, k) + casadi.mtimes(right, u))
