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
from dq_space_arm_env.scene.maneuver import Success
from dq_space_arm_env.scene.motion import Waypoints
from dq_space_arm_env.scene.parameters import (
    PHASE,
    catch_numbers,
    is_part,
    moving_numbers,
    target_entries,
    velocity_entries,
)
from dq_space_arm_env.scene.parameters import parameters as all_parameters
from dq_space_arm_env.scene.path import advanced
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import episode_start, parameter_values
from dq_space_arm_env.task.actuator_limits import applied
from dq_space_arm_env.task.catching import Catching, has_catch
from dq_space_arm_env.task.constraint_residuals import observed_besides
from dq_space_arm_env.task.equations import (
    SceneEquations,
    body_pose,
    body_velocity,
    compared_poses,
    larger,
    total,
    weighted_square,
)
from dq_space_arm_env.task.step_report import MEMORY, STATE_LIMIT, has_twist_errors, report_names
from dq_space_arm_env.task.terminal_residuals import charged, reported
from dq_space_arm_env.task.worst_case import worst_cost

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
    held = [1.0] if has_catch(scene) else []
    outputs = {"x": begun.state, "memory": [0.0] * len(MEMORY) + target + held}
    return {**outputs, "parameters": parameters} if parameters else outputs


def command(equations: SceneEquations, action: Scalars, x: Scalars = ()) -> Outputs:
    """Inputs in N, N m, rad/s, from an action that is clipped to [-1, 1], as the actuators apply them."""
    # Ordered such that NaN passes: if two numbers do not compare, fmin and fmax take the second.
    jets = equations.layout.control.thruster_force  # below 0 they are off
    least = [0.0 if jets.start <= index < jets.stop else -1.0 for index in range(len(action))]
    clipped = [casadi.fmin(1.0, casadi.fmax(low, value)) for low, value in zip(least, action, strict=True)]
    asked = [limit * value for limit, value in zip(equations.control_limits, clipped, strict=True)]
    return {"u": applied(equations, x, asked)}


def observe(equations: SceneEquations, x: Scalars, memory: Scalars) -> Outputs:
    """Observation and report of a state, without a step."""
    scene, layout, rest = equations.scene, equations.layout, memory[len(MEMORY) :]
    equations = at_stage(equations, memory[0], rest)
    view = seen(equations, x, (scene.simulation.steps - memory[0]) * scene.simulation.dt)
    errors = tip_errors(equations, x, view["errors"])
    errors += [equations.given[PHASE]] if scene.phases else []
    catching = [rest[-1], 0.0, 0.0] if has_catch(scene) else []
    u = [0.0] * equations.field.n_u
    for control, value in zip(layout.previous_controls, x[layout.state.actuators], strict=True):
        u[control] = value  # they do not change before the first step
    residuals = reported(equations, equations, x, u, x) if scene.constraints else []
    charge = [charged(scene, residuals, at_end=0.0)[0]] if scene.constraints else []
    last = [*errors, *catching, 0.0, *charge, *residuals]
    costs = [0.0] * (len(report_names(scene)) - len(last))
    success = is_success(scene, errors)
    if catching:
        success = casadi.logic_and(success, catching[0])
    return {
        "memory_kept": [memory[0], *equations.state_cost_terms(x), *rest],
        "observation": view["observation"],
        "report": [*costs, *last],
        "flags": [0.0, success, 0.0],
    }


