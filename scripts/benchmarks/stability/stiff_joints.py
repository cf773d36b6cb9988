"""Stiff springs and dampers in a joint, for every integrator.

The joint swings about its spring, or comes to rest in its damper, from a deflection so small that the motion
is linear. The result depends on a single number: the time step times the frequency of the spring, or the rate
of the damper. Explicit methods are bounded up to their limit and must blow up beyond it. The limits stand in
the registry of integrators; tests derive them from the stability polynomials of the tableaus.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome
from scripts.benchmarks.stability.scenes import applied, sprung_inertia, sprung_joint, walk

GROUP = "stiff joints"

STIFF_METHODS = tuple(name for name, entry in INTEGRATORS.items() if entry.is_stiff)
"""Methods that claim any dt times frequency."""
WITHIN, BEYOND = 0.99, 1.02  # shares of a limit at which a method must be stable, and at which it must not be
STIFFEST = 100.0  # product that is tried with methods that have no limit

PRODUCTS = (0.01, 0.03, 0.1, 0.3, 1.0, 1.9, 2.5, 2.7, 3.0, 5.8, 10.0, 30.0, 100.0)
"""dt times frequency of the curve."""
STEPS = 2000
DEFLECTION = 1e-4  # rad
RATE = 1e-3  # rad/s
BOUNDED = 1.0
"""Largest energy of the second half of the steps relative to that of the first half, less 1.

The energy may swing within that: near its limit, that of symplectic Euler does so by a factor of 100.
"""
AT_REST, AT_REST_SINGLE = 1e-6, 1e-3
"""Largest rate in a damper after all steps, relative to the first, by precision.

