"""Time steps from 1e-7 s to 1 s, up to millions of steps, and inputs that jump from limit to limit."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from itertools import product

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, largest, worst_point
from scripts.benchmarks.stability.scenes import PRECISIONS, applied, paper, rounded, walk
from scripts.benchmarks.work_precision.many_digits import torque_free_motion
from scripts.benchmarks.work_precision.motions import body_scene

GROUP = "time steps"

TIME_STEPS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
MOMENTUM_KEPT = 1e-13  # drift of methods that preserve the momentum, relative, over any number of steps
MOMENTUM_KEPT_SINGLE = 5e-5  # the same in single precision
DRIFTS = {"symplectic_euler": 0.3}
"""Largest drift of the momentum, relative, that other methods may show; 1e-6 where they are not listed, 1e-3
in single precision.

Symplectic Euler is not symplectic in these coordinates, and of order 1.
"""
UNIT = {"float64": 1e-14, "float32": 5e-6}
"""Largest distance of a pose from the unit dual quaternions after many steps, by precision."""
_WANDER = 3.0
_MILLION = 1_000_000
_DURATION = 15.0  # s
_TURN_OVER = (0.03, 1.0, 0.02)  # rad/s
_FINE = 16
_CHUNK = 20_000
_BANGS = 1000


def cases() -> Iterator[Case]:
    for name, precision in product(INTEGRATORS, PRECISIONS):
        yield from _cases_of(name, precision)
    for name, method in INTEGRATORS.items():
        criterion = (
            f"error below {_WANDER:g} roundings times the root of their number, plus 10 dt^{method.order}"
        )
        run = partial(_rounding_errors, name, method.order)
        yield Case(GROUP, "a million steps of a turning body", name, criterion, run, 1.0, "of the bound")
        criterion = "error below half a rounding of the position per step: all steps are rounded the same way"
        run = partial(_steady_drift, name)
        title = "a million steps of a body that drifts and does not turn"
        yield Case(GROUP, title, name, criterion, run, 1.0, "of the bound")


def _cases_of(name: str, precision: str) -> Iterator[Case]:
    order, subject, unit = INTEGRATORS[name].order, applied(name, precision), UNIT[precision]
    bound = drift_bound(name, precision)
    criterion = f"error of a step below 30 dt^{order + 1} plus 1000 roundings, relative to that"
    run = partial(_local_errors, name, precision)
    yield Case(GROUP, "dt from 1e-7 to 1 s", subject, criterion, run, 1.0, "of the bound")
    criterion = f"momentum kept to {bound:g}, pose a unit dual quaternion to {unit:g}"
    run = partial(_free_motion, name, precision)
    yield Case(GROUP, "free motion of very many steps", subject, criterion, run, bound, "of the momentum")
    criterion = f"finite, pose a unit dual quaternion to {unit:g}"
    run = partial(_bang_bang, name, precision)
    yield Case(GROUP, "inputs jump between their limits every step", subject, criterion, run, unit, "1")
    criterion = f"momentum of the free-floating arm kept to {bound:g} of its parts"
    run = partial(_internal_bang_bang, name, precision)
    title = "joint torques jump between their limits every step"
    yield Case(GROUP, title, subject, criterion, run, bound, "of the parts")


def drift_bound(integrator: str, precision: str = "float64") -> float:
    """Largest drift of the momentum that a method may show."""
    if integrator in DRIFTS:
        return DRIFTS[integrator]
    single = precision == "float32"
    if integrator.startswith("momentum"):
        return MOMENTUM_KEPT_SINGLE if single else MOMENTUM_KEPT
    return 1e-3 if single else 1e-6


def claimed_steps(integrator: str, precision: str) -> float:
    """Number of steps of free motion, 15 ms each, for which a method claims its drift bound."""
    if integrator.startswith("momentum"):
        return np.inf
    return 1e5 if precision == "float32" or integrator in DRIFTS else np.inf


def unit_error(states: FloatArray) -> float:
    """Distance of poses from the unit dual quaternions."""
    if not np.isfinite(states).all():
        return np.inf
    real, dual = states[:, :4], states[:, 4:8]
    norm = np.abs(np.linalg.norm(real, axis=1) - 1.0).max()
    overlap = np.abs((real * dual).sum(axis=1)) / (1.0 + np.linalg.norm(dual, axis=1))
    return largest(norm, overlap.max())


def moving_start(kernels: Kernels, rate: float = 0.2) -> FloatArray:
    """The scene's start with all velocities drawn at random."""
    rng, where, x = np.random.default_rng(0), kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.joint_rates] = rng.uniform(-rate, rate, x[where.joint_rates].shape)
    x[where.base_velocity] = rng.uniform(-rate / 4, rate / 4, x[where.base_velocity].shape)
    return x


