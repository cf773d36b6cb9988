"""Guided DDP: initial guesses from solved maneuvers, rolled out from the requested start.

From zero controls a solve may end in a poor minimum, with joints wound up and the tip far from its target;
the controls of a maneuver solved for another start do little better, because their errors accumulate over the
stages. The policy of a solved maneuver, u = u_k + K_k (x (-) x_k), rolled out from the new start, corrects
itself: its trajectory lies in the valley of its own minimum. One good maneuver per scene is therefore enough,
and worth some effort (`START_REGULARIZATIONS`). It serves other targets as well, as it is or moved along with
the target: in empty space a maneuver may begin anywhere.

Where a policy strays too far from its maneuver, kinematics provide a guess: one screw motion leads the tip to
the target, and the arm follows (`screw_motion`).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.rollout import FINISHED, Trajectory
from experts.ddp.shooting import ShootingWorkspace
from experts.ddp.solution import Callback, Solution, StopReason
from experts.guesses.reaching import HasTolerances, reach
from experts.guesses.screw_motion import ScrewMotion
from experts.guesses.screw_motion import screw_motion as guess_screw_motion
from experts.problems.arm_problem import ArmProblem, WindowProblem
from experts.problems.shooting_problem import FloatArray, ShootingProblem, check_array, check_at_least

START_REGULARIZATIONS = (1e2, 1e3, 1e4, 1e5)
"""First regularizations of solves of the initial state from zero controls; the cheapest solution is kept."""
POLICY_REGULARIZATION = 1e2
"""First regularization from a policy's trajectory: near a minimum, longer steps than usual are safe."""
STRAYED = 3.0
"""A policy whose rollout costs this many times its own maneuver has strayed too far from it."""
SCREW_REGULARIZATION = 1e2
"""First regularization from a screw motion: the arm is not wound up, and long steps rarely wind it up."""
ZERO_REGULARIZATION = 1e4
"""First regularization from zero controls: short first steps rarely end in a poor minimum."""
REACH_REGULARIZATION = 0.0
"""First regularization after an increase of the emphasis: the last minimum is near."""


class _Guess(NamedTuple):
    """Controls to start a solve from."""

    name: str  # in the solution's metadata
    controls: FloatArray | None  # shape (N, n_u); None for zeros
    cost: float  # of their rollout; inf if not finite or unknown
    regularization: float  # first one of the solve


class _Attempt(NamedTuple):
    """A solve."""

    guess: str
    solution: Solution
    emphasis: float = 1.0  # factor of the final pose's weights


