"""What the quadratic model says of the cost of a trajectory with gaps, if a step closes them.

Between two stages of such a trajectory there is a gap f_k = step(x_k, u_k) (-) x_k+1, in the tangent
coordinates of x_k+1; see `multiple_shooting`.
"""

from experts.backward_sweep import Update
from experts.compilation import compiled
from experts.derivatives import Derivatives
from experts.padded_algebra import FloatArray


@compiled
def change_of_cost(
    derivatives: Derivatives,
    update: Update,
    initial_gap: FloatArray,
    gaps: FloatArray,
    dx: FloatArray,
    dx_next: FloatArray,
    du: FloatArray,
) -> tuple[float, float]:
    """Compute how a step that closes the gaps changes the quadratic model of the cost.

    The linearized rollout dx_0 = f, du = k + K dx, dx_k+1 = A dx + B du + f_k is followed; a step of length
    alpha moves alpha times as far.

    Args:
        derivatives: Derivatives along the trajectory with gaps.
        update: k and K.
        initial_gap: What the first state lacks to the initial state, shape (n_t,).
        gaps: f_k, shape (N, n_t).
        dx: Work array, shape (n_t,).
        dx_next: Work array, shape (n_t,).
        du: Work array, shape (n_u,).

    Returns:
        Change per step length, the exact derivative of the cost; and the same per squared step length.
    """
    horizon, n_tangent = gaps.shape
    n_controls = du.shape[0]
    linear, quadratic = 0.0, 0.0
    for i in range(n_tangent):
        dx[i] = initial_gap[i]
    for k in range(horizon):
        for i in range(n_controls):
            du[i] = update.feedforward[k, i]
            for j in range(n_tangent):
                du[i] += update.gains[k, i, j] * dx[j]
        for i in range(n_controls):
            curvature = 0.0
            for j in range(n_controls):
                curvature += derivatives.luu[k, i, j] * du[j]
            linear += derivatives.lu[k, i] * du[i]
            quadratic += 0.5 * du[i] * curvature
        for i in range(n_tangent):
            curvature, moved = 0.0, gaps[k, i]
            for j in range(n_tangent):
                curvature += derivatives.lxx[k, i, j] * dx[j]
                moved += derivatives.A[k, i, j] * dx[j]
            for j in range(n_controls):
                moved += derivatives.B[k, i, j] * du[j]
            linear += derivatives.lx[k, i] * dx[i]
            quadratic += 0.5 * dx[i] * curvature
            dx_next[i] = moved
        for i in range(n_tangent):
            dx[i] = dx_next[i]
    for i in range(n_tangent):
        curvature = 0.0
        for j in range(n_tangent):
            curvature += derivatives.terminal_lxx[0, i, j] * dx[j]
        linear += derivatives.terminal_lx[0, i] * dx[i]
        quadratic += 0.5 * dx[i] * curvature
    return linear, quadratic
