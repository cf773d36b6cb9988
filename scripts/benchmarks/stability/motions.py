"""Fast motion, singular configurations, and angles wound up over many turns."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import mpmath
import numpy as np

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from experts.guesses.screw_motion import screw_motion
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, largest, worst_point
from scripts.benchmarks.stability.masses import BACKWARD_BOUND, ROUNDING, judge
from scripts.benchmarks.stability.references import DIGITS, FORMULATIONS, Sample, column, turn
from scripts.benchmarks.stability.scenes import paper, random_state, with_links

GROUP = "motions"

REDUCED = {"float64": 1e6, "float32": 6e3}
"""Largest angle whose sine and cosine keep their digits, rad; see `compiler.elementary`."""
_TURNS = (1.0, 10.0, 1e2, 1e3, 6e3, 1e4, 1e5, 1e6)


def cases() -> Iterator[Case]:
    for name in FORMULATIONS:
        rounding = ROUNDING.get(name, 1.0)
        bound, below = BACKWARD_BOUND * rounding, "below 1e-12" + " times 2^29" * (rounding > 1)
        criterion = f"error of the accelerations against 50 digits {below}"
        title = "spin of 100 rad/s, joints at 50 rad/s"
        yield Case(GROUP, title, name, criterion, partial(_fast, name), bound, "1")
        criterion = f"row-wise backward error of the accelerations {below}"
        for title, angles in (("straight", (0.0, 0.0, 0.0)), ("folded", (0.0, np.pi / 2, np.pi))):
            run = partial(_configuration, name, angles)
            yield Case(GROUP, f"arm {title}", name, criterion, run, bound, "1")
        title = "springs of 1e8 N m/rad, dampers of 1e6 N m s/rad in all joints"
        yield Case(GROUP, title, name, criterion, partial(_passive, name), bound, "1")
    for angle in (90.0, -90.0):
        title = f"wrist at gimbal lock, theta = {angle:g} deg"
        criterion = "rotation matrix of the tip against 50 digits below 1e-14, all derivatives finite"
        run = partial(_gimbal_lock, np.radians(angle))
        yield Case(GROUP, title, "tip pose, step and its derivatives", criterion, run, 1e-14, "1")
        criterion = "states and wrist rates of the guess are finite and within the limits"
        run = partial(_guess_at_gimbal_lock, np.radians(angle))
        yield Case(GROUP, title, "expert's screw motion", criterion, run, 0.0, "1")
    for precision in REDUCED:
        for lanes in ("one state", "batch"):
            yield Case(
                GROUP,
                f"angles wound up to {REDUCED[precision]:g} rad",
                f"sine and cosine, {precision}, {lanes}",
                "rotation of the tip by a joint within 8 roundings of 50 digits",
                partial(_wound, precision, lanes == "batch"),
                8.0,
                "roundings",
            )
    yield Case(
        GROUP, "angles beyond 6e3 rad", "sine and cosine, float32", "not claimed; finite", _beyond_single
    )


def _fast(formulation: str, effort: Effort) -> Outcome:
    worst, residual = 0.0, 0.0
    for seed in range(effort.samples):
        rng = np.random.default_rng(seed)
        kernels = paper()
        where, x = kernels.layout.state, random_state(kernels, rng)
        spin, rates = rng.normal(size=3), rng.choice([-50.0, 50.0], 3)
        x[where.angular_velocity] = 100.0 * spin / np.linalg.norm(spin)
        x[where.joint_rates] = rates
        found = judge(Sample.of(kernels.scene, x, rng.normal(size=kernels.n_u)), formulation)
        worst, residual = largest(worst, found.forward), largest(residual, found.by_row)
    return Handled(worst, f"row-wise backward error {residual:.1e}")


def _configuration(formulation: str, angles: tuple[float, ...], effort: Effort) -> Outcome:
    worst, forward = 0.0, 0.0
    for seed in range(effort.samples):
        rng = np.random.default_rng(seed)
        kernels = paper()
        x = random_state(kernels, rng)
        x[kernels.layout.state.joint_angles] = angles
        found = judge(Sample.of(kernels.scene, x, rng.normal(size=kernels.n_u)), formulation)
        worst, forward = largest(worst, found.by_row), largest(forward, found.forward)
    return Handled(worst, f"forward error {forward:.1e}")


def _passive(formulation: str, effort: Effort) -> Outcome:
    scene, worst, forward = with_links(load_scene("paper"), stiffness=1e8, damping=1e6), 0.0, 0.0
    kernels = compile_scene(scene)
    for seed in range(effort.samples):
        rng = np.random.default_rng(seed)
        sample = Sample.of(scene, random_state(kernels, rng), rng.normal(size=kernels.n_u))
        found = judge(sample, formulation)
        worst, forward = largest(worst, found.by_row), largest(forward, found.forward)
    return Handled(worst, f"forward error {forward:.1e}")


def _tip_rotation(joint_angles: FloatArray, wrist_angles: FloatArray) -> FloatArray:
    """Rotation matrix of the paper's tip in base axes, by matrices with 50 digits."""
    with mpmath.workdps(DIGITS):
        rotation = mpmath.eye(3)
        for link, angle in zip(
            KinematicTree.from_scene(load_scene("paper")).links, joint_angles, strict=True
        ):
            rotation = rotation * mpmath.matrix([list(row) for row in link.joint.rotation]) * turn(2, angle)
        psi, theta, phi = column(wrist_angles)
        rotation = rotation * turn(2, psi) * turn(1, theta) * turn(0, phi)
        return np.array([[float(rotation[i, j]) for j in range(3)] for i in range(3)])