In single precision, methods that adapt their steps have an absolute tolerance of 1e-6 rad/s.
"""
LARGEST_CHANGE = 1e6
"""A larger change of the energy counts as this one: the motion has blown up, even if it stays finite."""
CURVE_STIFFNESS = 1e5  # N m/rad
DAMPINGS = (1e2, 1e4, 1e6)  # N m s/rad
TIME_STEP = 0.015  # s
_ARM_STIFFNESS = 1e8  # N m/rad
_ARM_ENERGY = 1e-2  # of the energy


def cases() -> Iterator[Case]:
    half = STEPS // 2
    springs, dampers = "joint springs 1e2 to 1e8 N m/rad", "dampers 1e2 to 1e6 N m s/rad"
    bounded = f"largest energy of the last {half} of {STEPS} steps at most twice that before"

    def energy(name: str, integrator: str, criterion: str, run: Callable[[Effort], Outcome]) -> Case:
        return Case(GROUP, name, integrator, f"{bounded}; {criterion}", run, BOUNDED, "of the energy")

    def rate(
        name: str, integrator: str, criterion: str, run: Callable[[Effort], Outcome], bound: float = AT_REST
    ) -> Case:
        rests = f"rate after {STEPS} steps below {bound:g} of the first"
        return Case(GROUP, name, integrator, f"{rests}; {criterion}", run, bound, "of the rate")

    for name, entry in INTEGRATORS.items():
        frequency = "dt times frequency = " + _product_in_words(entry.imaginary_interval)
        decay = "dt times decay = " + _product_in_words(entry.real_interval)
        yield energy(springs, name, frequency, partial(_springs, name))
        yield energy(f"{springs}, dt = 15 ms", name, "where claimed", partial(_springs_at_15_ms, name))
        products = "dt times frequency from 0.01 to 100"
        yield energy(products, name, "where claimed", partial(_products, name))
        yield rate(dampers, name, decay, partial(_dampers, name))
        yield rate(f"{dampers}, dt = 15 ms", name, "where claimed", partial(_dampers_at_15_ms, name))
        if not entry.is_stiff:
            yield energy("springs beyond the limit", name, "not claimed", partial(_spring_beyond, name))
            yield rate("dampers beyond the limit", name, "not claimed", partial(_damper_beyond, name))
        single = applied(name, "float32")
        yield energy(springs, single, frequency, partial(_springs, name, precision="float32"))
        yield rate(dampers, single, decay, partial(_dampers, name, precision="float32"), AT_REST_SINGLE)
    for name in STIFF_METHODS:
        criterion = f"energy of the free arm kept to {_ARM_ENERGY:g} over {STEPS} steps"
        run = partial(_stiff_arm, name)
        title = "arm with a joint at dt times frequency = 100"
        yield Case(GROUP, title, name, criterion, run, _ARM_ENERGY, "of the energy")


def _product_in_words(limit: float) -> str:
    return f"{STIFFEST:g}" if np.isinf(limit) else f"{WITHIN * limit:.3g}, {WITHIN:g} of the limit"


@cache
def _sprung(precision: str = "float64") -> tuple[Kernels, float]:
    """Kernels of a sprung joint, stiffness and damping its parameters, and the inertia that it turns."""
    scene = sprung_joint(1.0, 1.0).replace(
        simulation={"precision": precision}, parameters=["links.0.stiffness", "links.0.damping"]
    )
    return compile_scene(scene), sprung_inertia(scene)


class Energy(NamedTuple):
    """The energy of a joint that swings on its spring."""

    growth: float
    change: float


def _frequency(stiffness: float) -> float:
    """Angular frequency of the sprung joint, rad/s."""
    return float(np.sqrt(stiffness / _sprung()[1]))


def swing(integrator: str, stiffness: float, product: float, precision: str = "float64") -> Energy:
    """Let a joint swing."""
    kernels, exact, p = _sprung(precision)[0], _sprung()[0], np.array([stiffness, 0.0])
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_angles] = DEFLECTION
    dt = product / _frequency(stiffness)
    states = walk(kernels, x, np.zeros((STEPS, kernels.n_u)), dt, integrator, p)
    with np.errstate(all="ignore"):
        energies = np.asarray(exact.energy(states, p=p)) / exact.energy(x, p=p)
        change = float(np.abs(energies - 1.0).max())
        if not change < LARGEST_CHANGE:
            return Energy(np.inf, LARGEST_CHANGE)
        early, late = energies[: STEPS // 2].max(), energies[STEPS // 2 :].max()
    return Energy(float(late / early) - 1.0, change)


def rate_left(integrator: str, damping: float, product: float, precision: str = "float64") -> float:
    """Let a joint come to rest in its damper."""
    kernels, inertia = _sprung(precision)
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_rates] = RATE
    dt, p = product * inertia / damping, np.array([0.0, damping])
    final = walk(kernels, x, np.zeros((STEPS, kernels.n_u)), dt, integrator, p)[-1]
    left = abs(float(final[kernels.layout.state.joint_rates][0])) / RATE
    return left if np.isfinite(left) else np.inf


def _springs(integrator: str, effort: Effort, precision: str = "float64") -> Outcome:
    product = min(WITHIN * INTEGRATORS[integrator].imaginary_interval, STIFFEST)
    found = [(k, swing(integrator, k, product, precision)) for k in effort.stiffness]
    worst, energy = max(found, key=lambda point: point[1].growth)
    return Handled(
        max(energy.growth, 0.0), f"most at {worst:g} N m/rad; energy changes by {energy.change:.1e}"
    )


def _dampers(integrator: str, effort: Effort, precision: str = "float64") -> Outcome:
    product = min(WITHIN * INTEGRATORS[integrator].real_interval, STIFFEST)
    return Handled(max(rate_left(integrator, damping, product, precision) for damping in DAMPINGS))


def _springs_at_15_ms(integrator: str, effort: Effort) -> Outcome:
    products = [TIME_STEP * _frequency(k) for k in effort.stiffness]
    found = [swing(integrator, k, p).growth for k, p in zip(effort.stiffness, products, strict=True)]
    limit = INTEGRATORS[integrator].imaginary_interval
    return _where_claimed("frequency", limit, effort.stiffness, products, found, BOUNDED)


def _dampers_at_15_ms(integrator: str, effort: Effort) -> Outcome:
    products = [TIME_STEP * damping / _sprung()[1] for damping in DAMPINGS]
    found = [rate_left(integrator, d, p) for d, p in zip(DAMPINGS, products, strict=True)]
    entry = INTEGRATORS[integrator]
    # A symplectic method is bounded beyond, but comes to rest slowly.
    limit = STIFFEST if entry.symplectic else entry.real_interval
    return _where_claimed("decay", limit, DAMPINGS, products, found, AT_REST)


def _where_claimed(
    quantity: str,
    limit: float,
    sizes: Sequence[float],
    products: Sequence[float],
    found: Sequence[float],
    bound: float,
) -> Outcome:
    """Judge springs or dampers of several sizes at one time step: within the claim, or not claimed."""
    claimed = [error for error, product in zip(found, products, strict=True) if product <= limit]
    worst = max((0.0, *claimed))
    if len(claimed) == len(sizes):
        return Handled(worst, f"dt times {quantity} from {products[0]:.2g} to {products[-1]:.2g}")
    softest = sizes[len(claimed)]
    sentence = (
        f"claimed up to dt times {quantity} = {limit:g}; it is {products[len(claimed)]:.2g} at "
        f"{softest:g}: take shorter steps or a stiff method"
    )
    return NotClaimed(sentence) if worst <= bound else Handled(worst, sentence)


def _products(integrator: str, effort: Effort) -> Outcome:
    found = [(product, swing(integrator, CURVE_STIFFNESS, product)) for product in PRODUCTS]
    limit = INTEGRATORS[integrator].imaginary_interval
    worst = max(energy.growth for product, energy in found if product <= limit)
    curve = tuple((product, energy.change) for product, energy in found)
    lost = [product for product, energy in found if not energy.growth <= BOUNDED]
    if worst > BOUNDED or not lost:
        largest, energy = max(found, key=lambda point: point[0])
        note = f"at {largest:g} the energy changes by {energy.change:.1e}, and never grows beyond its first"
        return Handled(max(worst, 0.0), "" if lost else note, curve)
    within = max(product for product in PRODUCTS if product < min(lost))
    return NotClaimed(
        f"bounded up to {within:g}, as claimed up to {limit:g}; the motion grows without bound from "
        f"{min(lost):g} on",
        curve,
    )


def _spring_beyond(integrator: str, effort: Effort) -> Outcome:
    limit = INTEGRATORS[integrator].imaginary_interval
    growth = swing(integrator, CURVE_STIFFNESS, BEYOND * limit).growth
    return _unbounded(growth > BOUNDED, f"dt times frequency = {limit:g}")


def _damper_beyond(integrator: str, effort: Effort) -> Outcome:
    limit = INTEGRATORS[integrator].real_interval
    left = rate_left(integrator, DAMPINGS[0], BEYOND * limit)
    return _unbounded(left > 1.0, f"dt times rate of decay = {limit:g}")


def _unbounded(grows: bool, limit: str) -> Outcome:
    """Check that the motion grows beyond a limit: bounded motion would mean that the limit is too low."""
    if grows:
        return NotClaimed(f"stable up to {limit}; {BEYOND - 1.0:.0%} beyond, the motion grows without bound")
    return Handled(np.inf, f"bounded beyond {limit}: the limit is wrong")


def stiff_arm(integrator: str, product: float) -> FloatArray:
    """Energy of a free arm that moves slowly, one of its joints on a stiff spring at rest."""
    scene = load_scene("free-floating")
    links = [link.model_dump() for link in scene.links]
    links[1] |= {"stiffness": _ARM_STIFFNESS, "rest_angle": scene.initial_state.joint_angles[1]}
    kernels = compile_scene(scene.replace(name="stiff joint", links=links))
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    still = np.zeros(kernels.n_u)
    x[where.joint_angles.start + 1] += DEFLECTION
    stiff = kernels.forward_dynamics(x, still)[-2]
    dt = product / float(np.sqrt(-stiff / DEFLECTION))
    x[where.joint_angles.start + 1] -= DEFLECTION
    x[where.base_velocity] = [0.02, -0.01, 0.015, 0.01, 0.0, -0.01]
    x[where.joint_rates] = [0.05, 0.0, -0.04]
    energies = np.asarray(kernels.energy(walk(kernels, x, np.tile(still, (STEPS, 1)), dt, integrator)))
    return np.asarray(energies[1:] / energies[0] - 1.0)


def _stiff_arm(integrator: str, effort: Effort) -> Outcome:
    error = float(np.abs(stiff_arm(integrator, STIFFEST)).max())
    return Handled(error if np.isfinite(error) else np.inf)