class GuidedDDP:
    """Box-DDP that makes its own guesses and reaches the target; give each thread its own.

    The guesses, cheapest rollout first, are the policies of a library of solved maneuvers and, where all of
    them stray, the screw motion of an arm's tip to its target; then zero controls. They are solved one after
    another until one converges and, if the problem has tolerances, ends within them. A minimum that ends
    outside is led to the target: the weights of the final pose are raised as far as necessary (`reaching`).
    The cheapest solution wins, among those that reach the target if there are any.
    """

    def __init__(
        self,
        scene_or_problem: Any,
        *,
        library: Iterable[Solution] | None = None,
        screw_motion: bool = True,
        reach_target: bool = True,
        remember: int = 0,
        attempts: int = 2,
        max_iterations: int = 200,
        tolerance: float = 1e-7,
        second_order: str | None = None,
    ) -> None:
        """Prepare the solver.

        Args:
            scene_or_problem: A scene, a `CasadiProblem` or `PythonProblem` of your own, or another
                `ShootingProblem`.
            library: Solutions of this problem or a similar one, such as the scene with another target. None
                solves the problem's own initial state, once, on first use; an empty library leaves the other
                guesses.
            screw_motion: Whether to guess the tip's screw motion where no policy is near; arms only.
            reach_target: Whether to raise the weights of the final pose where the cheapest maneuver ends
                outside the tolerances.
            remember: Number of converged solutions that may join the library. With 0 a solution depends on
                its start alone, otherwise also on those solved before.
            attempts: Most guesses to solve for a start.
            max_iterations: Most iterations from one guess.
            tolerance: See `BoxDDP`.
            second_order: See `BoxDDP`.

        Raises:
            TypeError: If scene_or_problem is neither a scene nor a problem.
            ValueError: If a setting is out of range or unknown, the problem contradicts itself, or a solution
                of the library is not finite or has other sizes than the problem.
        """
        check_at_least("remember", remember, 0)
        check_at_least("attempts", attempts, 1)
        self._solver = BoxDDP(
            scene_or_problem, max_iterations=max_iterations, tolerance=tolerance, second_order=second_order
        )
        self.problem: ShootingProblem = self._solver.problem
        self.attempts = attempts
        self.reach_target = reach_target
        self._target = cast(HasTolerances, self.problem) if hasattr(self.problem, "misses") else None
        self._kinematic_guess: Callable[[FloatArray], ScrewMotion] | None = None
        if screw_motion and isinstance(self.problem, ArmProblem):
            self._kinematic_guess = partial(guess_screw_motion, self.problem)
        self._vacancies = remember
        self._library = None if library is None else list(library)
        for i, solution in enumerate(self._library or ()):
            _check_sizes(f"library[{i}]", solution, self.problem)

    @property
    def library(self) -> tuple[Solution, ...]:
        """The solved maneuvers whose policies are guesses; the first access may solve them.

        Raises:
            KeyboardInterrupt: If the user interrupts that solve.
        """
        if self._library is None:
            self._library = self._solve_initial_state()
        return tuple(self._library)

    def solve(
        self,
        x0: FloatArray | None = None,
        callback: Callback | None = None,
        *,
        parameters: ArrayLike | None = None,
    ) -> Solution:
        """Minimize the cost from a start.

        Args:
            x0: State at stage 0, shape (n_x,), units of the state; the problem's initial state if None.
            callback: Called with the record of every iteration from this start; it may raise
                KeyboardInterrupt to end the solve.
            parameters: What varies in the problem, shape (n_p,) or (N + 1, n_p), see `BoxDDP.solve`; None
                for nominal ones.

        Returns:
            The best trajectory found; its cost is always the problem's own. `metadata["guess"]` names its
            guess, `metadata["emphasis"]` is the factor of the final pose's weights at which it is a minimum,
            and `metadata["attempts"]` lists guess, emphasis, cost, iterations and stop reason of each solve.

        Raises:
            ValueError: If x0 or parameters have the wrong shape or are not finite, or an input has no cost of
                its own.
            KeyboardInterrupt: If the user interrupts the preparation of the library.
        """
        given = self.problem.parameters.checked(parameters)
        library = self.library  # its preparation takes nominal parameters
        self.problem.parameters.set(given)
        start = np.asarray(self.problem.initial_state if x0 is None else x0, dtype=np.float64)
        check_array("x0", start, (self.problem.n_states,))
        attempts: list[_Attempt] = []
        for guess in self._guesses(start, library):
            attempts.append(_Attempt(guess.name, self._solve_from(guess, start, callback)))
            if attempts[-1].solution.converged and not self._is_good(attempts[-1].solution):
                attempts += self._reach(attempts[-1], start, callback)
            last = attempts[-1].solution
            if self._is_good(last) or last.stop_reason is StopReason.INTERRUPTED:
                break
        # An emphasis that did not help is dropped.
        good = [attempt for attempt in attempts if self._is_good(attempt.solution)]
        plain = [attempt for attempt in attempts if attempt.emphasis == 1.0]
        best = min(good or plain, key=lambda attempt: attempt.solution.cost)
        solution = best.solution
        solution.metadata["guess"], solution.metadata["emphasis"] = best.guess, best.emphasis
        solution.metadata["attempts"] = [_summary(attempt) for attempt in attempts]
        self._remember(solution)
        return solution

    def _reach(self, attempt: _Attempt, start: FloatArray, callback: Callback | None) -> list[_Attempt]:
        """Lead a minimum that ends outside the tolerances to the target."""
        if not self.reach_target or self._target is None:
            return []

        def solve(controls: FloatArray) -> Solution:
            return self._solve_from(_Guess("", controls, np.inf, REACH_REGULARIZATION), start, callback)

        steps = reach(self._target, attempt.solution, solve)
        return [_Attempt(attempt.guess, step.solution, step.emphasis) for step in steps]

    def _remember(self, solution: Solution) -> None:
        """Add a solution to the library if there is room and it is new."""
        known = solution.iterations == 0  # its guess, a policy, was already optimal
        if self._vacancies > 0 and self._library is not None and solution.converged and not known:
            self._library.append(solution)
            self._vacancies -= 1

    def _guesses(self, start: FloatArray, library: Sequence[Solution]) -> list[_Guess]:
        """List the guesses to solve, cheapest rollout first; zero controls are the last resort."""
        rollouts, strayed = [], True
        for i, solution in enumerate(library):
            for name, policy in policies(solution, self.problem).items():
                trial = follow(policy, self.problem, start)
                rollouts.append(
                    _Guess(f"policy {i}{name}", trial.controls, trial.cost, POLICY_REGULARIZATION)
                )
                strayed = strayed and trial.cost > STRAYED * solution.cost
        if strayed and self._kinematic_guess is not None:
            motion = self._kinematic_guess(start)
            rollouts.append(_Guess("screw motion", *track(self.problem, *motion), SCREW_REGULARIZATION))
        ranked = sorted(
            (guess for guess in rollouts if np.isfinite(guess.cost)), key=lambda guess: guess.cost
        )
        zero = _Guess("zero controls", None, np.inf, ZERO_REGULARIZATION)
        # The last of two or more attempts starts from zero controls.
        return [*ranked[: max(self.attempts - 1, 1)], zero][: self.attempts]

    def _solve_from(self, guess: _Guess, start: FloatArray, callback: Callback | None = None) -> Solution:
        self._solver.initial_regularization = guess.regularization
        return self._solver.solve(start, guess.controls, callback, parameters=self.problem.parameters.rows)

    def _is_good(self, solution: Solution) -> bool:
        """Whether a solution has converged, and ends within the tolerances if the problem has any."""
        if not solution.converged:
            return False
        return self._target is None or self._target.misses(solution.states[-1]) <= 1.0

    def _solve_initial_state(self) -> list[Solution]:
        """Solve the problem's own initial state; no solution if every rollout diverges."""
        start = np.asarray(self.problem.initial_state, dtype=np.float64)
        self.problem.parameters.set(None)
        solutions: list[Solution] = []
        for regularization in START_REGULARIZATIONS:
            solution = self._solve_from(_Guess("zero controls", None, np.inf, regularization), start)
            if solution.stop_reason is StopReason.INTERRUPTED:
                raise KeyboardInterrupt
            solutions.append(solution)
        best = min(solutions, key=lambda solution: solution.cost)
        return [best] if np.isfinite(best.cost) else []


