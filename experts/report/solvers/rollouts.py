"""What controls cost in our own problem, whoever found them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from experts.arm_problem import ArmProblem
from experts.problem import FloatArray
from experts.rollout import rollout
from experts.shooting import Trajectory


def roll_out(problem: ArmProblem, x0: FloatArray, controls: FloatArray) -> Trajectory:
    """Roll controls out from a start.

    Args:
        problem: The maneuver.
        x0: State at stage 0, shape (n_x,).
        controls: Within the limits, shape (N, n_u), units of the scene.

    Returns:
        States and cost; the cost is inf if the rollout is not finite.
    """
    time_step = np.array([problem.time_step])
    trajectory = Trajectory(problem, time_step)
    trajectory.states[0], trajectory.controls[:] = x0, controls
    step, terminal = problem.kernel("step_with_cost"), problem.kernel("terminal_cost")
    trajectory.cost, trajectory.failing_stage = rollout(
        step.address,
        trajectory.step_buffers,
        terminal.address,
        trajectory.terminal_buffers,
        trajectory.states,
        trajectory.stage_costs,
        trajectory.terminal_cost,
    )
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