def _local_errors(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels, exact, order = paper(precision), paper(), INTEGRATORS[integrator].order
    x = rounded(moving_start(kernels, 0.8), kernels)
    u = rounded(0.1 * kernels.layout.control_limit, kernels)
    curve = []
    for dt in TIME_STEPS:
        fine = walk(exact, x, np.tile(u, (_FINE, 1)), dt / _FINE, "rk4")[-1]
        found = walk(kernels, x, u[None], dt, integrator)[-1].astype(np.float64)
        error = float(np.abs(exact.difference(fine, found)).max())
        # The many small steps of the reference round too.
        curve.append((dt, error / (30.0 * dt ** (order + 1) + 1000.0 * float(np.finfo(precision).eps))))
    worst, error = worst_point(curve)
    return Handled(error, f"most at dt = {worst:g} s", tuple(curve))


def _free_motion(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels, exact = paper(precision), paper()
    x, bound = rounded(moving_start(kernels), kernels), drift_bound(integrator, precision)
    claimed, first = claimed_steps(integrator, precision), exact.momentum(x)
    sizes = np.repeat([np.linalg.norm(first[:3]), np.linalg.norm(first[3:])], 3)
    still = np.zeros((_CHUNK, kernels.n_u))
    drift, unit = 0.0, 0.0
    curve: list[tuple[float, float]] = []
    for done in range(_CHUNK, max(effort.steps, _CHUNK) + 1, _CHUNK):
        states = walk(kernels, x, still, kernels.scene.simulation.dt, integrator)
        x = states[-1].astype(np.float64)
        unit = largest(unit, unit_error(states[:: _CHUNK // 10]))
        drift = largest(drift, float((np.abs(exact.momentum(x) - first) / sizes).max()))
        lost = unit > UNIT[precision] or not drift <= bound
        if lost and done > claimed:
            before = f"the momentum drifts by {curve[-1][1]:.2g} in {curve[-1][0]:.0e} steps"
            return NotClaimed(f"{before}; claimed are {claimed:.0e}", tuple(curve))
        curve.append((float(done), drift))
        if lost:
            break
    if unit > UNIT[precision]:
        return Handled(np.inf, f"the pose is off the unit dual quaternions by {unit:.1e}")
    return Handled(drift, f"{curve[-1][0]:.0e} steps; pose off by {unit:.1e}", tuple(curve))


def _bang_bang(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels, exact = paper(precision), paper()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_BANGS, kernels.n_u))
    controls, dt = signs * kernels.layout.control_limit, kernels.scene.simulation.dt
    states = walk(kernels, kernels.layout.initial_state, controls, dt, integrator)
    fine = walk(exact, kernels.layout.initial_state, np.repeat(controls, 8, axis=0), dt / 8, "rk4")
    apart = float(np.abs(exact.difference(fine[-1], states[-1].astype(np.float64))).max())
    return Handled(unit_error(states), f"{apart:.1e} rad or m from RK4 with an eighth of the step")


def _internal_bang_bang(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels, exact = paper(precision, "free-floating"), paper(scene="free-floating")
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_BANGS, kernels.n_u))
    x, dt = rounded(kernels.layout.initial_state, kernels), kernels.scene.simulation.dt
    states = walk(kernels, x, signs * kernels.layout.control_limit, dt, integrator).astype(np.float64)
    if not np.isfinite(states).all():
        return Handled(np.inf)
    # The start is at rest: the momentum of the joints' motion alone, without the base's recoil, is the scale.
    bound = states.copy()
    bound[:, kernels.layout.state.base_velocity] = 0.0
    sizes = np.abs(exact.momentum(bound)).max(axis=0)
    drift = np.abs(exact.momentum(states) - exact.momentum(x))
    scale = np.repeat([sizes[:3].max(), sizes[3:].max()], 3)
    return Handled(float((drift / scale).max()))


@cache
def _turned_body() -> tuple[FloatArray, FloatArray]:
    """Pose and angular velocity of the body in the end, from 30 digits."""
    moments = np.diagonal(np.array(body_scene().base.inertia)).tolist()
    q, omega = torque_free_motion(moments, _TURN_OVER, dual_quaternion.IDENTITY[:4], _DURATION)
    return np.array([*q, *(0.0,) * 4], dtype=np.float64), np.array(omega, dtype=np.float64)


def _rounding_errors(integrator: str, order: int, effort: Effort) -> Outcome:
    """Turn a body alone, whose exact solution leaves rounding as the only error of many steps."""
    kernels, steps = compile_scene(body_scene()), _MILLION
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.pose], x[where.angular_velocity] = dual_quaternion.IDENTITY, _TURN_OVER
    exact = x.copy()
    exact[where.pose], exact[where.angular_velocity] = _turned_body()
    dt = _DURATION / steps
    end = kernels.simulate(x, np.zeros(kernels.n_u), steps, dt, integrator, every=steps)[-1]
    error = float(np.abs(kernels.difference(exact, end)).max())
    bound = _WANDER * np.finfo(np.float64).eps * np.sqrt(steps) + 10.0 * dt**order
    return Handled(error / bound, f"{error:.1e} rad, m, rad/s after {_DURATION:g} s")


def _steady_drift(integrator: str, effort: Effort) -> Outcome:
    """Drift steadily: all increments are equal, so their rounding errors add up."""
    kernels = compile_scene(body_scene())
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    start, velocity = np.array([0.3, -2.9, 4.4]), np.array([0.05, -0.03, 0.02])
    x[where.pose] = poses.from_rotation_and_position(dual_quaternion.IDENTITY[:4], tuple(start.tolist()))
    x[where.linear_velocity] = velocity
    still, dt = np.zeros(kernels.n_u), _DURATION / _MILLION
    end = kernels.simulate(x, still, _MILLION, dt, integrator, every=_MILLION)[-1]
    found = np.array(poses.position(tuple(end[where.pose].tolist())))
    error = float(np.abs(found - (start + _DURATION * velocity)).max())
    bound = 0.5 * float(np.spacing(np.abs(start).max())) * _MILLION
    return Handled(error / bound, f"{error:.1e} m after {_DURATION:g} s")