def policies(solution: Solution, problem: ShootingProblem) -> dict[str, Solution]:
    """A solution as it is, and moved rigidly from its target to the present one where they differ."""
    found = {"": solution}
    if not isinstance(problem, ArmProblem | WindowProblem) or not problem.parameters.inputs:
        return found
    if solution.parameters.shape != problem.parameters.rows.shape:
        return found
    states = problem.carried(solution.states, solution.parameters[-1])
    return found if states is None else {**found, ", moved": replace(solution, states=states)}


def follow(solution: Solution, problem: ShootingProblem, x0: FloatArray) -> Trajectory:
    """Roll out the policy of a solution from another start; the cost is inf if it is not finite."""
    trial = Trajectory(problem)
    trial.states[0] = x0
    kernels = {name: problem.kernel(name) for name in ("difference", "step_with_cost", "terminal_cost")}
    reference = np.ascontiguousarray(solution.states), solution.controls
    policy = np.zeros_like(solution.controls), solution.feedback_gains
    trial.follow(kernels, reference, policy, alpha=0.0)
    return trial


def _check_sizes(name: str, solution: Solution, problem: ShootingProblem) -> None:
    """Raise ValueError if a solution does not fit a problem."""
    horizon, n_controls = problem.horizon, problem.n_controls
    check_array(f"{name}.states", solution.states, (horizon + 1, problem.n_states))
    check_array(f"{name}.controls", solution.controls, (horizon, n_controls))
    gains = (horizon, n_controls, problem.n_tangent)
    check_array(f"{name}.feedback_gains", solution.feedback_gains, gains)


def _summary(attempt: _Attempt) -> dict[str, Any]:
    """Describe an attempt for the metadata, as JSON values."""
    solution = attempt.solution
    return {
        "guess": attempt.guess,
        "emphasis": attempt.emphasis,
        "cost": solution.cost,
        "iterations": solution.iterations,
        "stop_reason": solution.stop_reason.value,
    }


def track(problem: ShootingProblem, states: FloatArray, controls: FloatArray) -> tuple[FloatArray, float]:
    """Follow a trajectory that need not obey the dynamics; return controls (N, n_u) and cost of the rollout.

    The feedback is a linear-quadratic regulator around the guess: dynamics linearized along it, deviations
    weighted with the Gauss-Newton Hessian of the problem's own cost. Motion that does not affect the cost,
    such as that of the arm around a fixed tip, may deviate freely.
    """
    check_array("states", states, (problem.horizon + 1, problem.n_states))
    check_array("controls", controls, (problem.horizon, problem.n_controls))
    work = ShootingWorkspace(problem, second_order=False)
    work.current.states[:], work.current.controls[:] = states, controls
    work.trial.states[0] = states[0]
    work.differentiate()
    # Without gradients the guess itself has the least cost, and k vanishes.
    derivatives = work.derivatives
    for gradient in (derivatives.lx, derivatives.lu, derivatives.terminal_lx):
        gradient[:] = 0.0
    if not work.backward_pass(0.0).completed:
        return work.current.controls.copy(), np.inf
    cost = work.try_step(0.0)
    finite = work.trial.failing_stage == FINISHED
    return work.trial.controls.copy(), cost if finite else np.inf
