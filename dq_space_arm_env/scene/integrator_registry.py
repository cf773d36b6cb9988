"""The registry of integrators, one entry per method: read by the schema, kernels, solver, reports and docs.

It is data only, so that a scene can be validated without loading the methods themselves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isinf
from typing import Any


@dataclass(frozen=True)
class IntegratorEntry:
    """A method, what it claims, and where it is implemented."""

    name: str  # in scene files
    order: int
    # The class in `dq_space_arm_env.integrators`, and what it is built from, as module.name.
    implementation: tuple[str, ...]
    # Largest dt * frequency of an undamped spring, and dt * decay rate of a damper, at which steps stay
    # bounded: where the stability polynomial leaves the unit circle on the imaginary and on the negative real
    # axis. Infinite for an A-stable method, and for one that adapts its steps.
    imaginary_interval: float = inf
    real_interval: float = inf
    # The method whose second derivatives the solver takes; None: Gauss-Newton. Newton's method needs a few
    # digits of them: those of methods of order 4 and above differ by O(dt^5). Gradients, which decide where
    # the solver ends, are always the method's own.
    curvature: str | None = None
    tolerances: tuple[str, ...] = ()  # keys of `simulation`, by which it divides a time step
    # With an embedded method, by whose estimate the environment divides time steps.
    is_embedded: bool = False
    keeps_momentum: bool = False  # to rounding, where no external wrench acts
    # Whether a step is a canonical map where nothing dissipates: the energy does not drift. Such a method is
    # not L-stable: motion in a very stiff damper alternates, and dies slowly.
    symplectic: bool = False
    # Whether angles may have other rates than those of the joints, as the quaternions of spherical joints do.
    turns_quaternions: bool = False

    @property
    def is_adaptive(self) -> bool:
        """Whether the method divides a time step until its tolerances are met."""
        return bool(self.tolerances)

    @property
    def uses(self) -> tuple[str, ...]:
        """Keys of `simulation` that have a use with the method."""
        return ("tolerance",) if self.is_embedded else self.tolerances

    def within(self, tolerance: float) -> dict[str, float]:
        """Keys of `simulation` for a tolerance; an absolute one beside a relative one is its hundredth."""
        return {key: 0.01 * tolerance if key == "atol" else tolerance for key in self.tolerances}

    @property
    def iterates(self) -> bool:
        """Whether a step repeats passes until they converge, fewer in a shorter one: an implicit method."""
        return self.is_stiff and not self.is_adaptive

    def takes(self, scene: Any) -> bool:
        """Whether the method integrates a scene's robot: spherical joints and burnt propellant limit it."""
        spherical = any(link.is_spherical for link in scene.links)
        burns = scene.actuators.tank is not None
        return (self.turns_quaternions or not spherical) and not (burns and self.keeps_momentum)

    @property
    def is_stiff(self) -> bool:
        """Whether any stiffness and damping is bounded."""
        return isinf(self.imaginary_interval) and isinf(self.real_interval)


INTEGRATORS: Mapping[str, IntegratorEntry] = {
    entry.name: entry
    for entry in (
        IntegratorEntry(
            "symplectic_euler",
            order=1,
            implementation=("symplectic_euler.SymplecticEuler",),
            imaginary_interval=2.0,
            real_interval=2.0,
            curvature="symplectic_euler",
        ),
        IntegratorEntry(
            "rk4",
            order=4,
            implementation=("rk4.RungeKuttaMuntheKaas4",),
            imaginary_interval=2.828,
            real_interval=2.785,
            curvature="rk4",
            is_embedded=True,
            turns_quaternions=True,
        ),
        IntegratorEntry(
            "rk6",
            order=6,
            implementation=("explicit_runge_kutta.ExplicitRungeKutta", "tableaus.CALVO_6"),
            imaginary_interval=2.609,
            real_interval=4.463,
            curvature="rk4",
            is_embedded=True,
            turns_quaternions=True,
        ),
        IntegratorEntry(
            "rk8",
            order=8,
            implementation=("explicit_runge_kutta.ExplicitRungeKutta", "tableaus.DORMAND_PRINCE_8"),
            imaginary_interval=5.960,
            real_interval=6.393,
            curvature="rk4",
            is_embedded=True,
            turns_quaternions=True,
        ),
        IntegratorEntry(
            "dormand_prince",
            order=5,
            implementation=("dormand_prince.DormandPrince",),
            tolerances=("rtol", "atol"),
            turns_quaternions=True,
        ),
        IntegratorEntry(
            "rodas4",
            order=4,
            implementation=("rosenbrock.Rosenbrock", "rosenbrock_tableaus.RODAS4"),
            tolerances=("tolerance",),
            keeps_momentum=True,
        ),
        IntegratorEntry(
            "rodas5p",
            order=5,
            implementation=("rosenbrock.Rosenbrock", "rosenbrock_tableaus.RODAS5P"),
            tolerances=("tolerance",),
            keeps_momentum=True,
        ),
        IntegratorEntry(
            "gauss6",
            order=6,
            implementation=("gauss.Gauss", "gauss.GAUSS_6"),
            keeps_momentum=True,
            symplectic=True,
        ),
        IntegratorEntry(
            "momentum_rk4",
            order=4,
            implementation=("momentum.MomentumPreserving", "rk4.RungeKuttaMuntheKaas4"),
            imaginary_interval=2.828,
            real_interval=2.785,
            curvature="rk4",
            is_embedded=True,
            keeps_momentum=True,
        ),
    )
}
