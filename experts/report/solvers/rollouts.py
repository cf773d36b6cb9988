"""What controls cost in our own problem, whoever found them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from experts.arm_problem import ArmProblem
from experts.problem import FloatArray
from experts.trajectory import Trajectory


def roll_out(problem: ArmProblem, x0: FloatArray, controls: FloatArray) -> Trajectory:
    """Roll controls out from a start.

    Args:
        problem: The maneuver.
        x0: State at stage 0, shape (n_x,).
        controls: Within the limits, shape (N, n_u), units of the scene.

    Returns:
        States and cost; the cost is inf if the rollout is not finite.
    """
    trajectory = Trajectory(problem)
    trajectory.states[0], trajectory.controls[:] = x0, controls
    trajectory.roll_out({name: problem.kernel(name) for name in ("step_with_cost", "terminal_cost")})
    return trajectory


def costs_of(problem: ArmProblem, x0: FloatArray, guesses: Iterable[FloatArray]) -> FloatArray:
    """Roll several controls out from a start.

    Args:
        problem: The maneuver.
        x0: State at stage 0, shape (n_x,).
        guesses: Controls as in `roll_out`.

    Returns:
        Their costs, shape (number of guesses,).
    """
    return np.array([roll_out(problem, x0, controls).cost for controls in guesses])