def step(
    equations: SceneEquations,
    x: Scalars,
    x_next: Scalars,
    u: Scalars,
    memory: Scalars,
    worst: Scalars,
    unsound: Scalars = (),
    checked_error: Scalars = (math.nan,),
    following: Scalars = (),
) -> Outputs:
    """Observation, reward, and end of the episode after a step from x to x_next, with its error.

    `worst`, `most_cost`, is read only where the episode ends early; `unsound`, whether the simulation
    `diverged`, may be given where nothing is caught. Where the target passes waypoints, `following` is the
    next row of `given_path`.
    """
    scene = equations.scene
    steps, dt = scene.simulation.steps, scene.simulation.dt
    taken, *state_terms = memory[: len(MEMORY)]
    remaining = steps - taken
    before = at_stage(equations, taken, memory[len(MEMORY) :])
    target = next_target(before, body_pose(scene, equations.given), following)
    rest, caught = target, []
    if has_catch(scene):
        # The way of waypoints goes on where a phase has the target at rest.
        there = _resting(scene, taken, target) if isinstance(scene.target.motion, Waypoints) else target
        x_next, *caught = _catch(with_target(before, there), x_next, taken + 1.0, memory[-1])
        rest = [*target, caught[0]]
    rest = _resting(scene, taken + 1.0, rest)
    after = at_stage(equations, taken + 1.0, rest)

    # The episode ends at the scene's number of steps, or when the simulation diverges, which leaves it at the
    # last sound state.
    sound = casadi.logic_not((unsound or diverged(x_next)["unsound"])[0])
    x_kept = [casadi.if_else(sound, new, old) for new, old in zip(x_next, x, strict=True)]
    at_end = casadi.logic_or(taken == steps - 1, casadi.logic_not(sound))
    terminated, finished, charges = at_end, sound, []
    if scene.constraints:
        residuals = reported(before, after, x, u, x_kept)
        charge, ends = charged(scene, residuals, at_end)
        charges = [charge, *residuals]
        terminated, finished = casadi.logic_or(at_end, ends), casadi.logic_and(sound, casadi.logic_not(ends))

    view = seen(after, x_kept, (remaining - 1.0) * dt)
    errors = tip_errors(after, x_kept, view["errors"])
    errors += [after.given[PHASE]] if scene.phases else []

    # reward = -(stage cost of x and u) - (terminal cost of x_next at the end): the return is -J. After a
    # divergence, or a violation that ends the episode, the most that this and all further steps could cost is
    # charged, so ending early never pays.
    stage = [*state_terms, before.effort(u), *before.twist_cost_terms(x, u)]
    terminal = [casadi.if_else(terminated, term, 0.0) for term in after.terminal_cost_terms(x_kept)]
    reward = -casadi.if_else(finished, total(stage) + total(terminal), worst[0])

    success = casadi.logic_and(finished, is_success(scene, errors))
    if caught:
        success = casadi.logic_and(success, caught[0])
    return {
        "x_kept": x_kept,
        "memory_kept": [taken + sound, *after.state_cost_terms(x_kept), *rest],
        "observation": view["observation"],
        "report": [reward, *stage, *terminal, *errors, *caught, *checked_error, *charges],
        "flags": [terminated, success, casadi.logic_not(sound)],
    }


def diverged(x_next: Scalars) -> Outputs:
    """Whether a step has ended beyond all limits; NaN is not below any."""
    return {"unsound": [casadi.logic_not(total([entry * entry for entry in x_next]) <= STATE_LIMIT**2)]}


def most_cost(equations: SceneEquations, x: Scalars, memory: Scalars) -> Outputs:
    """The most that the rest of an episode could cost, charged where it ends early."""
    before = at_stage(equations, memory[0], memory[len(MEMORY) :])
    remaining = equations.scene.simulation.steps - memory[0]
    return {"worst": [worst_cost(before, _every_phase(before), x, remaining)]}


def seen(equations: SceneEquations, x: Scalars, time_left: Scalar) -> dict[str, list[Scalar]]:
    """Observation, and the errors of the tips: angle in rad, distance in m."""
    besides = observed_besides(equations, equations.base_pose(x), equations.y(x))
    return equations.observe(x, time_left, besides)


def compare_goals(scene: Scene, achieved: Scalars, desired: Scalars) -> Outputs:
    """Errors, pose cost and success of a pose of the tip for any goal, each 8 numbers."""
    angle = poses.error_angle(achieved, desired) * DEGREES
    distance = poses.error_distance(achieved, desired)
    # q and -q are the same goal: the nearer one counts.
    signs = (desired, [-entry for entry in desired])
    errors = (compared_poses(scene, achieved, goal) for goal in signs)
    cost = casadi.fmin(*(weighted_square(*error, scene.cost.pose) for error in errors))
    return {"errors": [angle, distance], "cost": [cost], "is_success": [is_success(scene, [angle, distance])]}


def with_target(equations: SceneEquations, target: Scalars) -> SceneEquations:
    """The equations where the target is now: the numbers of its pose and velocity, none if it is at rest."""
    scene, names = equations.scene, [number.name for number in moving_numbers(equations.scene)]
    if not names:
        return equations
    given = {**equations.given, **dict(zip(names, target, strict=True))}
    return SceneEquations.of(scene, [given[number.name] for number in all_parameters(scene)])


