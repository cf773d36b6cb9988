"""Residuals at the end of a maneuver, and what a step reports and charges of all rows.

In the order of `scene.constraint_rows`; those along the path are in `constraint_residuals`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.algebra.vectors import dot, scale
from dq_space_arm_env.scene.constraint_rows import directions, exact_rows, path_rows, success_tolerances
from dq_space_arm_env.scene.constraints import Terminal
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.task.constraint_residuals import path_residuals, state_residuals
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.situation import Situation

Scalar = Any
Scalars = Sequence[Scalar]


def terminal_residuals(equations: SceneEquations, base: Scalars, y: Scalars) -> list[Scalar]:
    """Residuals of the rows at the end.

    Args:
        equations: The scene's, with the parameters of the end.
        base: Pose of the base q_{e0/I}, 8 scalars.
        y: The state without the pose.

    Returns:
        One scalar per row of `terminal_rows`.
    """
    return [*state_residuals(equations, base, y), *_final_residuals(equations, base, y)]


def _final_residuals(equations: SceneEquations, base: Scalars, y: Scalars) -> list[Scalar]:
    """Residuals of success and of what is exact.

    A tolerance t of success is (e^2 / t - t) / 2 of an error e: smooth where e is zero, e - t near t.
    """
    scene = equations.scene
    situation = Situation(equations, base, y, [0.0] * equations.field.n_u)
    error = dq.multiply(dq.conjugate(situation.pose("grasp")), situation.pose("tip"))  # q_{G/D}
    twist = dual_vectors.subtract(equations.tip_twist(situation.motion), _target_twist(equations, error))
    found = _success_residuals(scene, error, twist)
    if scene.other_tips:
        others = equations.other_errors(base, y), equations.other_twists(base, y)
        for own in zip(*others, strict=True):
            found += _success_residuals(scene, *own)
    halves = (scale(2.0, error[1:4]), poses.position(error))
    for constraint in scene.constraints:
        for quantity in constraint.exact if isinstance(constraint, Terminal) else ():
            values = _exact(situation, quantity, [*halves[0], *halves[1]], twist)
            found += [values[i] for i in directions(scene, quantity)]
    return found


def _success_residuals(scene: Scene, error: Scalars, twist: Scalars) -> list[Scalar]:
    """Those of a tip, by its error pose and its twist relative to its goal."""
    # |2 vec q_r| is 2 sin(angle / 2), the angle up to third order.
    vectors = (scale(2.0, error[1:4]), poses.position(error), twist[:3], twist[3:])
    names = ("attitude error", "position error", "angular velocity error", "velocity error")
    squares = {name: dot(vector, vector) for name, vector in zip(names, vectors, strict=True)}
    found = []
    for name, _, tolerance in success_tolerances(scene):
        bound = 2.0 * math.sin(0.5 * min(tolerance, math.pi)) if name == names[0] else tolerance
        found.append(0.5 * (squares[name] / bound - bound))
    return found


def _target_twist(equations: SceneEquations, error: Scalars) -> Scalars:
    """Twist of the target in the tip's axes, by the pose q_{G/D}."""
    return dual_vectors.inverse_transform(*poses.to_matrix(error), equations.target_velocity)


def _exact(situation: Situation, quantity: str, pose: Scalars, twist: Scalars) -> Scalars:
    """What is zero where a quantity is exact at the end."""
    if quantity == "pose":
        return pose
    if quantity == "twist":
        return twist
    if quantity == "base_velocity":
        moving = (*situation.motion.angular, *situation.motion.linear)
        desired = situation.equations.desired_base_velocity(situation.base)
        return [a - b for a, b in zip(moving, desired, strict=True)]
    linear, angular, _ = situation.momentum()
    return linear if quantity == "linear_momentum" else angular


def reported(
    before: SceneEquations, after: SceneEquations, x: Scalars, u: Scalars, x_next: Scalars
) -> list[Scalar]:
    """Residuals that a step from x to x_next reports: of its end, of x and u where the input counts.

    Args:
        before: The equations before the step.
        after: Those after it.
        x: State before the step, n_x scalars.
        u: Input, n_u scalars.
        x_next: State after the step, n_x scalars.

    Returns:
        One scalar per name of `step_report.constraint_names`.
    """
    scene, there = after.scene, (after.base_pose(x_next), after.y(x_next))
    first = path_residuals(before, before.base_pose(x), before.y(x), u)
    second = iter(terminal_residuals(after, *there))
    along = [c if row.has_input else next(second) for row, c in zip(path_rows(scene), first, strict=True)]
    exact = exact_rows(scene)
    return along + (list(second)[-len(exact) :] if exact else [])


def charged(scene: Scene, residuals: Scalars, at_end: Scalar) -> tuple[Scalar, Scalar]:
    """Sum of violations, each over its tolerance, and whether one of them ends the episode.

    Args:
        scene: The scene.
        residuals: Those of `reported`.
        at_end: Whether the episode ends anyway: what is exact at the end is charged then, or when a
            violation ends it.

    Returns:
        The sum, dimensionless, and a truth value.
    """
    cost, ends = 0.0, False
    rows = (*path_rows(scene), *exact_rows(scene))
    for row, c in zip(rows, residuals, strict=True):
        if row.terminates:
            ends = casadi.logic_or(ends, c > row.tolerance)
    at_end = casadi.logic_or(at_end, ends)
    for row, c in zip(rows, residuals, strict=True):  # NaN stays: maxima are the second number then
        violation = casadi.if_else(at_end, casadi.fabs(c), 0.0) if row.is_equality else casadi.fmax(0.0, c)
        cost = cost + violation / row.tolerance
    return cost, ends
