"""The paper's own state of 46 numbers: as printed, and with its velocities projected.

It integrates the velocities of all bodies side by side: only the accelerations keep the arm together, and
rounding and truncation errors let it drift apart, unless a projection after every step corrects them. Both
take classical Runge-Kutta steps of every number, pose included.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, worst_point
from scripts.benchmarks.stability.scenes import paper, walk
from scripts.benchmarks.stability.time_steps import TIME_STEPS, moving_start
from scripts.benchmarks.work_precision.methods import PAPER, PROJECTED, Method, Walk
from scripts.benchmarks.work_precision.motions import MotionCase

GROUP = "paper's form"

DRIFT = 1e-6  # largest drift of the momentum that both claim, relative
CLAIMED_STEPS = 100_000  # of 15 ms of free motion, for which they claim this drift
FORMS = {PAPER: "46 states, RK4", PROJECTED: "46 states, RK4, projected"}
_ORDER = 4
_FINE = 16
_BANGS = 1000


def cases() -> Iterator[Case]:
    for name, form in FORMS.items():
        criterion = f"error of a step below 30 dt^{_ORDER + 1} plus 1000 roundings, relative to that"
        run = partial(_local_errors, name)
        yield Case(GROUP, "dt from 1e-7 to 1 s", form, criterion, run, 1.0, "of the bound")
        criterion = "end of 50 steps of 0.02 rad within 1e-6 of order 8, velocities relative to the fastest"
        run = partial(_fast, name)
        yield Case(GROUP, "spin of 100 rad/s, joints at 50 rad/s", form, criterion, run, 1e-6, "rad, m")
        criterion = "end of 15 s within 1e-5 of RK4 with an eighth of the step in minimal coordinates"
        run = partial(_bang_bang, name)
        title = "inputs jump between their limits every step"
        yield Case(GROUP, title, form, criterion, run, 1e-5, "rad, m")
        criterion = f"momentum kept to {DRIFT:g} over {CLAIMED_STEPS:.0e} steps"
        run = partial(_free_motion, name)
        yield Case(GROUP, "free motion of very many steps", form, criterion, run, DRIFT, "of the momentum")


def _end(name: str, start: FloatArray, controls: FloatArray, dt: float) -> FloatArray:
    """End of a walk in minimal coordinates, shape (n_x,)."""
    kernels = paper()
    case = MotionCase(name, name, kernels.scene, start, controls, dt, 1, limit=0.0, with_paper_form=True)
    motion = Walk(Method(name, _ORDER), kernels, case)
    motion.run(1)
    return motion.state


def _apart(found: FloatArray, exact: FloatArray, rate: float = 1.0) -> float:
    """Largest difference of two states, velocities relative to a rate; infinite where one is not finite."""
    kernels = paper()
    scale, where = np.ones(kernels.n_t), kernels.layout.tangent
    scale[where.base_velocity] = scale[where.joint_rates] = rate
    apart = float(np.abs(kernels.difference(exact, found) / scale).max())
    return apart if np.isfinite(apart) else np.inf


def _local_errors(name: str, effort: Effort) -> Outcome:
    kernels = paper()
    x, u = moving_start(kernels, 0.8), 0.1 * kernels.layout.control_limit
    curve = []
    for dt in TIME_STEPS:
        fine = walk(kernels, x, np.tile(u, (_FINE, 1)), dt / _FINE, "rk4")[-1]
        bound = 30.0 * dt ** (_ORDER + 1) + 1000.0 * float(np.finfo(np.float64).eps)
        curve.append((dt, _apart(_end(name, x, u[None], dt), fine) / bound))
    worst, error = worst_point(curve)
    return Handled(error, f"most at dt = {worst:g} s", tuple(curve))


def _fast(name: str, effort: Effort) -> Outcome:
    kernels, steps, rate = paper(), 50, 150.0
    where, x = kernels.layout.state, moving_start(kernels)
    x[where.angular_velocity] = 100.0 * np.array([0.48, -0.6, 0.64])
    x[where.joint_rates] = [50.0, -50.0, 50.0]
    still, dt = np.zeros((steps, kernels.n_u)), 0.02 / rate
    fine = walk(kernels, x, np.tile(still, (4, 1)), dt / 4, "rk8")[-1]
    return Handled(_apart(_end(name, x, still, dt), fine, rate))


def _bang_bang(name: str, effort: Effort) -> Outcome:
    kernels = paper()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_BANGS, kernels.n_u))
    controls, dt = signs * kernels.layout.control_limit, kernels.scene.simulation.dt
    x = kernels.layout.initial_state
    fine = walk(kernels, x, np.repeat(controls, 8, axis=0), dt / 8, "rk4")[-1]
    return Handled(_apart(_end(name, x, controls, dt), fine))


def _free_motion(name: str, effort: Effort) -> Outcome:
    kernels, claimed = paper(), CLAIMED_STEPS
    x = moving_start(kernels)
    first = kernels.momentum(x)
    sizes = np.repeat([np.linalg.norm(first[:3]), np.linalg.norm(first[3:])], 3)
    curve: list[tuple[float, float]] = []
    for steps in (1_000, 10_000, 100_000, 1_000_000):
        if steps > max(effort.steps, claimed):
            break
        end = _end(name, x, np.zeros((steps, kernels.n_u)), kernels.scene.simulation.dt)
        drift = float((np.abs(kernels.momentum(end) - first) / sizes).max())
        if not drift <= DRIFT and steps > claimed:
            kept = f"the momentum drifts by {curve[-1][1]:.2g} in {curve[-1][0]:.0e} steps"
            return NotClaimed(f"{kept}; claimed are {claimed:.0e}", tuple(curve))
        curve.append((float(steps), drift if np.isfinite(drift) else np.inf))
    return Handled(worst_point(curve)[1], f"{curve[-1][0]:.0e} steps", tuple(curve))
