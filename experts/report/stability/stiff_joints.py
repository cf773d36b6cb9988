"""Stiff springs and dampers in a joint, for every integrator.

The joint swings about its spring, or comes to rest in its damper, from a deflection so small that the motion
is linear. What a method makes of it depends on a single number: the time step times the frequency of the
spring, or the rate of the damper. Explicit methods are bounded below a limit of theirs and must blow up
beyond; the limit that each claims is in `CLAIMS`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.scene import INTEGRATORS
from experts.report.stability.rows import Case, Effort, Handled, NotClaimed, Outcome
from experts.report.stability.scenes import sprung_inertia, sprung_joint, walk

GROUP = "stiff joints"

CLAIMS = {"symplectic_euler": 1.9, "rk4": 2.7, "momentum_rk4": 2.7}
"""Largest dt times frequency at which a method claims a bounded energy, s * rad/s.

Theory gives 2 for symplectic Euler, 2.83 for RK4.
"""
OTHERS_CLAIM = 1.0
"""What every other method claims at least."""
STIFF_METHODS = ("rodas", "rosenbrock")
"""Parts of the names of methods that claim any dt times frequency."""
DAMPED_CLAIM = 1.9
"""Largest dt times rate of decay at which every method claims that a damper brings the joint to rest."""

PRODUCTS = (0.01, 0.03, 0.1, 0.3, 1.0, 1.9, 2.7, 3.0, 10.0, 30.0, 100.0)
"""dt times frequency of the curve."""
STEPS = 2000
DEFLECTION = 1e-4  # rad
BOUNDED = 1.0
"""Largest energy of the second half of the steps relative to that of the first half, less 1.

The energy may swing within that: near its limit, that of symplectic Euler does so by a factor of 20.
"""
LARGEST_CHANGE = 1e6
"""Larger changes of the energy count as this one: the motion has blown up."""
CURVE_STIFFNESS = 1e5  # N m/rad
DAMPINGS = (1e2, 1e4, 1e6)  # N m s/rad


def is_stiff_method(integrator: str) -> bool:
    """Whether a method claims to be stable however stiff the joint.

    Args:
        integrator: Its name.

    Returns:
        The answer.
    """
    return any(part in integrator for part in STIFF_METHODS)


def claim(integrator: str) -> float:
    """Largest dt times frequency at which a method claims a bounded energy.

    Args:
        integrator: Its name.

    Returns:
        The product, dimensionless.
    """
    return np.inf if is_stiff_method(integrator) else CLAIMS.get(integrator, OTHERS_CLAIM)


def cases() -> Iterator[Case]:
    """All cases of the group."""
    half = STEPS // 2
    criterion = f"largest energy of the last {half} of {STEPS} steps at most twice that before"
    for name in INTEGRATORS:
        limit = claim(name)
        within = "100" if np.isinf(limit) else f"{limit:g}, its limit"
        yield Case(
            GROUP,
            "joint springs 1e2 to 1e8 N m/rad",
            name,
            f"{criterion}; dt times frequency = {within}",
            partial(_springs, name),
            BOUNDED,
            "of the energy",
        )
        yield Case(
            GROUP,
            "dt times frequency from 0.01 to 100",
            name,
            f"{criterion}, where claimed",
            partial(_products, name),
            BOUNDED,
            "of the energy",
        )
        yield Case(
            GROUP,
            "dampers 1e2 to 1e6 N m s/rad",
            name,
            f"the joint comes to rest at dt times decay = {100 if is_stiff_method(name) else DAMPED_CLAIM:g}",
            partial(_dampers, name),
            1e-6,
            "of the rate",
        )


@cache
def _sprung(stiffness: float, damping: float) -> tuple[Kernels, float]:
    """Kernels of a sprung joint, and the inertia that it turns."""
    scene = sprung_joint(stiffness, damping)
    return compile_scene(scene), sprung_inertia(scene)


class Energy(NamedTuple):
    """The energy of a joint that swings on its spring.

    Attributes:
        growth: Largest one of the second half of the steps relative to that of the first half, less 1;
            infinite where the motion overflows.
        change: Largest difference from the first, relative to it, at most `LARGEST_CHANGE`.
    """

    growth: float
    change: float


def swing(integrator: str, stiffness: float, product: float) -> Energy:
    """Let a joint swing.

    Args:
        integrator: Name of the method.
        stiffness: Of the spring, N m/rad.
        product: dt times frequency, dimensionless.

    Returns:
        What becomes of its energy.
    """
    kernels, inertia = _sprung(stiffness, 0.0)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_angles] = DEFLECTION
    dt = product / float(np.sqrt(stiffness / inertia))
    states = walk(kernels, x, np.zeros((STEPS, kernels.n_u)), dt, integrator)
    with np.errstate(all="ignore"):
        energies = np.asarray(kernels.energy(states)) / kernels.energy(x)
        if not np.isfinite(energies).all():
            return Energy(np.inf, LARGEST_CHANGE)
        early, late = energies[: STEPS // 2].max(), energies[STEPS // 2 :].max()
    change = float(np.abs(energies - 1.0).max())
    return Energy(float(late / early) - 1.0, min(change, LARGEST_CHANGE))


def _springs(integrator: str, effort: Effort) -> Outcome:
    product = min(claim(integrator), 100.0)
    found = [(k, swing(integrator, k, product)) for k in effort.stiffness]
    worst, energy = max(found, key=lambda point: point[1].growth)
    return Handled(
        max(energy.growth, 0.0), f"most at {worst:g} N m/rad; energy changes by {energy.change:.1e}"
    )


def _products(integrator: str, effort: Effort) -> Outcome:
    found = [(product, swing(integrator, CURVE_STIFFNESS, product)) for product in PRODUCTS]
    limit = claim(integrator)
    worst = max(energy.growth for product, energy in found if product <= limit)
    curve = tuple((product, energy.change) for product, energy in found)
    lost = [product for product, energy in found if not energy.growth <= BOUNDED]
    if worst > BOUNDED or not lost:
        return Handled(max(worst, 0.0), "" if lost else "bounded up to 100", curve)
    largest = max(product for product in PRODUCTS if product < min(lost))
    return NotClaimed(
        f"bounded up to {largest:g}, as claimed up to {limit:g}; the motion grows without bound from "
        f"{min(lost):g} on",
        curve,
    )


def _dampers(integrator: str, effort: Effort) -> Outcome:
    product = 100.0 if is_stiff_method(integrator) else DAMPED_CLAIM
    left = []
    for damping in DAMPINGS:
        kernels, inertia = _sprung(0.0, damping)
        x = kernels.layout.initial_state.copy()
        x[kernels.layout.state.joint_rates] = 1e-3
        dt = product * inertia / damping
        final = walk(kernels, x, np.zeros((STEPS, kernels.n_u)), dt, integrator)[-1]
        left.append(abs(float(final[kernels.layout.state.joint_rates][0])) / 1e-3)
    return Handled(max(left) if np.isfinite(left).all() else np.inf)
