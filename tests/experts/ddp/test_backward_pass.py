"""The backward pass against Tassa's formulas written out in NumPy, and against the Riccati equation."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from experts.ddp.backward_pass import (
    PASS_COMPLETED,
    PASS_NOT_FINITE,
    PASS_NOT_POSITIVE_DEFINITE,
    PassResult,
    Update,
    allocate_update,
    backward_pass,
    pass_workspace,
)
from experts.ddp.derivatives import (
    Derivatives,
    Hessians,
    allocate_derivatives,
    find_costates,
    gauss_newton_hessians,
)

NO_GAPS = np.zeros((0, 1))


def random_derivatives(seed: int, horizon: int, n_tangent: int, n_controls: int) -> Derivatives:
    rng = np.random.default_rng(seed)
    d = allocate_derivatives(horizon, n_tangent, n_controls, mixed=True)
    d.A[:] = np.eye(n_tangent) + 0.2 * rng.normal(size=d.A.shape) / np.sqrt(n_tangent)
    d.B[:] = 0.3 * rng.normal(size=d.B.shape)
    roots = rng.normal(size=(horizon + 1, n_tangent, n_tangent)) / np.sqrt(n_tangent)
    d.lxx[:] = roots[:-1].transpose(0, 2, 1) @ roots[:-1]
    d.terminal_lxx[0] = 5.0 * roots[-1].T @ roots[-1]
    weights = 10.0 ** rng.uniform(-2.0, 1.0, size=n_controls)
    d.luu[:] = np.diag(weights) + 0.1 * np.sqrt(np.outer(weights, weights)) * (1.0 - np.eye(n_controls))
    for gradient in (d.lx, d.lu, d.terminal_lx):
        gradient[:] = rng.normal(size=gradient.shape)
    return d


def run_pass(
    d: Derivatives,
    controls: np.ndarray,
    limit: float,
    regularization: float,
    hessians: Hessians | None = None,
) -> tuple[PassResult, Update]:
    horizon, n_tangent, n_controls = d.B.shape
    update = allocate_update(horizon, n_tangent, n_controls)
    bound = np.full((horizon, n_controls), limit)
    work = pass_workspace(n_tangent, n_controls)
    hessians = hessians or gauss_newton_hessians(d)
    outcome = backward_pass(d, hessians, NO_GAPS, controls, -bound, bound, regularization, update, work)
    return PassResult(*outcome), update


def reference_pass(
    d: Derivatives,
    controls: np.ndarray,
    limit: float,
    regularization: float,
    hessians: Hessians | None = None,
) -> tuple[float, float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tassa's backward pass: his value update with the Quu and Qux that are not regularized."""
    if hessians is None:
        hessians = gauss_newton_hessians(d)._replace(ux=np.zeros(d.B.transpose(0, 2, 1).shape))
    Vx, Vxx = d.terminal_lx[0], hessians.terminal_xx[0]
    linear, quadratic = 0.0, 0.0
    feedforward, gains = np.zeros(d.lu.shape), np.zeros(d.B.transpose(0, 2, 1).shape)
    for stage in range(len(controls) - 1, -1, -1):
        A, B = d.A[stage], d.B[stage]
        Qx, Qu = d.lx[stage] + A.T @ Vx, d.lu[stage] + B.T @ Vx
        Qxx, Quu = hessians.xx[stage] + A.T @ Vxx @ A, hessians.uu[stage] + B.T @ Vxx @ B
        Qux = hessians.ux[stage] + B.T @ Vxx @ A
        damped = Quu + regularization * np.diag(np.diag(d.luu[stage]))
        if np.isinf(limit):
            k, free = -np.linalg.solve(damped, Qu), np.full(len(Qu), True)
        else:
            root = np.linalg.cholesky(damped).T
            bounds = (-limit - controls[stage], limit - controls[stage])
            k = lsq_linear(root, -np.linalg.solve(root.T, Qu), bounds, method="bvls", tol=1e-15).x
            free = (bounds[0] + 1e-12 < k) & (k < bounds[1] - 1e-12)
        K = np.zeros(Qux.shape)
        K[free] = -np.linalg.solve(damped[np.ix_(free, free)], Qux[free])
        linear, quadratic = linear + k @ Qu, quadratic + 0.5 * k @ Quu @ k
        Vx = Qx + K.T @ Quu @ k + K.T @ Qu + Qux.T @ k
        Vxx = Qxx + K.T @ Quu @ K + K.T @ Qux + Qux.T @ K
        feedforward[stage], gains[stage] = k, K
    return linear, quadratic, feedforward, gains, Vx, Vxx


