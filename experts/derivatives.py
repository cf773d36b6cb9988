"""Derivatives along a trajectory, in tangent coordinates: what the backward sweep is fed with."""

from typing import NamedTuple

import numpy as np

from experts.compilation import compiled
from experts.padded_algebra import FloatArray, add_vector_product


class Derivatives(NamedTuple):
    """Derivatives along a trajectory of N stages, in tangent coordinates.

    Attributes:
        A: Of the next state with respect to the state, shape (N, n_t, n_t).
        B: Of the next state with respect to the control, shape (N, n_t, n_u).
        lx: Gradient of the stage cost, state part, shape (N, n_t).
        lu: Gradient of the stage cost, control part, shape (N, n_u).
        lxx: Hessian of the stage cost, state block, never negative, shape (N, n_t, n_t).
        luu: Hessian of the stage cost, control block, positive, shape (N, n_u, n_u).
        terminal_lx: Gradient of the terminal cost, shape (1, n_t).
        terminal_lxx: Hessian of the terminal cost, never negative, shape (1, n_t, n_t).
    """

    A: FloatArray
    B: FloatArray
    lx: FloatArray
    lu: FloatArray
    lxx: FloatArray
    luu: FloatArray
    terminal_lx: FloatArray
    terminal_lxx: FloatArray


class Hessians(NamedTuple):
    """Second derivatives of what a sweep minimizes, in tangent coordinates: Gauss-Newton's, or exact ones.

    Gauss-Newton's are those of the cost alone. Exact ones are those of the Lagrangian: the cost of a stage
    and the curvature of its dynamics, weighted with the costates of `find_costates`.

    Attributes:
        xx: State block, shape (N, n_t, n_t).
        ux: Mixed block, shape (N, n_u, n_t); no stages at all, shape (0, n_u, n_t), if it is zero.
        uu: Control block, shape (N, n_u, n_u).
        terminal_xx: Of the terminal cost, shape (1, n_t, n_t).
    """

    xx: FloatArray
    ux: FloatArray
    uu: FloatArray
    terminal_xx: FloatArray


def allocate_derivatives(horizon: int, n_tangent: int, n_controls: int) -> Derivatives:
    """Allocate the derivatives of a trajectory.

    Args:
        horizon: Number of stages N.
        n_tangent: Size n_t of the tangent state.
        n_controls: Number n_u of inputs.

    Returns:
        Arrays of zeros.
    """
    return Derivatives(
        A=np.zeros((horizon, n_tangent, n_tangent)),
        B=np.zeros((horizon, n_tangent, n_controls)),
        lx=np.zeros((horizon, n_tangent)),
        lu=np.zeros((horizon, n_controls)),
        lxx=np.zeros((horizon, n_tangent, n_tangent)),
        luu=np.zeros((horizon, n_controls, n_controls)),
        terminal_lx=np.zeros((1, n_tangent)),
        terminal_lxx=np.zeros((1, n_tangent, n_tangent)),
    )


def gauss_newton_hessians(derivatives: Derivatives) -> Hessians:
    """Second derivatives of the cost alone, as views.

    Args:
        derivatives: Derivatives along a trajectory.

    Returns:
        The Hessians.
    """
    _, n_tangent, n_controls = derivatives.B.shape
    return Hessians(
        xx=derivatives.lxx,
        ux=np.zeros((0, n_controls, n_tangent)),
        uu=derivatives.luu,
        terminal_xx=derivatives.terminal_lxx,
    )


def allocate_hessians(horizon: int, n_tangent: int, n_controls: int) -> Hessians:
    """Allocate exact second derivatives.

    Args:
        horizon: Number of stages N.
        n_tangent: Size n_t of the tangent state.
        n_controls: Number n_u of inputs.

    Returns:
        Arrays of zeros.
    """
    return Hessians(
        xx=np.zeros((horizon, n_tangent, n_tangent)),
        ux=np.zeros((horizon, n_controls, n_tangent)),
        uu=np.zeros((horizon, n_controls, n_controls)),
        terminal_xx=np.zeros((1, n_tangent, n_tangent)),
    )


@compiled
def find_costates(derivatives: Derivatives, costates: FloatArray) -> None:
    """Compute the gradient of the cost-to-go with respect to the state, along the trajectory as it is.

    lambda_N = terminal lx, lambda_k = lx + A' lambda_k+1.

    Args:
        derivatives: Derivatives along the trajectory.
        costates: Receives lambda_1 .. lambda_N, the multipliers of the N steps, shape (N, n_t).
    """
    horizon, n_tangent = costates.shape
    for j in range(n_tangent):
        costates[horizon - 1, j] = derivatives.terminal_lx[0, j]
    for stage in range(horizon - 1, 0, -1):
        for j in range(n_tangent):
            costates[stage - 1, j] = derivatives.lx[stage, j]
        add_vector_product(costates[stage - 1], derivatives.A[stage], costates[stage], n_tangent)