def at_stage(equations: SceneEquations, stage: Scalar, rest: Scalars) -> SceneEquations:
    """The equations at a stage: `rest` of the memory is the target now, and whether the payload is held."""
    scene = equations.scene
    if not scene.phases:
        return with_target(equations, rest)
    size, starts = len(moving_numbers(scene)), scene.staged.starts
    given = {**equations.given, **{number.name: 0.0 for number in catch_numbers(scene)}}
    given |= {name: by_phase(stage, starts, values) for name, values in scene.staged.values.items()}
    if has_catch(scene):
        given |= {name: rest[size] * value for name, value in given.items() if is_part(name, "payload")}
    moving = zip(moving_numbers(scene), rest[:size], strict=True)
    given |= {number.name: value for number, value in moving}
    return SceneEquations.of(scene, [given[number.name] for number in all_parameters(scene)])


def by_phase(stage: Scalar, starts: Sequence[int], values: Sequence[float]) -> Scalar:
    """The value of the phase that a stage is in."""
    found: Scalar = values[0]
    for start, before, value in zip(starts[1:], values, values[1:], strict=False):
        if value != before:
            found = casadi.if_else(stage >= start, value, found)
    return found


def _catch(equations: SceneEquations, x: Scalars, stage: Scalar, held: Scalar) -> list[Any]:
    """State after the catch that a stage may begin with; whether the payload is held, and both impulses.

    The payload moves with the target until then. It is missed beyond the phase's tolerances.
    """
    scene, twist = equations.scene, equations.target_velocity
    catching, caught_state = Catching(equations), list(x)
    caught = catching(x, twist)
    shock: list[Scalar] = [0.0, 0.0]
    tip = equations.tip(x)
    errors = [poses.error_angle(tip, equations.target) * DEGREES, poses.error_distance(tip, equations.target)]
    relative = equations.relative_twist(x)
    errors += [norm(relative[:3]) * DEGREES, norm(relative[3:])]
    for start, phase in zip(scene.staged.starts, scene.phases, strict=True):
        if phase.catch is not None:
            due = stage == start
            met = casadi.logic_and(due, within(phase.catch, errors))
            held = casadi.if_else(due, met, held)
            caught_state = [casadi.if_else(met, a, b) for a, b in zip(caught, caught_state, strict=True)]
            impulses = catching.shock(caught, twist)
            shock = [casadi.if_else(met, a, b) for a, b in zip(impulses, shock, strict=True)]
    return [caught_state, held, *shock]


def _resting(scene: Scene, stage: Scalar, rest: Scalars) -> list[Scalar]:
    """The rest of the memory where a phase has the target at rest."""
    found = list(rest)
    for index, start in enumerate(scene.staged.starts if scene.phases else ()):
        still = list(_at_rest(scene, index).values())
        found[: len(still)] = [
            casadi.if_else(stage >= start, a, b) for a, b in zip(still, found, strict=False)
        ]
    return found


def _at_rest(scene: Scene, phase: int) -> dict[str, float]:
    """The numbers of a target that moves in other phases and is at rest in this one; none if it moves."""
    names, pose = [number.name for number in moving_numbers(scene)], scene.staged.resting[phase]
    if not names or pose is None:
        return {}
    still = [*(pose[i] for i in target_entries(scene)), *[0.0] * len(velocity_entries(scene))]
    return dict(zip(names, still, strict=True))


def _every_phase(equations: SceneEquations) -> list[SceneEquations]:
    """The equations with the numbers of each phase, and with its target where that is at rest."""
    scene = equations.scene
    if not scene.phases:
        return [equations]
    found = []
    for index in range(len(scene.phases)):
        own = {name: values[index] for name, values in scene.staged.values.items()}
        given = {**equations.given, **own, **_at_rest(scene, index)}
        found.append(SceneEquations.of(scene, [given[number.name] for number in all_parameters(scene)]))
    return found


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
        speeds = [norm(twist[:3]), norm(twist[3:])]
        for own in equations.other_twists(equations.base_pose(x), equations.y(x)):
            speeds = [larger(a, norm(b)) for a, b in zip(speeds, (own[:3], own[3:]), strict=True)]
        shown += [speeds[0] * DEGREES, speeds[1]]
    return shown


def is_success(scene: Scene, errors: Scalars) -> Scalar:
    """Whether the tip is within the scene's tolerances, as far as errors are given."""
    return within(scene.success, errors)


def within(success: Success, errors: Scalars) -> Scalar:
    """Whether the tip is within tolerances, as far as errors are given."""
    met: Scalar = None
    for error, most in zip(errors[:4], success.tolerances, strict=False):
        if most < math.inf:
            met = error <= most if met is None else casadi.logic_and(met, error <= most)
    return met