@pytest.mark.parametrize("regularization", [0.0, 1.0, 300.0])
@pytest.mark.parametrize("limit", [np.inf, 1.0, 0.2])
@pytest.mark.parametrize(("n_tangent", "n_controls"), [(1, 1), (4, 3), (8, 8), (13, 5), (21, 12)])
def test_agrees_with_the_formulas(
    n_tangent: int, n_controls: int, limit: float, regularization: float
) -> None:
    d = random_derivatives(n_tangent, 12, n_tangent, n_controls)
    controls = np.random.default_rng(1).uniform(-0.2, 0.2, size=d.lu.shape)
    outcome, update = run_pass(d, controls, limit, regularization)
    linear, quadratic, k, K, Vx, Vxx = reference_pass(d, controls, limit, regularization)
    assert outcome.status == PASS_COMPLETED
    assert outcome.linear == pytest.approx(linear, rel=1e-8)
    assert outcome.quadratic == pytest.approx(quadratic, rel=1e-8)
    np.testing.assert_allclose(update.k, k, rtol=0, atol=1e-8 * np.abs(k).max())
    np.testing.assert_allclose(update.K, K, rtol=0, atol=1e-8 * max(np.abs(K).max(), 1.0))
    np.testing.assert_allclose(update.Vx, Vx, rtol=0, atol=1e-8 * np.abs(Vx).max())
    np.testing.assert_allclose(update.Vxx, Vxx, rtol=0, atol=1e-8 * np.abs(Vxx).max())


def test_clamped_inputs_follow_what_bounds_them() -> None:
    """Bounds that move with a state one to one: the others respond, and the value function knows."""
    horizon, n_tangent, n_controls = 15, 7, 4
    d = random_derivatives(9, horizon, n_tangent, n_controls)
    rng = np.random.default_rng(2)
    controls, bound = rng.uniform(-0.2, 0.2, d.lu.shape), np.full(d.lu.shape, 0.25)
    follows = rng.integers(-1, n_tangent, (horizon, 2, n_controls))
    update = allocate_update(horizon, n_tangent, n_controls)
    work = pass_workspace(n_tangent, n_controls)._replace(follows=follows)
    hessians = gauss_newton_hessians(d)
    backward_pass(d, hessians, NO_GAPS, controls, -bound, bound, 0.0, update, work)
    Vx, Vxx = d.terminal_lx[0], hessians.terminal_xx[0]
    followed = 0
    for stage in range(horizon - 1, -1, -1):
        A, B = d.A[stage], d.B[stage]
        Qx, Qu, Qxx = d.lx[stage] + A.T @ Vx, d.lu[stage] + B.T @ Vx, d.lxx[stage] + A.T @ Vxx @ A
        Quu, Qux = d.luu[stage] + B.T @ Vxx @ B, d.lux[stage] + B.T @ Vxx @ A
        k, K = update.k[stage], np.zeros((n_controls, n_tangent))
        at_bound = np.isclose(np.abs(controls[stage] + k), 0.25, atol=1e-12)
        for i in np.flatnonzero(at_bound):
            t = follows[stage, 0 if k[i] < 0.0 else 1, i]
            K[i, t] = 1.0 if t >= 0 else 0.0
            followed += t >= 0
        free = np.ix_(~at_bound, ~at_bound)
        right = Qux[~at_bound] + Quu[np.ix_(~at_bound, at_bound)] @ K[at_bound]
        K[~at_bound] = -np.linalg.solve(Quu[free], right)
        np.testing.assert_allclose(update.K[stage], K, rtol=0, atol=1e-9)
        Vx = Qx + K.T @ Quu @ k + K.T @ Qu + Qux.T @ k
        Vxx = Qxx + K.T @ Quu @ K + K.T @ Qux + Qux.T @ K
    assert followed > 10
    np.testing.assert_allclose(update.Vx, Vx, rtol=0, atol=1e-9 * np.abs(Vx).max())
    np.testing.assert_allclose(update.Vxx, Vxx, rtol=0, atol=1e-9 * np.abs(Vxx).max())


def random_hessians(d: Derivatives, seed: int) -> Hessians:
    """Symmetric blocks that no Gauss-Newton model has: mixed ones, and indefinite ones of the state."""
    rng = np.random.default_rng(seed)
    xx, uu = (0.2 * rng.normal(size=array.shape) / array.shape[1] for array in (d.lxx, d.luu))
    weights = np.sqrt(np.diagonal(d.luu, axis1=1, axis2=2))
    return Hessians(
        xx=d.lxx + xx + xx.transpose(0, 2, 1),
        ux=0.1 * weights[:, :, None] * rng.normal(size=d.B.transpose(0, 2, 1).shape),
        uu=d.luu + 0.1 * weights[:, :, None] * weights[:, None] * (uu + uu.transpose(0, 2, 1)),
        terminal_xx=d.terminal_lxx + np.eye(d.lx.shape[1]),
    )


