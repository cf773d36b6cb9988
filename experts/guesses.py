"""The initial guess as part of the expert: solved maneuvers, followed from the start that is asked for.

From zero controls a solve may end in a poor minimum, with joints wound up and the tip far from its target;
the controls of a maneuver solved for another start do little better, for their errors add up over the
stages. The policy of a solved maneuver u = u_k + K_k (x (-) x_k), rolled out from the new start, does not
forget where it should be: its trajectory lies in the valley of the minimum that it was made for. So one
good maneuver per scene is enough, and it is worth some effort, see `START_REGULARIZATIONS`.

Where a policy has been carried too far from its maneuver, kinematics give a guess that knows the start: the
tip is led to the target by one screw motion, and the arm follows (`screw_motion`).
"""

from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from experts.box_ddp import BoxDDP
from experts.checks import check_array, check_at_least
from experts.problem import FloatArray, ShootingProblem
from experts.progress import Callback
from experts.reaching import HasTolerances, reach
from experts.screw_motion import ScrewMotion
from experts.solution import Solution, StopReason
from experts.tracking import track
from experts.trajectory import Trajectory

START_REGULARIZATIONS = (1e2, 1e3, 1e4, 1e5)
"""First dampings with which the initial state is solved from zero controls; the cheapest end is kept."""
POLICY_REGULARIZATION = 1e2
"""First damping from a policy's trajectory: it is near a minimum, so longer steps than usual are safe."""
STRAYED = 3.0
"""A policy whose rollout costs this many times its own maneuver has been carried too far from it."""
SCREW_REGULARIZATION = 1e2
"""First damping from a screw motion: the arm is not wound up, and long steps seldom do that."""
ZERO_REGULARIZATION = 1e4
"""First damping from zero controls: short first steps seldom end in a poor minimum."""
REACH_REGULARIZATION = 0.0
"""First damping after the emphasis has been raised: the last minimum is near."""


@runtime_checkable
class _HasScrewMotion(Protocol):
    """A problem that guesses maneuvers from the kinematics of an arm and its tip."""

    def screw_motion(self, x0: FloatArray) -> ScrewMotion:
        """Guess the maneuver from a start."""


class _Guess(NamedTuple):
    """Controls to start a solve from.

    Attributes:
        name: What the solution's metadata call it.
        controls: Shape (N, n_u); None for zeros.
        cost: Cost of their rollout; inf if it is not finite, or not known.
        regularization: First damping of the solve.
    """

    name: str
    controls: FloatArray | None
    cost: float
    regularization: float


class _Attempt(NamedTuple):
    """A solve.

    Attributes:
        guess: Name of the guess.
        solution: Its result.
        emphasis: Factor of the final pose's weights.
    """

    guess: str
    solution: Solution
    emphasis: float = 1.0


