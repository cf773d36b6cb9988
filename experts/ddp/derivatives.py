"""Derivatives along a trajectory, in tangent coordinates: the input of the backward pass."""

from typing import NamedTuple

import numpy as np

from experts.native.compilation import compiled
from experts.native.padded_algebra import FloatArray, add_vector_product

EPSILON = float(np.finfo(np.float64).eps)


class Derivatives(NamedTuple):
    """Derivatives along a trajectory of N stages, in tangent coordinates."""

    A: FloatArray  # f_x, next state by state, shape (N, n_t, n_t)
    B: FloatArray  # f_u, next state by control, shape (N, n_t, n_u)
    lx: FloatArray  # gradient of the stage cost, shape (N, n_t)
    lu: FloatArray  # shape (N, n_u)
    lxx: FloatArray  # Hessian of the stage cost, positive semidefinite, shape (N, n_t, n_t)
    luu: FloatArray  # positive definite, shape (N, n_u, n_u)
    lux: FloatArray  # shape (N, n_u, n_t), or (0, n_u, n_t) if it is zero
    terminal_lx: FloatArray  # shape (1, n_t)
    terminal_lxx: FloatArray  # positive semidefinite, shape (1, n_t, n_t)


class Hessians(NamedTuple):
    """Second derivatives for a backward pass, in tangent coordinates.

    Gauss-Newton's approximate those of the cost alone by convex ones; mirrored ones are those of the cost,
    made convex; exact ones are those of the Lagrangian: the cost of a stage and the curvature of its
    dynamics, weighted with the costates of `find_costates`.
    """

    xx: FloatArray  # shape (N, n_t, n_t)
    ux: FloatArray  # shape (N, n_u, n_t), or (0, n_u, n_t) if it is zero
    uu: FloatArray  # shape (N, n_u, n_u)
    terminal_xx: FloatArray  # shape (1, n_t, n_t)


def allocate_derivatives(
    horizon: int, n_tangent: int, n_controls: int, *, mixed: bool = False
) -> Derivatives:
    return Derivatives(
        A=np.zeros((horizon, n_tangent, n_tangent)),
        B=np.zeros((horizon, n_tangent, n_controls)),
        lx=np.zeros((horizon, n_tangent)),
        lu=np.zeros((horizon, n_controls)),
        lxx=np.zeros((horizon, n_tangent, n_tangent)),
        luu=np.zeros((horizon, n_controls, n_controls)),
        lux=np.zeros((horizon if mixed else 0, n_controls, n_tangent)),
        terminal_lx=np.zeros((1, n_tangent)),
        terminal_lxx=np.zeros((1, n_tangent, n_tangent)),
    )


def gauss_newton_hessians(derivatives: Derivatives) -> Hessians:
    """Second derivatives of the cost alone, as views of the derivatives."""
    return Hessians(
        xx=derivatives.lxx,
        ux=derivatives.lux,
        uu=derivatives.luu,
        terminal_xx=derivatives.terminal_lxx,
    )


def mirrored(matrices: FloatArray) -> FloatArray:
    """Make symmetric matrices, shape (N, n, n), positive semidefinite: negative eigenvalues change sign.

    Matrices that are not finite stay as they are.
    """
    if not np.isfinite(matrices).all():
        return matrices
    size = matrices.shape[1]
    coupled = np.flatnonzero(np.any(matrices * ~np.eye(size, dtype=bool), axis=(0, 1)))
    block = np.ix_(np.arange(len(matrices)), coupled, coupled)
    values, vectors = np.linalg.eigh(matrices[block])
    result = np.abs(matrices)  # right for the rows with nothing but a diagonal entry
    result[block] = (vectors * np.abs(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return result


def allocate_hessians(horizon: int, n_tangent: int, n_controls: int) -> Hessians:
    return Hessians(
        xx=np.zeros((horizon, n_tangent, n_tangent)),
        ux=np.zeros((horizon, n_controls, n_tangent)),
        uu=np.zeros((horizon, n_controls, n_controls)),
        terminal_xx=np.zeros((1, n_tangent, n_tangent)),
    )


@compiled
def find_costates(derivatives: Derivatives, costates: FloatArray) -> None:
    """Compute the costates, gradients of the cost-to-go along the trajectory without feedback.

    lambda_N = terminal lx, lambda_k = lx + A' lambda_k+1; row k - 1 holds lambda_k.
    """
    horizon, n_tangent = costates.shape
    for j in range(n_tangent):
        costates[horizon - 1, j] = derivatives.terminal_lx[0, j]
    for stage in range(horizon - 1, 0, -1):
        for j in range(n_tangent):
            costates[stage - 1, j] = derivatives.lx[stage, j]
        add_vector_product(costates[stage - 1], derivatives.A[stage], costates[stage], n_tangent)


@compiled
def change_by_rounding(derivatives: Derivatives, sizes: FloatArray) -> float:
    """Estimate the change of the cost by roundings of the states.

    Every tangent coordinate is taken to be off by a rounding of a number of given size, shape (N + 1, n_t);
    half the trace of lxx is the expected second-order cost of random errors.
    """
    horizon, n_tangent = derivatives.lx.shape
    change = 0.0
    for k in range(horizon + 1):
        lx = derivatives.lx[k] if k < horizon else derivatives.terminal_lx[0]
        lxx = derivatives.lxx[k] if k < horizon else derivatives.terminal_lxx[0]
        for i in range(n_tangent):
            digit = EPSILON * sizes[k, i]
            change += digit * (abs(lx[i]) + 0.5 * digit * lxx[i, i])
    return change
