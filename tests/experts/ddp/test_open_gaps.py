"""Multiple shooting when gaps cannot be closed in time, or guesses are bad."""

from dataclasses import replace

import numpy as np
import pytest
from guessed_states import assert_rolled_out, random_guess

from experts import BoxDDP, StopReason
from experts.ddp.backward_pass import PASS_COMPLETED
from experts.ddp.multiple_shooting import MOST_ITERATIONS, MU_LEVELS, MultipleShooting
from experts.problems.arm_problem import ArmProblem
from experts.problems.paper_problem import PaperProblem

# Reasons to stop -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_iterations", [0, 1, 2])
def test_iterations_that_run_out_while_gaps_are_open(unstable, max_iterations):
    guess = np.linspace(1.0, 0.0, unstable.horizon + 1)[:, None] * unstable.initial_state
    with np.errstate(over="ignore", invalid="ignore"):
        solution = BoxDDP(unstable, max_iterations=max_iterations).solve(x_init=guess)
    assert solution.stop_reason is StopReason.MAX_ITERATIONS
    assert not solution.converged
    assert solution.iterations == len(solution.history) == max_iterations
    still_open = max_iterations == 0 or solution.history["gap"][-1] > 0.0
    assert ("no step closed the last gaps" in solution.message) == still_open
    assert np.isfinite(solution.cost)
    assert_rolled_out(solution, unstable)


def test_interrupted_while_gaps_are_open(unicycle, monkeypatch):
    monkeypatch.setattr("experts.ddp.multiple_shooting.STEP_LENGTHS", [0.5])
    states, controls = random_guess(unicycle)
    gaps = []

    def interrupt(record):
        gaps.append(record.gap)
        if len(gaps) == 3:
            raise KeyboardInterrupt

    solution = BoxDDP(unicycle).solve(u_init=controls, callback=interrupt, x_init=states)
    assert gaps[1:] == [0.5 * gap for gap in gaps[:-1]]
    assert solution.stop_reason is StopReason.INTERRUPTED
    assert not solution.converged
    assert solution.iterations == 3
    assert solution.message.startswith("interrupted by the user")
    assert f"no step closed the last gaps, of up to {gaps[-1]:.1e}" in solution.message
    assert solution.feedback_gains.any()
    assert_rolled_out(solution, unicycle)


def test_gaps_that_many_short_steps_leave_are_closed_by_a_rollout(unicycle, monkeypatch):
    monkeypatch.setattr("experts.ddp.multiple_shooting.STEP_LENGTHS", [0.1])
    states, controls = random_guess(unicycle)
    solution = BoxDDP(unicycle).solve(u_init=controls, x_init=states)
    gap = solution.history["gap"]
    assert solution.converged
    assert np.count_nonzero(gap) == MOST_ITERATIONS
    np.testing.assert_allclose(gap[1:MOST_ITERATIONS], 0.9 * gap[: MOST_ITERATIONS - 1], rtol=1e-12)
    assert "no step closed the last gaps" in solution.message
    assert_rolled_out(solution, unicycle)


def test_gaps_that_rounding_leaves_are_none(unicycle, monkeypatch):
    monkeypatch.setattr("experts.ddp.multiple_shooting.STEP_LENGTHS", [0.5])
    states, controls = random_guess(unicycle)
    solution = BoxDDP(unicycle).solve(u_init=controls, x_init=states)
    assert solution.converged
    assert np.count_nonzero(solution.history["gap"]) < MOST_ITERATIONS
    assert "gaps" not in solution.message
    assert_rolled_out(solution, unicycle)


def test_short_steps_raise_the_regularization_and_long_ones_lower_it(unicycle, monkeypatch):
    states, controls = random_guess(unicycle)
    lengths = [0.1, 0.1, 0.1, 0.3, 0.5, 0.5, 0.1, 1.0]
    following = iter(lengths)

    def line_search(shooting, linear, quadratic):
        alpha = next(following)
        assert np.isfinite(shooting.try_step(alpha))
        shooting.accept(alpha)
        return alpha

    monkeypatch.setattr(MultipleShooting, "line_search", line_search)
    solution = BoxDDP(unicycle).solve(u_init=controls, x_init=states)
    damping = solution.history["regularization"][: len(lengths)]
    np.testing.assert_array_equal(damping, [MU_LEVELS[level] for level in (0, 1, 2, 3, 3, 2, 1, 2)])
    assert solution.converged


def test_a_wrong_model_closes_no_gaps_and_is_not_called_convergence(double_integrator):
    """Derivatives of the wrong sign: no direction lowers the cost, with gaps or without."""
    problem = double_integrator.problem()
    wrong = replace(problem, linearize=lambda x, u, h: (double_integrator.A, -double_integrator.B))
    states, controls = random_guess(problem)
    solution = BoxDDP(wrong).solve(u_init=controls, x_init=states)
    assert not solution.converged
    assert solution.iterations <= BoxDDP(wrong).max_iterations
    assert_rolled_out(solution, wrong)


