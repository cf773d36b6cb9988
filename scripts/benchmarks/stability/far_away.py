"""Far from the origin, as in low orbit: digits of a position lost in the dual part.

A position of 7e6 m has a resolution of 1e-9 m in double precision and of half a meter in single precision,
in every formulation. The motion does not depend on the position, so a scene loses nothing by choosing an
origin near the spacecraft.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, Outcome, refusal
from scripts.benchmarks.stability.scenes import walk

GROUP = "far away"

RADIUS = 7e6  # m
_STEPS = 1000
_DIRECTION = np.array([0.48, -0.6, 0.64])


def cases() -> Iterator[Case]:
    for precision, bound in (("float64", 1e-6), ("float32", 100.0)):
        criterion = f"tip within {bound:g} m of the same motion near the origin"
        run = partial(_offset, precision)
        title = "7e6 m from the origin"
        yield Case(GROUP, title, f"maneuver of 15 s, {precision}", criterion, run, bound, "m")
    for name in INTEGRATORS:
        criterion = "the velocities and joint angles are those of the same motion near the origin, bit by bit"
        run = partial(_same_velocities, name)
        yield Case(GROUP, "velocities 7e6 m from the origin", name, criterion, run, 0.0, "rad, m/s, rad/s")
    criterion = "tip within 1e-12 m of the same motion with the origin 10 m off"
    yield Case(GROUP, "a local frame", "maneuver of 15 s, float64", criterion, _local, 1e-12, "m")
    criterion = "refused, naming the limit of states"
    yield Case(GROUP, "initial state 7e6 m from the origin", "environment", criterion, _environment)
    yield Case(
        GROUP, "scene that starts 7e6 m from the origin", "environment", criterion, _environment_of_far_scene
    )


def _motion(precision: str, offset: FloatArray, integrator: str) -> tuple[FloatArray, FloatArray]:
    """States and tip positions of a maneuver that begins at an offset; the positions are without it."""
    kernels = compile_scene(load_scene("paper").replace(simulation={"precision": precision}))
    x = kernels.layout.initial_state.copy()
    _move(x[kernels.layout.state.pose], offset)
    rng = np.random.default_rng(0)
    phases = rng.uniform(0.0, 6.0, kernels.n_u)
    times = np.arange(_STEPS)[:, None] * kernels.scene.simulation.dt
    controls = 0.1 * kernels.layout.control_limit * np.sin(0.8 * times + phases)
    states = walk(kernels, x, controls, kernels.scene.simulation.dt, integrator)
    tips = kernels.tip_pose(states).astype(np.float64)
    return states, np.array([poses.position(tuple(tip)) for tip in tips.tolist()]) - offset


def _move(pose: FloatArray, offset: FloatArray) -> None:
    """Move a pose, shape (8,), in place."""
    start = poses.from_rotation_and_position((1.0, 0.0, 0.0, 0.0), tuple(offset.tolist()))
    pose[:] = dq.multiply(start, tuple(pose.tolist()))


def _offset(precision: str, effort: Effort) -> Outcome:
    _, near = _motion("float64", np.zeros(3), "rk4")
    curve = []
    for radius in (1e1, 1e2, 1e3, 1e4, 1e5, 1e6, RADIUS):
        _, far = _motion(precision, radius * _DIRECTION, "rk4")
        curve.append((radius, float(np.abs(far - near).max())))
    at_start = float(np.finfo(precision).eps) * RADIUS
    return Handled(curve[-1][1], f"one rounding of the position is {at_start:.1e} m", tuple(curve))


def _same_velocities(integrator: str, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    near, _ = _motion("float64", np.zeros(3), integrator)
    far, _ = _motion("float64", RADIUS * _DIRECTION, integrator)
    rest = slice(kernels.layout.state.pose.stop, None)
    return Handled(float(np.abs(far[:, rest] - near[:, rest]).max()))


def _local(effort: Effort) -> Outcome:
    _, near = _motion("float64", np.zeros(3), "rk4")
    _, local = _motion("float64", 10.0 * _DIRECTION, "rk4")
    return Handled(float(np.abs(local - near).max()))


def _environment(effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    x = env.kernels.layout.initial_state.copy()
    _move(x[env.kernels.layout.state.pose], RADIUS * _DIRECTION)
    return refusal(lambda: env.reset(options={"initial_state": x}), naming="initial_state")


def _environment_of_far_scene(effort: Effort) -> Outcome:
    pose = {"position": (RADIUS * _DIRECTION).tolist()}
    far = load_scene("paper").replace(initial_state={"base_pose": pose})
    return refusal(lambda: DQSpaceArmEnv(far), naming="initial_state")
