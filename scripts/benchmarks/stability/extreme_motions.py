"""Fast motion, singular configurations and wound-up angles, for every integrator and precision.

The group `motions` judges the accelerations there, this one the steps. Each motion lasts until its fastest
part has turned by 1 rad, in steps of 0.02 rad, and is compared with the method of order 8 at a quarter of the
step in double precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

from dq_space_arm_env import Kernels, compile_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, largest
from scripts.benchmarks.stability.motions import REDUCED
from scripts.benchmarks.stability.scenes import PRECISIONS, applied, paper, rounded, walk
from scripts.benchmarks.stability.time_steps import UNIT, moving_start, unit_error
from scripts.benchmarks.work_precision.motions import body_scene

GROUP = "extreme motions"

_STEPS = 50
_TURN = 0.02  # rad a step
_FINER = 4
_ROUNDINGS = 2000.0
_CONFIGURATIONS = {
    "arm straight": ((0.0, 0.0, 0.0), 0.2),
    "arm folded": ((0.0, np.pi / 2, np.pi), 0.2),
    "wrist at gimbal lock, theta = 90 deg": (None, np.pi / 2),
    "wrist at gimbal lock, theta = -90 deg": (None, -np.pi / 2),
}


def cases() -> Iterator[Case]:
    for name, precision in product(INTEGRATORS, PRECISIONS):
        order, subject = INTEGRATORS[name].order, applied(name, precision)
        close = (
            f"within 100 x {_TURN:g}^{order + 1} and {_ROUNDINGS:g} roundings of order 8, relative to that"
        )
        run = partial(_fast, name, precision)
        title = "spin of 100 rad/s, joints at 50 rad/s"
        yield Case(GROUP, title, subject, close, run, 1.0, "of the bound")
        for title, (angles, theta) in _CONFIGURATIONS.items():
            run = partial(_configuration, name, precision, angles, theta)
            yield Case(GROUP, title, subject, close, run, 1.0, "of the bound")
        wound = REDUCED[precision]
        criterion = "within 20 roundings of these angles of the motion without the turns"
        run = partial(_wound, name, precision)
        yield Case(GROUP, f"angles wound up to {wound:g} rad", subject, criterion, run, 20.0, "roundings")
        criterion = f"pose within {10.0 * UNIT[precision]:g} of the half turn"
        run = partial(_half_turn, name, precision)
        title = "a step that turns the base by exactly 180 deg"
        yield Case(GROUP, title, subject, criterion, run, 10.0 * UNIT[precision], "1")


def _compare(
    integrator: str, kernels: Kernels, x: FloatArray, u: FloatArray, dt: float, rate: float
) -> Outcome:
    """Follow a motion and judge its end."""
    precision, exact = kernels.scene.simulation.precision, paper()
    x, u = rounded(x, kernels), rounded(u, kernels)
    states = walk(kernels, x, np.tile(u, (_STEPS, 1)), dt, integrator).astype(np.float64)
    fine = walk(exact, x, np.tile(u, (_FINER * _STEPS, 1)), dt / _FINER, "rk8")[-1]
    if not np.isfinite(states).all():
        return Handled(np.inf, "not finite")
    # Errors of velocities are relative to the fastest.
    scale = np.ones(kernels.n_t)
    scale[kernels.layout.tangent.base_velocity] = max(rate, 1.0)
    scale[kernels.layout.tangent.joint_rates] = max(rate, 1.0)
    error = float(np.abs(exact.difference(fine, states[-1]) / scale).max())
    order = INTEGRATORS[integrator].order
    bound = 100.0 * _TURN ** (order + 1) + _ROUNDINGS * float(np.finfo(precision).eps)
    return Handled(error / bound, f"{error:.1e} rad, m; pose off by {unit_error(states):.1e}")


def _fast(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels = paper(precision)
    where, x = kernels.layout.state, moving_start(kernels)
    x[where.angular_velocity] = 100.0 * np.array([0.48, -0.6, 0.64])
    x[where.joint_rates] = [50.0, -50.0, 50.0]
    return _compare(integrator, kernels, x, np.zeros(kernels.n_u), _TURN / 150.0, 150.0)


def _configuration(
    integrator: str, precision: str, angles: tuple[float, ...] | None, theta: float, effort: Effort
) -> Outcome:
    kernels = paper(precision)
    where, x = kernels.layout.state, moving_start(kernels, 0.8)
    if angles is not None:
        x[where.joint_angles] = angles
    x[where.wrist_angles.start + 1] = theta
    return _compare(integrator, kernels, x, 0.02 * kernels.layout.control_limit, _TURN, 1.0)


def _wound(integrator: str, precision: str, effort: Effort) -> Outcome:
    """As many whole turns as the precision allows change nothing but the last digits of the angles."""
    kernels = paper(precision)
    where, x, u = kernels.layout.state, moving_start(kernels), 0.1 * kernels.layout.control_limit
    wound, turns = x.copy(), np.floor(REDUCED[precision] / (2.0 * np.pi)) * np.array([1.0, -1.0, 1.0])
    wound[where.joint_angles] += 2.0 * np.pi * turns
    wound = rounded(wound, kernels)
    # The angles that the rounding of the wound-up ones leaves.
    x[where.joint_angles] = wound[where.joint_angles] - 2.0 * np.pi * turns
    ends = [walk(kernels, s, np.tile(u, (_STEPS, 1)), _TURN, integrator)[-1] for s in (x, wound)]
    plain, far = (end.astype(np.float64) for end in ends)
    far[where.joint_angles] -= 2.0 * np.pi * turns
    rounding = float(np.finfo(precision).eps) * REDUCED[precision]
    error = float(np.abs(paper().difference(plain, far)).max())
    return Handled(error / rounding, f"{error:.1e} rad, m; a rounding of these angles is {rounding:.1e} rad")


def _half_turn(integrator: str, precision: str, effort: Effort) -> Outcome:
    """A body alone that turns about a principal axis moves along a screw: no method that converges errs."""
    kernels = compile_scene(body_scene().replace(simulation={"precision": precision}))
    where, worst = kernels.layout.state, 0.0
    for axis in range(3):
        x = kernels.layout.initial_state.copy()
        x[where.pose] = dq.IDENTITY
        x[where.angular_velocity.start + axis] = np.pi / 0.015
        end = walk(kernels, x, np.zeros((1, kernels.n_u)), 0.015, integrator)[-1][where.pose]
        half = np.zeros(8)
        half[1 + axis] = 1.0
        worst = largest(worst, float(np.abs(end.astype(np.float64) - half).max()))
    if integrator == "gauss6" and not np.isfinite(worst):
        return NotClaimed("its passes converge up to some 0.5 rad in a step; beyond, the state becomes NaN")
    return Handled(worst)