def test_pass_that_knows_what_is_zero_is_the_same() -> None:
    d = random_derivatives(5, 20, 7, 4)
    patterns = tuple(np.random.default_rng(5).uniform(size=block.shape[1:]) < 0.3 for block in (d.A, d.B))
    for block, pattern in zip((d.A, d.B), patterns, strict=True):
        block[:, ~pattern] = 0.0
    controls, bound = np.zeros(d.lu.shape), np.full(d.lu.shape, 0.5)
    updates = allocate_update(20, 7, 4), allocate_update(20, 7, 4)
    for update, work in zip(updates, (pass_workspace(7, 4), pass_workspace(7, 4, patterns)), strict=True):
        backward_pass(d, gauss_newton_hessians(d), NO_GAPS, controls, -bound, bound, 1.0, update, work)
    for dense, sparse in zip(*updates, strict=True):
        np.testing.assert_array_equal(sparse, dense)


@pytest.mark.parametrize("limit", [np.inf, 0.2])
@pytest.mark.parametrize(("n_tangent", "n_controls"), [(4, 3), (13, 5), (21, 12)])
def test_second_derivatives_beyond_gauss_newton_enter_as_the_formulas_say(
    n_tangent: int, n_controls: int, limit: float
) -> None:
    d = random_derivatives(n_tangent, 8, n_tangent, n_controls)
    hessians = random_hessians(d, 3)
    controls = np.random.default_rng(1).uniform(-0.2, 0.2, size=d.lu.shape)
    outcome, update = run_pass(d, controls, limit, 30.0, hessians)
    linear, quadratic, k, K, Vx, Vxx = reference_pass(d, controls, limit, 30.0, hessians)
    assert outcome.status == PASS_COMPLETED
    assert (outcome.linear, outcome.quadratic) == pytest.approx((linear, quadratic), rel=1e-7)
    np.testing.assert_allclose(update.k, k, rtol=0, atol=1e-8 * np.abs(k).max())
    np.testing.assert_allclose(update.K, K, rtol=0, atol=1e-8 * max(np.abs(K).max(), 1.0))
    np.testing.assert_allclose(update.Vx, Vx, rtol=0, atol=1e-8 * np.abs(Vx).max())
    np.testing.assert_allclose(update.Vxx, Vxx, rtol=0, atol=1e-8 * np.abs(Vxx).max())


@pytest.mark.parametrize("limit", [np.inf, 0.2])
def test_the_value_function_is_kept_at_every_stage_where_asked_for(limit: float) -> None:
    """What is kept at a stage is what a sweep over the rest alone ends with."""
    d = random_derivatives(3, 9, 6, 4)
    controls = np.random.default_rng(1).uniform(-0.2, 0.2, size=d.lu.shape)
    update = allocate_update(9, 6, 4, keep_values=True)
    bound = np.full((9, 4), limit)
    hessians = gauss_newton_hessians(d)
    backward_pass(d, hessians, NO_GAPS, controls, -bound, bound, 2.0, update, pass_workspace(6, 4))
    for stage in range(9):
        stages = {key: value[stage:] for key, value in d._asdict().items() if not key.startswith("terminal")}
        _, rest = run_pass(d._replace(**stages), controls[stage:], limit, 2.0)
        np.testing.assert_allclose(update.Vx_all[stage], rest.Vx, rtol=1e-12)
        np.testing.assert_allclose(update.Vxx_all[stage], rest.Vxx, rtol=1e-12)
    assert rest.Vx_all.shape == (0, 6)


def test_costates_are_the_value_gradient_of_a_trajectory_that_stays() -> None:
    """Where no control may move, the gradient of the value function is the costate."""
    d = random_derivatives(6, 20, 7, 3)
    costates = np.zeros(d.lx.shape)
    find_costates(d, costates)
    np.testing.assert_array_equal(costates[-1], d.terminal_lx[0])
    _, update = run_pass(d, np.zeros(d.lu.shape), 0.0, 0.0)
    np.testing.assert_allclose(d.lx[0] + d.A[0].T @ costates[0], update.Vx, rtol=1e-9, atol=1e-12)


def test_stage_that_is_concave_only_along_a_clamped_input_needs_no_regularization() -> None:
    d = random_derivatives(1, 6, 4, 2)
    d.luu[:] = np.diag([1.0, 1.0])
    hessians = gauss_newton_hessians(d)
    hessians = hessians._replace(uu=hessians.uu.copy())
    hessians.uu[3, 1, 1] = -50.0
    d.lu[3, 1] = -500.0
    controls = np.zeros(d.lu.shape)
    controls[3, 1] = 0.5
    outcome, update = run_pass(d, controls, 0.5, 0.0, hessians)
    assert outcome.status == PASS_COMPLETED
    assert update.k[3, 1] == 0.0
    assert np.all(update.K[3, 1] == 0.0)
    outcome, _ = run_pass(d, np.zeros(d.lu.shape), np.inf, 0.0, hessians)
    assert (outcome.status, outcome.stage) == (PASS_NOT_POSITIVE_DEFINITE, 3)


