"""Poses off the unit dual quaternions, and attitude errors of half a turn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

from dq_space_arm_env import compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.scene import INTEGRATORS
from experts.guesses.screw_motion import screw_motion
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, Outcome, largest, refusal, worst_point
from scripts.benchmarks.stability.scenes import PRECISIONS, applied, paper, walk
from scripts.benchmarks.stability.time_steps import moving_start, unit_error

GROUP = "poses"

DEVIATIONS = tuple(10.0**k for k in range(-16, -1))
_STEPS = 4
_UNIT = {"float64": 1e-15, "float32": 5e-7}


def cases() -> Iterator[Case]:
    for name, precision in product(INTEGRATORS, PRECISIONS):
        criterion = f"a unit dual quaternion again after {_STEPS} steps"
        run = partial(_return_to_manifold, name, precision)
        title = "pose off the unit dual quaternions by 1e-16 to 1e-2"
        yield Case(GROUP, title, applied(name, precision), criterion, run, _UNIT[precision], "1")
    for deviation in (1e-16, 1e-12, 1e-8):
        criterion = "accepted, and made a unit dual quaternion"
        run = partial(_accepted, deviation)
        yield Case(GROUP, f"initial state off by {deviation:g}", "environment", criterion, run, 1e-15, "1")
    for deviation in (1e-5, 1e-2):
        criterion = "refused, naming the norm"
        run = partial(_refused, deviation)
        yield Case(GROUP, f"initial state off by {deviation:g}", "environment", criterion, run)
        criterion = "refused, naming the norm"
        run = partial(_refused_target, deviation)
        yield Case(GROUP, f"target of a scene off by {deviation:g}", "scene", criterion, run)
    for axis in range(3):
        yield from _half_turns(axis)


def _half_turns(axis: int) -> Iterator[Case]:
    turn = f"attitude error of exactly 180 deg about {'xyz'[axis]}"
    criterion = "observation, reward and costs finite; attitude error is 180 deg"
    yield Case(GROUP, turn, "environment", criterion, partial(_environment, axis), 1e-6, "deg")
    criterion = "difference has the length pi, retract undoes it"
    yield Case(GROUP, turn, "tangent coordinates", criterion, partial(_difference, axis), 1e-14, "1")
    criterion = "states and controls of the guess are finite"
    yield Case(GROUP, turn, "expert's screw motion", criterion, partial(_guess, axis), 0.0, "1")


def _disturbed(x: FloatArray, deviation: float) -> FloatArray:
    """A state whose pose is off in its norm and in the product of its parts by about a deviation."""
    y = x.copy()
    y[:4] *= 1.0 + deviation
    y[4:8] += deviation * y[:4]
    return y


def _return_to_manifold(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels = paper(precision)
    curve, still, dt = [], np.zeros((_STEPS, kernels.n_u)), kernels.scene.simulation.dt
    for deviation in DEVIATIONS:
        x = _disturbed(moving_start(kernels), deviation)
        curve.append((deviation, unit_error(walk(kernels, x, still, dt, integrator)[-1:])))
    deviation, error = worst_point(curve)
    return Handled(error, f"most after {deviation:g}", tuple(curve))


def _accepted(deviation: float, effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    env.reset(options={"initial_state": _disturbed(env.kernels.layout.initial_state, deviation)})
    return Handled(unit_error(env.state[None, :]))


def _refused(deviation: float, effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    x = _disturbed(env.kernels.layout.initial_state, deviation)
    return refusal(lambda: env.reset(options={"initial_state": x}), naming="q_r")


def _refused_target(deviation: float, effort: Effort) -> Outcome:
    scene = load_scene("paper")
    pose = _disturbed(np.array(scene.target.pose.dual_quaternion), deviation).tolist()
    return refusal(lambda: scene.replace(target={"pose": pose}), naming="q_r")


def _half_turn_start(axis: int) -> FloatArray:
    """The paper's start, the base moved so that the tip is half a turn and 1 m off its target."""
    kernels = compile_scene("paper")
    x: FloatArray = kernels.layout.initial_state.copy()
    where = kernels.layout.state.pose
    rotation = [0.0] * 4
    rotation[1 + axis] = 1.0
    offset = poses.from_rotation_and_position(tuple(rotation), (1.0, 0.0, 0.0))
    wanted = dq.multiply(kernels.scene.target.pose.dual_quaternion, offset)
    tip = tuple(kernels.tip_pose(x).tolist())
    base_to_tip = dq.multiply(dq.conjugate(tuple(x[where].tolist())), tip)
    x[where] = dq.normalize(dq.multiply(wanted, dq.conjugate(base_to_tip)))
    return x


def _environment(axis: int, effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    observation, info = env.reset(options={"initial_state": _half_turn_start(axis)})
    numbers = [*observation, *(float(value) for value in info.values())]
    stepped, reward, _, _, after = env.step(np.zeros(env.kernels.n_u))
    numbers += [*stepped, reward, *(float(value) for value in after.values())]
    if not np.isfinite(numbers).all() or after["diverged"]:
        return Handled(np.inf)
    return Handled(abs(info["attitude_error"] - 180.0))


def _difference(axis: int, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    x = kernels.layout.initial_state.copy()
    turn = np.zeros(kernels.n_t)
    turn[axis] = np.pi
    half = kernels.retract(x, turn)
    back = kernels.difference(x, half)
    again = kernels.retract(x, back)
    # q and -q are one pose.
    apart = min(float(np.abs(again - half).max()), float(np.abs(again[:8] + half[:8]).max()))
    return Handled(largest(abs(float(np.linalg.norm(back)) - np.pi), apart))


def _guess(axis: int, effort: Effort) -> Outcome:
    motion = screw_motion(ArmProblem("paper"), _half_turn_start(axis))
    finite = all(np.isfinite(array).all() for array in motion if isinstance(array, np.ndarray))
    return Handled(0.0 if finite else np.inf)
