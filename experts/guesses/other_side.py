"""A guess on the other side of an obstacle: the maneuver that it pushes aside, mirrored through it.

Paths that pass an obstacle on different sides cannot be bent into one another: a solver finds the cheapest of
its guess's own class. Where a solved maneuver has multipliers of a distance row, the obstacle is in its way.
The row's derivative by a translation of the robot tells its normal there; it vanishes where the obstacle
moves along with the robot. Moved across the obstacle along that normal, for as long as the contact lasts, the
tip's path is of the other class, and the arm follows it (`screw_motion`).
"""

from typing import NamedTuple

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.scene.constraint_rows import pairs_that_may_touch, rows_of
from dq_space_arm_env.scene.constraints import Distance
from dq_space_arm_env.scene.pose import PLANAR_TWIST
from dq_space_arm_env.scene.schema import Scene
from experts.ddp.solution import Solution
from experts.guesses.screw_motion import N_INTERVALS, ScrewMotion, TipPath, follow_path
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray

ACROSS = 3.0
"""Motion of the tip across an obstacle, in distances between the axes of the volumes that touch."""
PUSHED = 1e-6
"""Multiplier beyond which a row pushes."""
LEAST_RISE = 0.1
"""Least time, as a share of the horizon, in which the tip moves across, and back."""


class Contact(NamedTuple):
    """A row of a distance."""

    row: int  # among all rows along the path, those of rates of controls too
    apart: float  # how far the axes of its volumes are apart in contact, m


def other_side(problem: ArmProblem, solution: Solution) -> ScrewMotion | None:
    """Guess a maneuver that passes the obstacle in a solution's way on the other side.

    Args:
        problem: The maneuver, with constraints.
        solution: Its solution from some start.

    Returns:
        The guess from the same start; None if no obstacle is in the way.
    """
    if not solution.multipliers.size:  # it has diverged
        return None
    contacts = contacts_of(problem.scene)
    columns = np.array(list(contacts), dtype=int)
    pushes = solution.multipliers[:-1, columns]
    if not (pushes > PUSHED).any():
        return None
    column = int(columns[pushes.sum(axis=0).argmax()])
    stages = np.flatnonzero(solution.multipliers[:-1, column] > PUSHED)
    stage = int(solution.multipliers[:-1, column].argmax())
    normal = _normal(problem, solution, stage, contacts[column].row)
    if not normal.any():
        return None
    count, last = N_INTERVALS + 1, problem.horizon
    knots = np.rint(np.linspace(0, last, count)).astype(int)
    rise = max(stages[0] / last, LEAST_RISE)
    t = np.linspace(0.0, 1.0, count)
    share = _smooth(t / rise) * _smooth(1.0 - (t - stages[-1] / last) / rise)
    tips = problem.kernels.frame_poses(solution.states[knots])[:, -1]
    rotation, position = poses.to_rotation_and_position(tuple(tips.T))
    shift = -ACROSS * contacts[column].apart * np.outer(normal, share * _smooth((1.0 - t) / LEAST_RISE))
    path = np.stack(poses.from_rotation_and_position(rotation, np.asarray(position) + shift), axis=-1)
    step = last * problem.time_step / N_INTERVALS
    ways = screw.logarithm(dq.multiply(dq.conjugate(tuple(path[:-1].T)), tuple(path[1:].T)))
    velocities = np.stack([*ways], axis=-1) / step
    return follow_path(problem, solution.states[0], TipPath(path, np.vstack([velocities, velocities[-1:]])))


def contacts_of(scene: Scene) -> dict[int, Contact]:
    """The rows of distances, by their columns of multipliers; rows of rates have none."""
    found, row, column = {}, 0, 0
    for each in scene.constraints:
        rows = rows_of(scene, each)
        if isinstance(each, Distance):
            for i, (_, body, _, obstacle) in enumerate(pairs_that_may_touch(scene, each)):
                found[column + i] = Contact(row + i, body.radius + obstacle.radius + each.margin)
        row += len(rows)
        column += sum(not one.is_rate for one in rows)
    return found


def _normal(problem: ArmProblem, solution: Solution, stage: int, row: int) -> FloatArray:
    """Direction away from the obstacle, in inertial axes, shape (3,); zeros if it moves with the robot."""
    state, control, p = solution.states[stage], solution.controls[stage], solution.parameters[stage]
    slopes = problem.kernels.constraint_jacobian(state, control, p=p)[row]
    entries, twist = list(PLANAR_TWIST if problem.kernels.layout.planar else range(6)), np.zeros(6)
    twist[entries] = slopes[: len(entries)]
    base = problem.kernels.frame_poses(state[None])[0, 0]
    away = -np.asarray(poses.to_matrix(tuple(base))[0]).reshape(3, 3) @ twist[3:]
    length = float(np.linalg.norm(away))
    return np.asarray(away / length) if length > 0.5 else np.zeros(3)  # the distance's slope is 1


def _smooth(t: FloatArray) -> FloatArray:
    """Rise from 0 to 1 with minimum jerk."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))