@pytest.mark.parametrize("limit", [1.0, 0.2])
def test_rows_of_clamped_inputs_are_zero_and_counted(limit: float) -> None:
    d = random_derivatives(5, 30, 6, 4)
    outcome, update = run_pass(d, np.zeros(d.lu.shape), limit, 0.0)
    on_bound = np.abs(update.k) == limit
    assert 0 < on_bound.sum() < on_bound.size
    assert outcome.clamped == on_bound.sum()
    assert np.all(update.K[on_bound] == 0.0)
    assert np.all(np.any(update.K[~on_bound] != 0.0, axis=-1))


def test_value_function_stays_symmetric_and_accurate_for_badly_scaled_inputs() -> None:
    d = random_derivatives(2, 60, 9, 4)
    d.luu[:] = np.diag([1e-7, 1e-3, 1.0, 1e5])
    outcome, update = run_pass(d, np.zeros(d.lu.shape), np.inf, 1e-2)
    *_, Vx, Vxx = reference_pass(d, np.zeros(d.lu.shape), np.inf, 1e-2)
    assert outcome.status == PASS_COMPLETED
    np.testing.assert_array_equal(update.Vxx, update.Vxx.T)
    np.testing.assert_allclose(update.Vxx, Vxx, rtol=0, atol=1e-9 * np.abs(Vxx).max())
    np.testing.assert_allclose(update.Vx, Vx, rtol=0, atol=1e-8 * np.abs(Vx).max())


def test_horizon_of_time_invariant_system_reaches_the_riccati_solution() -> None:
    scipy_linalg = pytest.importorskip("scipy.linalg")
    d = random_derivatives(4, 400, 5, 2)
    for array in d[:6]:
        array[:] = array[0]
    d.luu[:] = np.diag([0.5, 2.0])
    outcome, update = run_pass(d, np.zeros(d.lu.shape), np.inf, 0.0)
    expected = scipy_linalg.solve_discrete_are(d.A[0], d.B[0], d.lxx[0], d.luu[0])
    assert outcome.status == PASS_COMPLETED
    np.testing.assert_allclose(update.Vxx, expected, rtol=1e-9, atol=1e-9)


def test_indefinite_stage_is_named_and_regularization_repairs_it() -> None:
    d = random_derivatives(0, 10, 4, 2)
    d.lxx[7] = -50.0 * np.eye(4)
    outcome, _ = run_pass(d, np.zeros(d.lu.shape), np.inf, 0.0)
    assert (outcome.status, outcome.stage) == (PASS_NOT_POSITIVE_DEFINITE, 6)
    outcome, _ = run_pass(d, np.zeros(d.lu.shape), np.inf, 1e6)
    assert outcome.status == PASS_COMPLETED


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", Derivatives._fields)
@pytest.mark.parametrize("stage", [0, 5, 9])
def test_derivatives_that_are_not_finite_are_reported(name: str, stage: int, bad: float) -> None:
    d = random_derivatives(0, 10, 4, 2)
    array = getattr(d, name)
    array[min(stage, len(array) - 1)] = bad
    for limit in (np.inf, 0.3):
        outcome, _ = run_pass(d, np.zeros(d.lu.shape), limit, 1.0)
        assert outcome.status == PASS_NOT_FINITE


@pytest.mark.parametrize("limit", [np.inf, 0.2])
def test_gaps_shift_the_value_gradient(limit: float) -> None:
    """Vx + Vxx f takes the place of Vx: a last gap is the same as a terminal gradient shifted by lxx f."""
    d = random_derivatives(5, 9, 6, 4)
    controls = np.random.default_rng(1).uniform(-0.2, 0.2, size=d.lu.shape)
    gaps = np.zeros((9, 6))
    plain, bound = run_pass(d, controls, limit, 2.0)[1], np.full(controls.shape, limit)
    for last in (np.zeros(6), np.random.default_rng(2).normal(size=6)):
        gaps[-1] = last
        update, work = allocate_update(9, 6, 4), pass_workspace(6, 4)
        backward_pass(d, gauss_newton_hessians(d), gaps, controls, -bound, bound, 2.0, update, work)
        shifted = d._replace(terminal_lx=d.terminal_lx + last @ d.terminal_lxx[0])
        expected = run_pass(shifted, controls, limit, 2.0)[1]
        np.testing.assert_allclose(update.k, expected.k, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(update.Vx, expected.Vx, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(update.K, expected.K, rtol=1e-10, atol=1e-12)
    assert np.abs(update.k - plain.k).max() > 1e-3