def test_trials_that_are_never_finite_come_to_an_end(unicycle):
    """Once the guess is linearized, the dynamics give no number for any other state or control."""
    states, controls = random_guess(unicycle)
    linearized = []

    def linearize(x, u, h):
        linearized.append(x)
        return unicycle.linearize(x, u, h)

    def step(x, u, h):
        known = not linearized or np.any(np.all(controls == u, axis=1))
        return unicycle.step(x, u, h) if known else np.full(4, np.nan)

    solution = BoxDDP(replace(unicycle, step=step, linearize=linearize)).solve(u_init=controls, x_init=states)
    with_gaps = solution.history[solution.history["gap"] > 0.0]
    assert np.all(with_gaps["alpha"] == 0.0)
    assert tuple(with_gaps["regularization"]) == MU_LEVELS
    assert solution.stop_reason is StopReason.REGULARIZATION_LIMIT
    np.testing.assert_array_equal(solution.controls, controls)
    assert "no step closed the last gaps" in solution.message


def test_dynamics_that_are_not_finite_at_the_guess(unicycle):
    """Only the controls are of use then."""
    broken = replace(
        unicycle, step=lambda x, u, h: unicycle.step(x, u, h) if x[2] < 4.0 else np.full(4, np.nan)
    )
    states, controls = random_guess(unicycle)
    states[40, 2] = 5.0
    solution = BoxDDP(broken).solve(u_init=controls, x_init=states)
    plain = BoxDDP(broken).solve(u_init=controls)
    assert solution.converged
    np.testing.assert_array_equal(solution.controls, plain.controls)
    assert "the dynamics are not finite at the guessed states" in solution.message


def test_if_nothing_is_finite_the_solution_says_so(double_integrator):
    problem = replace(double_integrator.problem(), step=lambda x, u, h: np.full(2, np.nan))
    solution = BoxDDP(problem).solve(x_init=np.zeros((41, 2)))
    assert solution.stop_reason is StopReason.DIVERGED
    assert solution.cost == np.inf
    assert solution.iterations == 0


def test_a_trial_that_is_not_finite_is_only_a_refused_step(pendulum):
    """Dynamics that leave the floating-point range at the rates of the full step."""

    def step(x, u, h):
        return pendulum.step(x, u, h) if abs(x[1]) < 6.0 else np.full(2, np.nan)

    states = np.linspace([np.pi, 0.0], [0.0, 0.0], pendulum.horizon + 1)
    solution = BoxDDP(replace(pendulum, step=step), max_iterations=40).solve(x_init=states)
    assert solution.stop_reason is not StopReason.DIVERGED
    assert np.isfinite(solution.cost)


def test_a_backward_pass_that_is_not_finite_spoils_no_later_one(unicycle):
    solver = BoxDDP(unicycle)
    solution = solver.solve()
    work = solver._work
    work.derivatives.A[7, 0, 0] = np.inf
    assert work.backward_pass(0.0).status != PASS_COMPLETED
    again = solver.solve()
    assert again.converged
    np.testing.assert_array_equal(again.controls, solution.controls)


# Bad input -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[1:], r"x_init has shape \(80, 4\); expected \(81, 4\)"),
        (lambda x: np.where(np.arange(81)[:, None] == 9, np.nan, x), r"x_init\[9, 0\] is nan; every entry"),
        (
            lambda x: x * np.array([1.1, 1.1, 1.0, 1.0]),
            r"x_init\[0\] is no state: its entry 0, 1\.1, is more",
        ),
    ],
)
def test_bad_guesses_of_the_states_are_refused(unicycle, change, message):
    states = np.tile([1.0, 0.0, 0.0, 0.0], (81, 1))
    with pytest.raises(ValueError, match=message):
        BoxDDP(unicycle).solve(x_init=change(states))


def test_poses_off_the_manifold_are_refused():
    problem = ArmProblem("no-wrist")
    states = np.tile(problem.initial_state, (problem.horizon + 1, 1))
    for factor in (0.0, 1.01):
        states[5, :8] = factor * states[4, :8]
        with pytest.raises(ValueError, match=r"x_init\[5\] is no state: .* must be a unit dual quaternion"):
            BoxDDP(problem).solve(x_init=states)
    with pytest.raises(ValueError, match=r"^x0 is no state: .* must be a unit dual quaternion"):
        BoxDDP(problem).solve(states[5])


def test_problem_without_a_retraction_takes_no_guess_of_the_states(unicycle):
    assert not PaperProblem.has_retraction
    problem = replace(unicycle, retract=None)
    with pytest.raises(ValueError, match="x_init is given, but the problem has no retraction"):
        BoxDDP(problem).solve(x_init=np.tile(unicycle.initial_state, (81, 1)))