class GuidedDDP:
    """Box-DDP that makes its own guesses, and reaches the target; give each thread its own.

    Guesses are, the cheapest rollout first, the policies of a library of solved maneuvers and, where all of
    them stray, the screw motion of the tip to its target, if the problem has a `screw_motion`; then zero
    controls. They are solved one after another until one converges, and ends within the tolerances if the
    problem `HasTolerances`. A minimum that ends outside of them is led there: the weights of the final pose
    are raised as far as that takes (`reaching`). Of several solutions the cheapest wins, first among those
    that reach the target.
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
            scene_or_problem: A scene, or a `ShootingProblem`.
            library: Solutions of this problem or of a similar one, such as the scene with another target;
                None solves the problem's own initial state, once, when a start is first asked for. Empty, it
                leaves the other guesses.
            screw_motion: Whether the tip's screw motion is a guess where no policy is near, if the problem
                knows it.
            reach_target: Whether to raise the weights of the final pose where the cheapest maneuver ends
                outside of the tolerances.
            remember: Number of converged solutions that may join the library. With 0 a solution depends on
                nothing but its start, with more also on those solved before.
            attempts: Largest number of guesses that are solved for a start.
            max_iterations: Largest number of iterations from one guess.
            tolerance: See `BoxDDP`.
            second_order: See `BoxDDP`.

        Raises:
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
        self.screw_motion, self.reach_target = screw_motion, reach_target
        self._vacancies = remember
        self._library = None if library is None else list(library)
        for i, solution in enumerate(self._library or ()):
            _check_sizes(f"library[{i}]", solution, self.problem)

    @property
    def library(self) -> tuple[Solution, ...]:
        """The solved maneuvers, whose policies are guesses; at the first look they may have to be solved.

        Raises:
            KeyboardInterrupt: If the user interrupts that.
        """
        if self._library is None:
            self._library = self._solve_initial_state()
        return tuple(self._library)

    def solve(self, x0: FloatArray | None = None, callback: Callback | None = None) -> Solution:
        """Minimize the cost from a start.

        Args:
            x0: State at stage 0, shape (n_x,), units of the state; the problem's initial state if None.
            callback: Called with the record of every iteration from this start; it may raise
                KeyboardInterrupt to end the solve.

        Returns:
            The best trajectory found; its cost is always the problem's own. Its `metadata["guess"]` names the
            guess that it came from, `metadata["emphasis"]` is the factor of the final pose's weights at which
            it is a minimum, and `metadata["attempts"]` tells of each solve the guess, emphasis, cost,
            iterations and stop reason.

        Raises:
            ValueError: If x0 has the wrong shape or is not finite, or an input has no cost of its own.
            KeyboardInterrupt: If the user interrupts the preparation of the library.
        """
        start = np.asarray(self.problem.initial_state if x0 is None else x0, dtype=np.float64)
        check_array("x0", start, (self.problem.n_states,))
        attempts: list[_Attempt] = []
        for guess in self._guesses(start):
            attempts.append(_Attempt(guess.name, self._solve_from(guess, start, callback)))
            if attempts[-1].solution.converged and not self._is_good(attempts[-1].solution):
                attempts += self._reach(attempts[-1], start, callback)
            last = attempts[-1].solution
            if self._is_good(last) or last.stop_reason is StopReason.INTERRUPTED:
                break
        # An emphasis that did not help is given up.
        good = [attempt for attempt in attempts if self._is_good(attempt.solution)]
        plain = [attempt for attempt in attempts if attempt.emphasis == 1.0]
        best = min(good or plain, key=lambda attempt: attempt.solution.cost)
        solution = best.solution
        solution.metadata["guess"], solution.metadata["emphasis"] = best.guess, best.emphasis
        solution.metadata["attempts"] = [_summary(attempt) for attempt in attempts]
        self._remember(solution)
        return solution

    def _reach(self, attempt: _Attempt, start: FloatArray, callback: Callback | None) -> list[_Attempt]:
        """Lead a minimum that ends outside of the tolerances to the target."""
        if not (self.reach_target and isinstance(self.problem, HasTolerances)):
            return []

        def solve(controls: FloatArray) -> Solution:
            return self._solve_from(_Guess("", controls, np.inf, REACH_REGULARIZATION), start, callback)

        steps = reach(self.problem, attempt.solution, solve)
        return [_Attempt(attempt.guess, step.solution, step.emphasis) for step in steps]

    def _remember(self, solution: Solution) -> None:
        """Add a solution to the library, if there is a place left for it and it is worth one."""
        known = solution.iterations == 0  # its guess, a policy, was as good
        if self._vacancies > 0 and self._library is not None and solution.converged and not known:
            self._library.append(solution)
            self._vacancies -= 1

    def _guesses(self, start: FloatArray) -> list[_Guess]:
        """The guesses to solve, the most promising first; zero controls are the last resort."""
        rollouts = [
            _Guess(f"policy {i}", *follow(solution, self.problem, start), POLICY_REGULARIZATION)
            for i, solution in enumerate(self.library)
        ]
        strayed = all(
            guess.cost > STRAYED * solution.cost
            for guess, solution in zip(rollouts, self.library, strict=True)
        )
        if strayed and self.screw_motion and isinstance(self.problem, _HasScrewMotion):
            motion = self.problem.screw_motion(start)
            rollouts.append(_Guess("screw motion", *track(self.problem, *motion), SCREW_REGULARIZATION))
        ranked = sorted(
            (guess for guess in rollouts if np.isfinite(guess.cost)), key=lambda guess: guess.cost
        )
        zero = _Guess("zero controls", None, np.inf, ZERO_REGULARIZATION)
        # Of two attempts or more the last one is left to zero controls.
        return [*ranked[: max(self.attempts - 1, 1)], zero][: self.attempts]

    def _solve_from(self, guess: _Guess, start: FloatArray, callback: Callback | None = None) -> Solution:
        self._solver.initial_regularization = guess.regularization
        return self._solver.solve(start, guess.controls, callback)

    def _is_good(self, solution: Solution) -> bool:
        """Whether a solution is converged, and within the tolerances if the problem has any."""
        if not solution.converged:
            return False
        return not isinstance(self.problem, HasTolerances) or self.problem.misses(solution.states[-1]) <= 1.0

    def _solve_initial_state(self) -> list[Solution]:
        """The best solution of the problem's own initial state; none if every rollout diverges."""
        start = np.asarray(self.problem.initial_state, dtype=np.float64)
        solutions: list[Solution] = []
        for regularization in START_REGULARIZATIONS:
            solution = self._solve_from(_Guess("zero controls", None, np.inf, regularization), start)
            if solution.stop_reason is StopReason.INTERRUPTED:
                raise KeyboardInterrupt
            solutions.append(solution)
        best = min(solutions, key=lambda solution: solution.cost)
        return [best] if np.isfinite(best.cost) else []


def follow(solution: Solution, problem: ShootingProblem, x0: FloatArray) -> tuple[FloatArray, float]:
    """Roll out the policy of a solution from another start.

    Args:
        solution: Trajectory and gains.
        problem: Gives dynamics, cost and bounds; its sizes are those of the solution.
        x0: State at stage 0, shape (n_x,), units of the state.

    Returns:
        Controls within the bounds, shape (N, n_u), units of the inputs, and the cost of the rollout, inf if
        it is not finite.
    """
    trial = Trajectory(problem)
    trial.states[0] = x0
    kernels = {name: problem.kernel(name) for name in ("difference", "step_with_cost", "terminal_cost")}
    reference = np.ascontiguousarray(solution.states), solution.controls
    policy = np.zeros_like(solution.controls), solution.feedback_gains
    cost = trial.follow(kernels, reference, policy, alpha=0.0)
    return trial.controls, cost


def _check_sizes(name: str, solution: Solution, problem: ShootingProblem) -> None:
    """Raise ValueError if a solution does not fit a problem."""
    horizon, n_controls = problem.horizon, problem.n_controls
    check_array(f"{name}.states", solution.states, (horizon + 1, problem.n_states))
    check_array(f"{name}.controls", solution.controls, (horizon, n_controls))
    gains = (horizon, n_controls, problem.n_tangent)
    check_array(f"{name}.feedback_gains", solution.feedback_gains, gains)


def _summary(attempt: _Attempt) -> dict[str, Any]:
    """What the metadata tell of an attempt, as JSON values."""
    solution = attempt.solution
    return {
        "guess": attempt.guess,
        "emphasis": attempt.emphasis,
        "cost": solution.cost,
        "iterations": solution.iterations,
        "stop_reason": solution.stop_reason.value,
    }
