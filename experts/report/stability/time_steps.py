"""Time steps from 1e-7 s to 1 s, very many of them, and inputs that jump from limit to limit."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.integrators import INTEGRATORS
from experts.problem import FloatArray
from experts.report.stability.rows import Case, Effort, Handled, NotClaimed, Outcome
from experts.report.stability.scenes import walk

GROUP = "time steps"

TIME_STEPS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
MOMENTUM_KEPT = 1e-13
"""Of methods that preserve the momentum, relative, over any number of steps."""
DRIFTS = {"symplectic_euler": 0.3}
"""Largest drift of the momentum, relative, that other methods may show; 1e-6 where they are not listed.

Symplectic Euler is no symplectic method in these coordinates, and of order 1: momentum is not its strength.
"""
CLAIMED_STEPS = {"symplectic_euler": 100_000}
"""Number of steps of free motion, 15 ms each, for which a method claims that; any where it is not listed."""
_FINE = 16
_CHUNK = 20_000
_BANGS = 1000


def cases() -> Iterator[Case]:
    """All cases of the group."""
    for name, method in INTEGRATORS.items():
        yield Case(
            GROUP,
            "dt from 1e-7 to 1 s",
            name,
            f"error of a step below 30 dt^{method.order + 1} plus 1000 roundings, relative to that",
            partial(_local_errors, name, method.order),
            1.0,
            "of the bound",
        )
        bound = drift_bound(name)
        yield Case(
            GROUP,
            "free motion of very many steps",
            name,
            f"momentum kept to {bound:g}, pose a unit dual quaternion to 1e-14",
            partial(_free_motion, name),
            bound,
            "of the momentum",
        )
        yield Case(
            GROUP,
            "inputs jump between their limits every step",
            name,
            "finite, pose a unit dual quaternion to 1e-14",
            partial(_bang_bang, name),
            1e-14,
            "1",
        )
        yield Case(
            GROUP,
            "joint torques jump between their limits every step",
            name,
            f"momentum of the free-floating arm kept to {bound:g} of its parts",
            partial(_internal_bang_bang, name),
            bound,
            "of the parts",
        )


def drift_bound(integrator: str) -> float:
    """Largest drift of the momentum that a method may show.

    Args:
        integrator: Its name.

    Returns:
        The drift, relative to the momentum.
    """
    return MOMENTUM_KEPT if integrator.startswith("momentum") else DRIFTS.get(integrator, 1e-6)


def unit_error(states: FloatArray) -> float:
    """How far poses are from unit dual quaternions.

    Args:
        states: Shape (B, n_x), of a spatial scene.

    Returns:
        The larger one of ||q_r| - 1| and |q_r . q_d| / (1 + |q_d|); infinite where a state is not finite.
    """
    if not np.isfinite(states).all():
        return np.inf
    real, dual = states[:, :4], states[:, 4:8]
    norm = np.abs(np.linalg.norm(real, axis=1) - 1.0).max()
    overlap = np.abs((real * dual).sum(axis=1)) / (1.0 + np.linalg.norm(dual, axis=1))
    return float(max(norm, overlap.max()))


def moving_start(kernels: Kernels, rate: float = 0.2) -> FloatArray:
    """The scene's start with all velocities drawn at random.

    Args:
        kernels: Functions of the scene.
        rate: Half-width of the draws of joint rates, rad/s; the base's are a quarter of it.

    Returns:
        State, shape (n_x,), units of `kernels.layout.state`.
    """
    rng, where, x = np.random.default_rng(0), kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.joint_rates] = rng.uniform(-rate, rate, x[where.joint_rates].shape)
    x[where.base_velocity] = rng.uniform(-rate / 4, rate / 4, x[where.base_velocity].shape)
    return x


def _local_errors(integrator: str, order: int, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    x = moving_start(kernels, 0.8)
    u = 0.1 * kernels.layout.control_limit
    curve = []
    for dt in TIME_STEPS:
        fine = walk(kernels, x, np.tile(u, (_FINE, 1)), dt / _FINE, "rk4")[-1]
        error = float(np.abs(kernels.difference(fine, kernels.step(x, u, dt, integrator))).max())
        # What the many small steps of the reference round away counts too.
        curve.append((dt, error / (30.0 * dt ** (order + 1) + 1000.0 * np.finfo(np.float64).eps)))
    worst, error = max(curve, key=lambda point: point[1])
    return Handled(error, f"most at dt = {worst:g} s", tuple(curve))


def _free_motion(integrator: str, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    x = moving_start(kernels)
    first = kernels.momentum(x)
    sizes = np.repeat([np.linalg.norm(first[:3]), np.linalg.norm(first[3:])], 3)
    still = np.zeros((_CHUNK, kernels.n_u))
    drift, unit = 0.0, 0.0
    curve: list[tuple[float, float]] = []
    for done in range(_CHUNK, max(effort.steps, _CHUNK) + 1, _CHUNK):
        states = walk(kernels, x, still, kernels.scene.simulation.dt, integrator)
        x = states[-1]
        unit = max(unit, unit_error(states[:: _CHUNK // 10]))
        drift = max(drift, float((np.abs(kernels.momentum(x) - first) / sizes).max()))
        lost = unit > 1e-14 or not drift <= drift_bound(integrator)
        if lost and done > CLAIMED_STEPS.get(integrator, np.inf):
            before = f"the momentum drifts by {curve[-1][1]:.2g} in {curve[-1][0]:.0e} steps"
            return NotClaimed(f"{before}; claimed are {CLAIMED_STEPS[integrator]:.0e}", tuple(curve))
        curve.append((float(done), drift))
        if lost:
            break
    if unit > 1e-14:
        return Handled(np.inf, f"the pose is off the unit dual quaternions by {unit:.1e}")
    return Handled(drift, f"{curve[-1][0]:.0e} steps; pose off by {unit:.1e}", tuple(curve))


def _bang_bang(integrator: str, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_BANGS, kernels.n_u))
    controls = signs * kernels.layout.control_limit
    states = walk(kernels, kernels.layout.initial_state, controls, kernels.scene.simulation.dt, integrator)
    fine = walk(
        kernels,
        kernels.layout.initial_state,
        np.repeat(controls, 8, axis=0),
        kernels.scene.simulation.dt / 8,
        "rk4",
    )
    apart = float(np.abs(kernels.difference(fine[-1], states[-1])).max())
    return Handled(unit_error(states), f"{apart:.1e} rad or m from RK4 with an eighth of the step")


def _internal_bang_bang(integrator: str, effort: Effort) -> Outcome:
    kernels = compile_scene("free-floating")
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_BANGS, kernels.n_u))
    x = kernels.layout.initial_state
    states = walk(kernels, x, signs * kernels.layout.control_limit, kernels.scene.simulation.dt, integrator)
    if not np.isfinite(states).all():
        return Handled(np.inf)
    # The start is at rest: the momentum of the joints' motion alone, without the base's recoil, is the scale.
    bound = states.copy()
    bound[:, kernels.layout.state.base_velocity] = 0.0
    sizes = np.abs(kernels.momentum(bound)).max(axis=0)
    drift = np.abs(kernels.momentum(states) - kernels.momentum(x))
    scale = np.repeat([sizes[:3].max(), sizes[3:].max()], 3)
    return Handled(float((drift / scale).max()))
