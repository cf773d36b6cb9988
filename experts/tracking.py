"""Turn a guess of a trajectory into controls: the dynamics are rolled out under feedback around the guess."""

import numpy as np

from experts.backward_sweep import SWEEP_DONE
from experts.checks import check_array
from experts.problem import FloatArray, ShootingProblem
from experts.rollout import FINISHED
from experts.shooting import ShootingWorkspace


def track(problem: ShootingProblem, states: FloatArray, controls: FloatArray) -> tuple[FloatArray, float]:
    """Follow a trajectory that need not obey the dynamics.

    The feedback is that of a linear-quadratic regulator around the guess: dynamics linearized along its
    states and controls, deviations weighted with the problem's own cost, Gauss-Newton's Hessian of it. What
    the cost does not see, such as motion of the arm that leaves the tip where it is, is free to deviate.

    Args:
        problem: Dynamics, cost and bounds.
        states: The guess, shape (N + 1, n_x), units of the state; the rollout begins with its first.
        controls: The guess, within the bounds, shape (N, n_u), units of the inputs.

    Returns:
        Controls within the bounds, shape (N, n_u), units of the inputs, and the cost of their rollout, inf if
        it is not finite.

    Raises:
        ValueError: If the arrays have other sizes than the problem, or are not finite.
    """
    check_array("states", states, (problem.horizon + 1, problem.n_states))
    check_array("controls", controls, (problem.horizon, problem.n_controls))
    work = ShootingWorkspace(problem, second_order=False)
    work.current.states[:], work.current.controls[:] = states, controls
    work.trial.states[0] = states[0]
    work.differentiate()
    # Without gradients the cost is least on the guess itself, and the sweep asks for no change of it.
    derivatives = work.derivatives
    for gradient in (derivatives.lx, derivatives.lu, derivatives.terminal_lx):
        gradient[:] = 0.0
    if work.sweep(0.0).status != SWEEP_DONE:
        return work.current.controls.copy(), np.inf
    cost = work.try_step(0.0)
    finite = work.trial.failing_stage == FINISHED
    return work.trial.controls.copy(), cost if finite else np.inf
