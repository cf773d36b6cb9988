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

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.algebra.vectors import norm
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import moving_numbers, target_entries, velocity_entries
from dq_space_arm_env.scene.parameters import parameters as all_parameters
from dq_space_arm_env.scene.path import advanced
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import episode_start, parameter_values
from dq_space_arm_env.task.equations import (
    SceneEquations,
    body_pose,
    body_velocity,
    total,
    weighted_square,
)
from dq_space_arm_env.task.step_report import MEMORY, STATE_LIMIT, has_twist_errors, report_names
from dq_space_arm_env.task.worst_case import WorstCase

Scalar = Any
Scalars = Sequence[Scalar]
Outputs = Mapping[str, Scalars]

DEGREES = 180.0 / math.pi


def start(scene: Scene, draws: Scalars) -> Outputs:
    """State, memory and parameters at the start, from draws in [-1, 1]."""
    begun = episode_start(scene, draws)
    parameters = parameter_values(scene, begun)
    given = dict(zip((number.name for number in all_parameters(scene)), parameters, strict=True))
    target = [given[number.name] for number in moving_numbers(scene)]
    outputs = {"x": begun.state, "memory": [0.0] * len(MEMORY) + target}
    return {**outputs, "parameters": parameters} if parameters else outputs


def command(equations: SceneEquations, action: Scalars) -> Outputs:
    """Inputs in N, N m, rad/s, from an action that is clipped to [-1, 1]."""
    # Ordered such that NaN passes: if two numbers do not compare, fmin and fmax take the second.
    clipped = [casadi.fmin(1.0, casadi.fmax(-1.0, value)) for value in action]
    return {"u": [limit * value for limit, value in zip(equations.control_limits, clipped, strict=True)]}


def observe(equations: SceneEquations, x: Scalars, memory: Scalars) -> Outputs:
    """Observation and report of a state, without a step."""
    scene, target = equations.scene, memory[len(MEMORY) :]
    equations = with_target(equations, target)
    seen = equations.observe(x, (scene.simulation.steps - memory[0]) * scene.simulation.dt)
    errors = tip_errors(equations, x, seen["errors"])
    costs = [0.0] * (len(report_names(scene)) - len(errors) - 1)
    return {
        "memory_kept": [memory[0], *equations.state_cost_terms(x), *target],
        "observation": seen["observation"],
        "report": [*costs, *errors, 0.0],
        "flags": [0.0, is_success(scene, errors), 0.0],
    }


def step(
    equations: SceneEquations,
    x: Scalars,
    x_next: Scalars,
    u: Scalars,
    memory: Scalars,
    checked_error: Scalars = (math.nan,),
    following: Scalars = (),
) -> Outputs:
    """Observation, reward, and end of the episode after a step from x to x_next, with its error.

    Where the target passes waypoints, `following` is the next row of `given_path`.
    """
    scene = equations.scene
    steps, dt = scene.simulation.steps, scene.simulation.dt
    taken, *state_terms = memory[: len(MEMORY)]
    remaining = steps - taken
    before = with_target(equations, memory[len(MEMORY) :])
    target = next_target(before, body_pose(scene, equations.given), following)
    after = with_target(equations, target)

    # The episode ends at the scene's number of steps, or when the simulation diverges, which leaves it at the
    # last sound state. NaN is not below any limit.
    sound = total([entry * entry for entry in x_next]) <= STATE_LIMIT**2
    x_kept = [casadi.if_else(sound, new, old) for new, old in zip(x_next, x, strict=True)]
    terminated = casadi.logic_or(taken == steps - 1, casadi.logic_not(sound))

    seen = after.observe(x_kept, (remaining - 1.0) * dt)
    errors = tip_errors(after, x_kept, seen["errors"])

    # reward = -(stage cost of x and u) - (terminal cost of x_next at the end): the return is -J. After a
    # divergence the most that this and all further steps could cost is charged, so ending early never pays.
    stage = [*state_terms, equations.effort(u), *before.twist_cost_terms(x, u)]
    terminal = [casadi.if_else(terminated, term, 0.0) for term in after.terminal_cost_terms(x_kept)]
    reward = -casadi.if_else(sound, total(stage) + total(terminal), WorstCase(before).cost(x, remaining))

    success = casadi.logic_and(sound, is_success(scene, errors))
    return {
        "x_kept": x_kept,
        "memory_kept": [taken + sound, *after.state_cost_terms(x_kept), *target],
        "observation": seen["observation"],
        "report": [reward, *stage, *terminal, *errors, *checked_error],
        "flags": [terminated, success, casadi.logic_not(sound)],
    }


def compare_goals(scene: Scene, achieved: Scalars, desired: Scalars) -> Outputs:
    """Errors, pose cost and success of a pose of the tip for any goal, each 8 numbers."""
    angle = poses.error_angle(achieved, desired) * DEGREES
    distance = poses.error_distance(achieved, desired)
    # q and -q are the same goal: the nearer one counts.
    signs = (desired, [-entry for entry in desired])
    cost = casadi.fmin(*(weighted_square(achieved, goal, scene.cost.pose) for goal in signs))
    return {"errors": [angle, distance], "cost": [cost], "is_success": [is_success(scene, [angle, distance])]}


def with_target(equations: SceneEquations, target: Scalars) -> SceneEquations:
    """The equations where the target is now: the numbers of its pose and velocity, none if it is at rest."""
    scene, names = equations.scene, [number.name for number in moving_numbers(equations.scene)]
    if not names:
        return equations
    given = {**equations.given, **dict(zip(names, target, strict=True))}
    return SceneEquations.of(scene, [given[number.name] for number in all_parameters(scene)])


def next_target(equations: SceneEquations, start: Scalars, following: Scalars = ()) -> list[Scalar]:
    """Pose and velocity of the target's body a step later, from its first pose; the numbers that vary."""
    scene, motion = equations.scene, equations.scene.target.motion
    if motion is None:
        return []
    if isinstance(motion, Waypoints):
        pose: Scalars = dq.multiply(start, following[:8])
        velocity = following[8:]
    else:
        now = body_pose(scene, equations.given), body_velocity(scene, equations.given)
        pose, velocity = advanced(motion, *now, scene.simulation.dt)
    return [*(pose[i] for i in target_entries(scene)), *(velocity[i] for i in velocity_entries(scene))]


def tip_errors(equations: SceneEquations, x: Scalars, errors: Scalars) -> list[Scalar]:
    """Angle in degrees and distance in m; where they are reported, angular velocity in deg/s and velocity."""
    shown = [errors[0] * DEGREES, errors[1]]
    if has_twist_errors(equations.scene):
        twist = equations.relative_twist(x)
        shown += [norm(twist[:3]) * DEGREES, norm(twist[3:])]
    return shown


def is_success(scene: Scene, errors: Scalars) -> Scalar:
    """Whether the tip is within the scene's tolerances, as far as errors are given."""
    success = scene.success
    pose = success.attitude_error_deg, success.position_error
    largest = (*pose, success.angular_velocity_error_deg, success.velocity_error)
    met: Scalar = None
    for error, most in zip(errors, largest, strict=False):
        if most is not None:
            met = error <= most if met is None else casadi.logic_and(met, error <= most)
    return met
