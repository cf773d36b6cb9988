"""Extreme problems for the expert: its stop reason must be true, its trajectory a rollout of its inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics.vector_field import PoseCoordinates
from dq_space_arm_env.scene import InitialState
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import StopReason
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray, StageParameters
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, Outcome, refusal
from scripts.benchmarks.stability.scenes import walk

GROUP = "expert"

_STEPS = 150
_MOST_ITERATIONS = 100
_TWO_JOINTS = "two joints"
_AT_TARGET = (_TWO_JOINTS, "paper")
_TRUE = "stop reason true, all finite; states are the rollout of inputs within their limits"


def cases() -> Iterator[Case]:
    problems: dict[str, Callable[[], ArmProblem]] = {
        "limits of 1e-6": partial(_with_limits, 1e-6),
        "infinite limits": partial(_with_limits, np.inf),
        "weights spread over 1e12": _with_spread_weights,
        "horizon of 1": partial(_short, 1),
        "target 1 km away, out of reach": _with_far_target,
        "huge initial momentum": partial(_moving, 3.0, 5.0, 0.01),
        "a motion that overflows": partial(_moving, 1e3, 100.0, 0.05),
        "springs of 1e8 N m/rad, beyond the integrator's limit": _with_stiff_joints,
    }
    for name, make in problems.items():
        yield Case(GROUP, name, "BoxDDP", _TRUE, partial(_solve, make), 1e-12, "of the states")
    solvers: tuple[Callable[[ArmProblem], BoxDDP | GuidedDDP], ...] = (BoxDDP, GuidedDDP)
    for scene in _AT_TARGET:
        for solver in solvers:
            criterion = "converged without an iteration, all finite; the tip stays where it is"
            run = partial(_solve_at_target, scene, solver)
            title = f"start at the target, {scene}"
            yield Case(GROUP, title, solver.__name__, criterion, run, 1e-12, "rad, m")
    title = "horizon of 20,000; of 2,000 in a quick run"
    yield Case(GROUP, title, "BoxDDP", _TRUE, _long_horizon, 1e-12, "of the states")
    for limit in (0.0, -1.0, np.nan):
        name, run = f"limit of {limit:g}", partial(_refused_limit, limit)
        yield Case(GROUP, name, "scene", "refused, naming the limit", run)
    yield Case(GROUP, "horizon of 0", "scene", "refused, naming the steps", _refused_horizon)


def _scene(**changes: Any) -> Scene:
    """A planar arm of two joints, and a maneuver of few stages."""
    planar = load_scene("planar")
    start = InitialState(joint_angles=(0.5, -1.2))
    links = [link.model_dump() for link in planar.links[:2]]
    simulation = {"steps": _STEPS, "dt": 0.05}
    fields = {"links": links, "initial_state": start, "simulation": simulation, "name": _TWO_JOINTS}
    return planar.replace(**{**fields, **changes})


def _short(steps: int = _STEPS) -> ArmProblem:
    """The maneuver; changes outside the machine code need no new compilation."""
    problem = ArmProblem(_scene())
    problem.horizon, problem.parameters = steps, StageParameters(steps)
    return problem


def _with_limits(limit: float) -> ArmProblem:
    actuators = ("base_force", "base_torque", "joint_torque")
    return ArmProblem(_scene(actuators={name: {"limit": limit} for name in actuators}))


def _with_spread_weights() -> ArmProblem:
    cost = {"pose": 1e6, "terminal_pose": 1e6, "joint_torque": 1e-6, "base_force": 1.0, "base_torque": 1e-3}
    return ArmProblem(_scene(cost=cost))


def _with_far_target() -> ArmProblem:
    return ArmProblem(_scene(target={"pose": {"position": [1e3, 0.0, 0.0]}}))


def _moving(joint_rate: float, velocity: float, time_step: float) -> ArmProblem:
    problem = _short()
    where, x = problem.kernels.layout.state, problem.initial_state.copy()
    x[where.joint_rates] = [joint_rate, -joint_rate]
    x[where.base_velocity] = [joint_rate, velocity, -velocity]
    problem.initial_state, problem.time_step = x, time_step
    return problem


def at_target(problem: ArmProblem) -> ArmProblem:
    """Move the base of a problem until the tip is at its target: a maneuver that is over when it begins."""
    layout, x = problem.kernels.layout, problem.initial_state.copy()
    where = layout.state.pose
    directions = PLANAR_TWIST if layout.planar else tuple(range(6))
    field = PoseCoordinates(PLANAR_POSE if layout.planar else tuple(range(8)), directions, ())
    base, tip = tuple(field.full(x[where].tolist())), tuple(problem.kernels.tip_pose(x).tolist())
    base_to_tip = dq.multiply(dq.conjugate(base), tip)
    target = problem.scene.target.pose.dual_quaternion
    x[where] = field.reduced(dq.normalize(dq.multiply(target, dq.conjugate(base_to_tip))))
    problem.initial_state = x
    return problem


def _with_stiff_joints() -> ArmProblem:
    scene = _scene()
    return ArmProblem(scene.replace(links=[{**link.model_dump(), "stiffness": 1e8} for link in scene.links]))


def _solve(make: Callable[[], ArmProblem], effort: Effort) -> Outcome:
    problem = make()
    return _check(problem, BoxDDP(problem, max_iterations=_MOST_ITERATIONS))


def _solve_at_target(
    scene: str, solver: Callable[[ArmProblem], BoxDDP | GuidedDDP], effort: Effort
) -> Outcome:
    problem = at_target(_short() if scene == _TWO_JOINTS else ArmProblem(scene))
    solution = solver(problem).solve()
    outcome = f"{solution.stop_reason.value} after {solution.iterations} iterations: {solution.message}"
    finite = all(np.isfinite(array).all() for array in (solution.states, solution.feedback_gains))
    if not (solution.converged and solution.iterations == 0 and finite):
        return Handled(np.inf, outcome)
    angle, distance = problem.kernels.observation(solution.states[-1], [0.0])[1]
    return Handled(max(float(angle), float(distance)), outcome)


def _check(problem: ArmProblem, solver: BoxDDP) -> Outcome:
    solution = solver.solve()
    outcome = f"{solution.stop_reason.value} after {solution.iterations} iterations: {solution.message}"
    if solution.stop_reason is StopReason.DIVERGED:
        # True only if doing nothing overflows.
        still = np.zeros((problem.horizon, problem.n_controls))
        truth = not np.isfinite(_rollout(problem, still)).all()
        return Handled(0.0 if truth and not np.isfinite(solution.cost) else np.inf, outcome)
    arrays = (solution.states, solution.controls, solution.feedback_gains, np.array([solution.cost]))
    if not all(np.isfinite(array).all() for array in arrays):
        return Handled(np.inf, f"{outcome}; not all of the solution is finite")
    if solution.converged != (solution.optimality <= solver.tolerance):
        return Handled(np.inf, f"{outcome}; the measure of convergence is {solution.optimality:.1e}")
    outside = np.abs(solution.controls) > problem.control_upper
    if outside.any():
        return Handled(np.inf, f"{outcome}; {outside.sum()} inputs are beyond their limits")
    states = _rollout(problem, solution.controls)
    apart = np.abs(states - solution.states).max() / np.abs(states).max()
    return Handled(float(apart), outcome)


def _rollout(problem: ArmProblem, controls: FloatArray) -> FloatArray:
    return walk(problem.kernels, problem.initial_state, controls, problem.time_step)


def _long_horizon(effort: Effort) -> Outcome:
    problem = _short(effort.long_horizon)
    problem.time_step = 30.0 / effort.long_horizon
    return _check(problem, BoxDDP(problem, max_iterations=_MOST_ITERATIONS))


def _refused_limit(limit: float, effort: Effort) -> Outcome:
    return refusal(lambda: _scene(actuators={"base_force": {"limit": limit}}), naming="limit")


def _refused_horizon(effort: Effort) -> Outcome:
    return refusal(lambda: _scene(simulation={"steps": 0}), naming="steps")