def _at_rest(kernels: Any) -> FloatArray:
    """The start with the base at the origin."""
    x: FloatArray = kernels.layout.initial_state.copy()
    x[kernels.layout.state.pose] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    return x


def _gimbal_lock(theta: float, effort: Effort) -> Outcome:
    kernels = paper()
    where, worst = kernels.layout.state, 0.0
    for seed in range(effort.samples):
        rng, x = np.random.default_rng(seed), _at_rest(kernels)
        x[where.joint_angles], x[where.wrist_angles] = rng.normal(size=3), rng.normal(size=3)
        x[where.wrist_angles.start + 1] = theta
        exact = _tip_rotation(x[where.joint_angles], x[where.wrist_angles])
        found, _ = poses.to_matrix(tuple(kernels.tip_pose(x).tolist()))
        worst = largest(worst, float(np.abs(np.array(found) - exact).max()))
        u = kernels.layout.control_limit * rng.uniform(-1.0, 1.0, kernels.n_u)
        for result in (kernels.step(x, u), *kernels.linearize(x, u)):
            worst = worst if np.isfinite(result).all() else np.inf
    return Handled(worst)


def _guess_at_gimbal_lock(theta: float, effort: Effort) -> Outcome:
    problem = ArmProblem("paper")
    x = problem.initial_state.copy()
    x[problem.kernels.layout.state.wrist_angles] = [0.3, theta, -0.3]
    motion = screw_motion(problem, x)
    outside = 0.0
    for array in motion:
        if isinstance(array, np.ndarray) and not np.isfinite(array).all():
            return Handled(np.inf, "the guess is not finite")
        if isinstance(array, np.ndarray) and array.shape == (problem.horizon, problem.n_controls):
            outside = float(np.max(np.abs(array) - problem.control_upper))
    return Handled(largest(outside, 0.0))


def _rotation_errors(precision: str, batch: bool, angles: tuple[float, ...]) -> list[tuple[float, float]]:
    """Errors of the tip's rotation at wound-up angles, in roundings of the precision."""
    kernels = paper(precision)
    where = kernels.layout.state
    rng = np.random.default_rng(0)
    curve = []
    for size in angles:
        states = np.tile(_at_rest(kernels), (2 * kernels.lanes + 1, 1))
        for x in states:
            x[where.joint_angles] = rng.choice([-1.0, 1.0], 3) * size * rng.uniform(0.99, 1.0, 3)
        states = states.astype(kernels.dtype)
        tips = kernels.tip_pose(states) if batch else np.array([kernels.tip_pose(x) for x in states])
        worst = 0.0
        for x, tip in zip(states.astype(np.float64), tips.astype(np.float64), strict=True):
            exact = _tip_rotation(x[where.joint_angles], x[where.wrist_angles])
            found, _ = poses.to_matrix(tuple(tip.tolist()))
            worst = largest(worst, float(np.abs(np.array(found) - exact).max()))
        curve.append((size, worst / float(np.finfo(kernels.dtype).eps)))
    return curve


def _wound(precision: str, batch: bool, effort: Effort) -> Outcome:
    curve = _rotation_errors(precision, batch, tuple(t for t in _TURNS if t <= REDUCED[precision]))
    return Handled(worst_point(curve)[1], curve=tuple(curve))


def _beyond_single(effort: Effort) -> Outcome:
    curve = _rotation_errors("float32", True, tuple(t for t in _TURNS if t > REDUCED["float32"]))
    size, error = worst_point(curve)
    if not np.isfinite(error):
        return Handled(error)
    return NotClaimed(
        f"float32 reduces angles up to 6e3 rad; at {size:g} rad the error is {error:.1e} roundings"
    )
