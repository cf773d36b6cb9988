"""An episode of the environment in equations: actions, observation, reward, success and end.

Written over plain scalars, like the dynamics; `kernels.programs.environment_programs` traces these functions,
and `DQSpaceArmEnv.step` runs the machine code that comes of them. A step is

    u = command(a),  x' = integrator(x, u),  then step(x, x', u, memory).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import episode_start, parameter_values
from dq_space_arm_env.task.equations import SceneEquations, total, weighted_square
from dq_space_arm_env.task.step_report import MEMORY, REPORT, STATE_LIMIT
from dq_space_arm_env.task.worst_case import WorstCase

Scalar = Any
Scalars = Sequence[Scalar]
Outputs = Mapping[str, Scalars]

DEGREES = 180.0 / math.pi


def start(scene: Scene, draws: Scalars) -> Outputs:
    """State, memory and parameters at the start, from draws in [-1, 1]."""
    begun = episode_start(scene, draws)
    parameters = parameter_values(scene, begun)
    outputs = {"x": begun.state, "memory": [0.0] * len(MEMORY)}
    return {**outputs, "parameters": parameters} if parameters else outputs


def command(equations: SceneEquations, action: Scalars) -> Outputs:
    """Inputs in N, N m, rad/s, from an action that is clipped to [-1, 1]."""
    # Ordered such that NaN passes: if two numbers do not compare, fmin and fmax take the second.
    clipped = [casadi.fmin(1.0, casadi.fmax(-1.0, value)) for value in action]
    return {"u": [limit * value for limit, value in zip(equations.control_limits, clipped, strict=True)]}


def observe(equations: SceneEquations, x: Scalars, memory: Scalars) -> Outputs:
    """Observation and report of a state, without a step."""
    scene = equations.scene
    seen = equations.observe(x, (scene.simulation.steps - memory[0]) * scene.simulation.dt)
    angle, distance = _shown_errors(seen["errors"])
    costs = [0.0] * (len(REPORT) - 3)
    return {
        "memory_kept": [memory[0], *equations.state_cost_terms(x)],
        "observation": seen["observation"],
        "report": [*costs, angle, distance, 0.0],
        "flags": [0.0, _is_success(scene, angle, distance), 0.0],
    }


def step(
    equations: SceneEquations,
    x: Scalars,
    x_next: Scalars,
    u: Scalars,
    memory: Scalars,
    checked_error: Scalars = (math.nan,),
) -> Outputs:
    """Observation, reward, and end of the episode after a step from x to x_next, with its error."""
    scene = equations.scene
    steps, dt = scene.simulation.steps, scene.simulation.dt
    taken, *state_terms = memory
    remaining = steps - taken

    # The episode ends at the scene's number of steps, or when the simulation diverges, which leaves it at the
    # last sound state. NaN is not below any limit.
    sound = total([entry * entry for entry in x_next]) <= STATE_LIMIT**2
    x_kept = [casadi.if_else(sound, new, old) for new, old in zip(x_next, x, strict=True)]
    terminated = casadi.logic_or(taken == steps - 1, casadi.logic_not(sound))

    seen = equations.observe(x_kept, (remaining - 1.0) * dt)
    angle, distance = _shown_errors(seen["errors"])

    # reward = -(stage cost of x and u) - (terminal cost of x_next at the end): the return is -J. After a
    # divergence the most that this and all further steps could cost is charged, so ending early never pays.
    stage = [*state_terms, equations.effort(u)]
    terminal = [casadi.if_else(terminated, term, 0.0) for term in equations.terminal_cost_terms(x_kept)]
    reward = -casadi.if_else(sound, total(stage) + total(terminal), WorstCase(equations).cost(x, remaining))

    success = casadi.logic_and(sound, _is_success(scene, angle, distance))
    return {
        "x_kept": x_kept,
        "memory_kept": [taken + sound, *equations.state_cost_terms(x_kept)],
        "observation": seen["observation"],
        "report": [reward, *stage, *terminal, angle, distance, *checked_error],
        "flags": [terminated, success, casadi.logic_not(sound)],
    }


def compare_goals(scene: Scene, achieved: Scalars, desired: Scalars) -> Outputs:
    """Errors, pose cost and success of a pose of the tip for any goal, each 8 numbers."""
    errors = [poses.error_angle(achieved, desired), poses.error_distance(achieved, desired)]
    angle, distance = _shown_errors(errors)
    # q and -q are the same goal: the nearer one counts.
    signs = (desired, [-entry for entry in desired])
    cost = casadi.fmin(*(weighted_square(achieved, goal, scene.cost.pose) for goal in signs))
    return {"errors": [angle, distance], "cost": [cost], "is_success": [_is_success(scene, angle, distance)]}


def _shown_errors(errors: Scalars) -> tuple[Scalar, Scalar]:
    """Angle in degrees, distance in m."""
    return errors[0] * DEGREES, errors[1]


def _is_success(scene: Scene, angle: Scalar, distance: Scalar) -> Scalar:
    """Whether the tip is within the scene's tolerances."""
    success = scene.success
    return casadi.logic_and(angle <= success.attitude_error_deg, distance <= success.position_error)
