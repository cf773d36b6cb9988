"""Response of a maneuver's end to forces on its rows: what a change of their multipliers would do.

A force p on the final state adds p . dx_N to the cost. Near a minimum the optimal maneuver answers with a
motion that is linear in p: two backward passes that differ by the force give the change of the controls, and
the linearized dynamics that of the final state.
"""

from typing import NamedTuple

import numpy as np

from experts.ddp.derivatives import Derivatives
from experts.ddp.shooting import ShootingWorkspace
from experts.native.compilation import compiled
from experts.problems.shooting_problem import FloatArray
from experts.problems.stage_constraints import StageConstraints

FORCE = 1e-3
"""Force to measure with, relative to the multiplier, or to 1 if that is larger."""


class EndResponse(NamedTuple):
    """Rows at the end, to first order, after a Newton step and by the multipliers."""

    residuals: FloatArray  # after the step, shape (n_g,)
    slopes: FloatArray  # by the multipliers, symmetric and negative semidefinite, shape (n_g, n_g)


def end_response(
    work: ShootingWorkspace, constraints: StageConstraints, *, exact: bool
) -> EndResponse | None:
    """Measure the response around the current trajectory; None where the model has no minimum.

    Derivatives and control update of the workspace become those of this trajectory.
    """
    states, controls = work.current.states, work.current.controls
    work.differentiate()
    if exact:
        work.differentiate_twice()
    if not work.backward_pass(0.0, exact=exact).completed:
        return None
    d, by_state = work.derivatives, constraints.slopes(states[-1])
    count, step, slopes = len(by_state), work.update.k.copy(), np.zeros((len(by_state), len(by_state)))
    residuals = constraints.find(states, controls)[-1, :count] + by_state @ _moved_end(work, step)
    gradient = d.terminal_lx.copy()
    try:
        for j, row in enumerate(by_state):
            force = FORCE * max(abs(constraints.multipliers[-1, j]), 1.0)
            d.terminal_lx[0] = gradient[0] + constraints.end_weight * force * row
            if not work.backward_pass(0.0, exact=exact).completed:
                return None
            slopes[:, j] = by_state @ _moved_end(work, (work.update.k - step) / force)
    finally:
        d.terminal_lx[:] = gradient
    return EndResponse(residuals, 0.5 * (slopes + slopes.T))


def _moved_end(work: ShootingWorkspace, k: FloatArray) -> FloatArray:
    """Change of the final state, shape (n_t,), by a change k of the controls, shape (N, n_u)."""
    change = np.zeros((2, work.problem.n_tangent))
    _follow_linearized(work.derivatives, k, work.update.K, np.zeros(work.problem.n_controls), change)
    return np.asarray(change[0])


@compiled
def _follow_linearized(
    derivatives: Derivatives, k: FloatArray, K: FloatArray, du: FloatArray, dx: FloatArray
) -> None:
    """Compute dx+ = A dx + B du with du = k + K dx, from dx = 0; dx and dx+ are the rows of an array."""
    horizon, n_controls, n_tangent = K.shape
    for stage in range(horizon):
        for i in range(n_controls):
            du[i] = k[stage, i]
            for j in range(n_tangent):
                du[i] += K[stage, i, j] * dx[0, j]
        for i in range(n_tangent):
            dx[1, i] = 0.0
            for j in range(n_tangent):
                dx[1, i] += derivatives.A[stage, i, j] * dx[0, j]
            for j in range(n_controls):
                dx[1, i] += derivatives.B[stage, i, j] * du[j]
        for i in range(n_tangent):
            dx[0, i] = dx[1, i]
