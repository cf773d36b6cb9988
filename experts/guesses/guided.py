"""Guided DDP: box-DDP from initial guesses (`initial_guesses`), which reaches the target.

One good maneuver per scene is enough to guess from, and worth some effort (`GuessSolver`).

All of this happens in few, long steps first (`coarsening`), where a solve takes a tenth of the time and
several guesses can be compared. The policy found there, followed in the problem's own steps, is a few
iterations away from their minimum.

Where thrust is expensive and the base drifts, the cheapest maneuver may end outside the tolerances of the
task. Then they become constraints, and the solve goes on from there: it finds the cheapest maneuver that
reaches the target. Kernels with constraints are compiled for the first start that needs them.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NoReturn, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.common.real_arrays import real_array
from experts.ddp.second_order import SecondOrder
from experts.ddp.solution import (
    Callback,
    IterationRecord,
    Solution,
    StopReason,
    as_interrupted,
    uninterrupted,
)
from experts.guesses.attempts import Attempt, GuessSolver
from experts.guesses.coarsening import checked_factors, find_coarsening
from experts.guesses.initial_guesses import (
    NEAR_REGULARIZATION,
    SCREW_REGULARIZATION,
    Guess,
    KinematicGuess,
    multipliers_of,
    ranked_guesses,
    zero_controls,
)
from experts.guesses.other_side import other_side
from experts.guesses.policies import coarsened, follow, refined, track
from experts.guesses.preparation import Preparation, keep_preparation, preparation_key, read_preparation
from experts.guesses.screw_motion import screw_motion as guess_screw_motion
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import (
    FloatArray,
    ShootingProblem,
    check_array,
    check_at_least,
    check_state,
    check_whole,
)

RESERVE = 0.05
"""Share of the tolerances that demonstrations and controllers keep free for rounding and disturbances."""


class GuidedDDP:
    """Box-DDP that makes its own guesses and reaches the target; each thread needs one, of its own problem.

    The guesses, cheapest rollout first, are the policies of a library of solved maneuvers and, where all of
    them stray, the screw motion of an arm's tip to its target; then zero controls; in long steps also the
    other side of an obstacle. They are solved one after another until one converges and, if the problem has
    tolerances, ends within them. A minimum that ends outside is led to the target: the tolerances become
    constraints (`ArmProblem.constrained`).
    The cheapest solution wins, among those that reach the target if there are any.
    """

    def __init__(
        self,
        scene_or_problem: Any,
        *,
        library: Iterable[Solution] | None = None,
        screw_motion: bool = True,
        reach_target: bool = True,
        reserve: float = 0.0,
        remember: int = 0,
        attempts: int = 2,
        compare: bool = False,
        coarsening: int | Sequence[int] | None = None,
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
            reach_target: Whether the tolerances become constraints where the cheapest maneuver ends outside
                them; arms only.
            reserve: Share of the tolerances to keep free where they become constraints, for disturbances.
            remember: Number of converged solutions that may join the library. With 0 a solution depends on
                its start alone, otherwise also on those solved before.
            attempts: Most guesses to solve for a start; with long steps, the guess from them comes on top.
            compare: Whether to solve that many, and keep the best solution, rather than stop at the first
                that converges within the tolerances. In long steps they are always compared.
            coarsening: Steps in a long one, in which a maneuver is solved first; it divides the number of
                stages. Several are solved in one after another, the longest first, each a multiple of the
                next. 1 or none at all leaves that out. None tries 8 and less on first use, also halved before
                the problem's own steps, and takes the first that is fine enough for the problem's own initial
                state; arms only.
            max_iterations: Most iterations from one guess.
            tolerance: See `BoxDDP`.
            second_order: See `BoxDDP`; where long steps are tried, None takes the mirrored model if
                Gauss-Newton's creeps or misses the target, and the mirrored one finds a better minimum or
                reaches it.

        Raises:
            TypeError: If scene_or_problem is neither a scene nor a problem, or the library holds what is no
                solution.
            ValueError: If a setting is out of range, no whole number or unknown, the problem contradicts
                itself, or a solution of the library is not finite or has other sizes than the problem.
        """
        check_whole("remember", remember, 0)
        check_whole("attempts", attempts, 1)
        check_at_least("reserve", reserve, 0.0)
        if reserve >= 0.5:
            raise ValueError(f"reserve is {reserve}; it must be less than 0.5")
        settings = {"max_iterations": max_iterations, "tolerance": tolerance, "second_order": second_order}
        self._solver = GuessSolver(scene_or_problem, reach_target=reach_target, reserve=reserve, **settings)
        self.problem: ShootingProblem = self._solver.problem
        self.attempts, self.reserve = attempts, reserve
        self._kinematic_guess: KinematicGuess | None = None
        if screw_motion and isinstance(self.problem, ArmProblem):
            self._kinematic_guess = partial(guess_screw_motion, self.problem)
        self.compare = compare
        self.chooses_model = second_order is None and self.problem.has_second_order
        self._vacancies = remember
        self._library = None if library is None else list(library)
        for i, solution in enumerate(self._library or ()):
            _check_sizes(f"library[{i}]", solution, self.problem)
        self._callback: Callback | None = None  # of the preparation
        self._coarse: GuidedDDP | None = None
        self._coarsening: tuple[int, ...] | None = None if isinstance(self.problem, ArmProblem) else ()
        if coarsening is not None:
            self._coarsening = checked_factors(coarsening, self.problem)
            if self._coarsening:
                self._coarse = self.in_long_steps(self._coarsening)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a GuidedDDP cannot be copied or pickled, its machine code and work arrays are its own: make "
            "another one of the same scene or problem, with the same library"
        )

    def prepare(self, callback: Callback | None = None) -> None:
        """Find the long steps and solve the library now, not on first use.

        Args:
            callback: Called with the record of every iteration, whose costs are sums over the stages of the
                steps that it is solved in; it may raise KeyboardInterrupt to end the preparation. Nothing is
                iterated where another process has prepared the same.

        Raises:
            KeyboardInterrupt: If the user interrupts it.
        """
        self._report_to(callback)
        try:
            _ = self.library
        finally:
            self._report_to(None)

    @property
    def library(self) -> tuple[Solution, ...]:
        """The maneuvers whose policies are guesses; the first access may solve them, in long steps if any.

        Raises:
            KeyboardInterrupt: If the user interrupts that solve.
        """
        _ = self.coarsening  # may find the solver in long steps
        if self._coarse is not None:
            return tuple(refined(solution, self.problem) for solution in self._coarse.library)
        if self._library is None:
            self._library = self._solver.solve_initial_state(self._callback)
        return tuple(self._library)

    @property
    def coarsening(self) -> tuple[int, ...]:
        """Steps in a long one, in which a maneuver is solved first, the longest first; empty for none.

        The first access finds them, or reads what another process found.

        Raises:
            KeyboardInterrupt: If the user interrupts that.
        """
        if self._coarsening is None:
            self._prepare()
        return cast(tuple[int, ...], self._coarsening)

    @property
    def second_order(self) -> str:
        """Second derivatives that it uses, see `BoxDDP`; found together with `coarsening`."""
        _ = self.coarsening
        return self._solver.second_order

    def solve(
        self,
        x0: FloatArray | None = None,
        callback: Callback | None = None,
        *,
        parameters: ArrayLike | None = None,
    ) -> Solution:
        """Minimize the cost from a start.

        Args:
            x0: State at stage 0, shape (n_x,), units of the state; the problem's initial state if None. Of q
                and -q, which cost differently, `env.reset` gives the base the one nearer to the target.
            callback: Called with the record of every iteration from this start; it may raise
                KeyboardInterrupt to end the solve.
            parameters: What varies in the problem, shape (n_p,) or (N + 1, n_p), see `BoxDDP.solve`; None
                for nominal ones.

        Returns:
            The best trajectory found; its cost is always the problem's own. Its multipliers, and its report
            `constraints`, tell what reaching the target took, if the cheapest maneuver would have missed it.
            `metadata["guess"]` names its guess, and `metadata["attempts"]` lists guess, cost, iterations and
            stop reason of each solve and whether it was constrained, `metadata["long_steps"]` those in long
            steps before.

        Raises:
            TypeError: If x0 or parameters are masked or not of real numbers.
            ValueError: If x0 or parameters have the wrong shape or are not finite, or an input has no cost of
                its own.
            KeyboardInterrupt: If the user interrupts the preparation of the library, or what comes before the
                first solve.
        """
        given = np.array(self.problem.parameters.checked(parameters))  # which may be the problem's own
        _ = self.coarsening  # finding it takes nominal parameters, and so does the preparation of the library
        if self._coarse is None:
            _ = self.library
        self.problem.parameters.set(given)
        start = real_array("x0", self.problem.initial_state if x0 is None else x0, np.float64)
        check_array("x0", start, (self.problem.n_states,))
        check_state(self.problem, "x0", start)
        attempts: list[Attempt] = []
        long_steps: tuple[dict[str, Any], ...] = ()
        try:
            for guess in self._guesses(start, callback):
                long_steps += guess.long_steps
                attempts += self._solver.attempts(guess, start, callback, attempts)
                last = attempts[-1].solution
                ends = guess.interrupted or last.stop_reason is StopReason.INTERRUPTED
                if ends or (self._solver.is_good(last) and not self.compare):
                    break
            if self.compare and not ends:
                attempts += self._other_side(attempts, start, callback)
                ends = attempts[-1].solution.stop_reason is StopReason.INTERRUPTED
        except KeyboardInterrupt:  # on the way from one solve to the next
            if not attempts:
                raise
            ends = True
        solution = self._solver.best(attempts)
        if ends:  # that the cheapest attempt converged does not undo the interrupt
            solution = as_interrupted(solution)
        solution.metadata["long_steps"] = list(long_steps)
        self._remember(solution)
        return solution

    def _other_side(
        self, attempts: Sequence[Attempt], start: FloatArray, callback: Callback | None
    ) -> list[Attempt]:
        """Solve on the other side of an obstacle that is in the way of the best solution so far, if any."""
        if not self._solver.has_constraints or not isinstance(self.problem, ArmProblem):
            return []
        best = self._solver.best(attempts)
        motion = other_side(self.problem, best)
        if motion is None:
            return []
        controls, cost = track(self.problem, *motion)
        # The rows count from the first step on: without them the path would slip back through the obstacle.
        guess = Guess(
            "other side", controls, cost, SCREW_REGULARIZATION, multipliers=np.zeros_like(best.multipliers)
        )
        return self._solver.attempts(guess, start, callback, attempts) if np.isfinite(cost) else []

    def _remember(self, solution: Solution) -> None:
        """Add a solution to the library if there is room and it is new."""
        if self._coarse is not None:
            return  # it has the library
        known = solution.iterations == 0  # its guess, a policy, was already optimal
        if self._vacancies > 0 and self._library is not None and solution.converged and not known:
            self._library.append(solution)
            self._vacancies -= 1

    def _guesses(self, start: FloatArray, callback: Callback | None) -> Iterator[Guess]:
        """Make the guesses to solve, one after another."""
        if self._coarse is not None:
            guess = self._coarse_guess(self._coarse, start, callback)
            if guess is not None:
                yield guess
        # The last of two or more attempts starts from zero controls.
        ranked = ranked_guesses(self.problem, start, self.library, self._kinematic_guess)
        yield from [*ranked[: max(self.attempts - 1, 1)], zero_controls()][: self.attempts]

    def _coarse_guess(
        self, coarse: "GuidedDDP", start: FloatArray, callback: Callback | None
    ) -> Guess | None:
        """Solve in long steps, and follow the policy in the problem's own; None if that diverges.

        Where the user interrupts that, and it diverges, the guess is zero controls.
        """
        factor = self.problem.horizon // coarse.problem.horizon

        def report(record: IterationRecord) -> None:
            """Relate costs to the problem's own stages."""
            costs = {name: factor * getattr(record, name) for name in ("cost", "expected_decrease")}
            if callback is not None:
                callback(record._replace(**costs))

        rows = cast(ArmProblem, coarse.problem).in_long_steps(self.problem.parameters.rows)
        found = coarse.solve(start, report, parameters=rows)
        policy = refined(found, self.problem)
        trial = follow(policy, self.problem, start)
        interrupted = found.stop_reason is StopReason.INTERRUPTED
        if not np.isfinite(trial.cost):
            return zero_controls()._replace(interrupted=True) if interrupted else None
        facts = found.metadata
        attempts = facts["long_steps"] + facts["attempts"]  # those in steps twice as long come first
        return Guess(
            facts["guess"],
            trial.controls,
            trial.cost,
            NEAR_REGULARIZATION,
            interrupted=interrupted,
            long_steps=tuple({**attempt, "cost": factor * attempt["cost"]} for attempt in attempts),
            multipliers=multipliers_of(policy),
        )

    def in_long_steps(
        self, coarsening: Sequence[int], *, second_order: str | None = None, after: Self | None = None
    ) -> Self:
        """Make the solver in long steps, with the settings of this one; its library is this one's.

        Args:
            coarsening: Steps in a long one, the longest first.
            second_order: Second derivatives that it uses; None for those of this one.
            after: The solver in longer steps that it begins with, if there is one already.

        Returns:
            That solver.
        """
        known, factor = self._library, coarsening[-1]
        problem = cast(ArmProblem, self.problem).coarsened(factor)
        settings = self._solver.settings
        if second_order is not None:
            settings["second_order"] = second_order
        found = type(self)(
            problem,
            library=None if known is None else [coarsened(member, problem) for member in known],
            screw_motion=self._kinematic_guess is not None,
            remember=self._vacancies,
            attempts=self.attempts,
            compare=len(coarsening) == 1,
            coarsening=[longer // factor for longer in coarsening[:-1]] or 1,
            **settings,
        )
        if after is not None:
            found._coarse = after
        found._report_to(self._callback)
        return found

    def _report_to(self, callback: Callback | None) -> None:
        """Report the iterations of the preparation to a callback from now on."""
        self._callback = callback
        if self._coarse is not None:
            self._coarse._report_to(callback)

    def _prepare(self) -> None:
        """Find how to solve this maneuver, or read what another process found."""
        key, known = None, None
        if type(self.problem) is ArmProblem and self._library is None and self._vacancies == 0:
            key = preparation_key(self.problem, self._own_settings)
            known = read_preparation(key)
        if known is None:
            self._coarsening, self._coarse = find_coarsening(self)
            if key is not None:
                try:
                    self._take_model_that_reaches()
                except KeyboardInterrupt:
                    self._coarsening = None  # the next access begins anew
                    raise
                found = self._coarsening, self._solver.second_order, self._longest.library
                keep_preparation(key, Preparation(*found))
            return
        if known.second_order != self._solver.second_order:
            self.take_model(known.second_order)
        if known.coarsening:
            self._coarse = self.in_long_steps(known.coarsening)
        self._longest._library = list(known.library)
        self._coarsening = known.coarsening

    def _take_model_that_reaches(self) -> None:
        """Take the mirrored model if only that reaches the target, from the problem's own start."""
        if not self.chooses_model or not self._solver.reach_target or self._reaches():
            return
        other = type(self)(self.problem, **self._own_settings | {"second_order": SecondOrder.MIRRORED.value})
        other._report_to(self._callback)
        if other._reaches():
            self.take_model(other.second_order)
            self._coarsening, self._coarse, self._library = other._coarsening, other._coarse, other._library

    def _reaches(self) -> bool:
        """Whether the maneuver from the problem's own start reaches the target."""
        longest = self._longest
        if any(map(longest._solver.is_good, longest.library)):
            return True
        return self._solver.is_good(uninterrupted(self.solve(callback=self._callback)))

    @property
    def _own_settings(self) -> dict[str, Any]:
        """The settings that a preparation follows from, by their names."""
        own = {"attempts": self.attempts, "compare": self.compare}
        return {**self._solver.settings, **own, "screw_motion": self._kinematic_guess is not None}

    @property
    def _longest(self) -> "GuidedDDP":
        """The solver in the longest steps, whose library is this one's."""
        return self if self._coarse is None else self._coarse._longest

    def take_model(self, second_order: str) -> None:
        """Solve with other second derivatives from now on.

        Args:
            second_order: See `BoxDDP`.
        """
        self._solver = self._solver.with_model(second_order)
        self.chooses_model = False

    def leads_to_minimum(self, coarse: "GuidedDDP") -> bool:
        """Tell whether the policy in long steps is near a minimum in the problem's own, from its own start.

        Args:
            coarse: The solver in them.

        Returns:
            Whether it is.
        """
        start = self.problem.initial_state
        self.problem.parameters.set(None)
        guess = self._coarse_guess(coarse, start, self._callback)
        return guess is not None and self._solver.is_near_minimum(guess, start, self._callback)


def _check_sizes(name: str, solution: Solution, problem: ShootingProblem) -> None:
    """Raise TypeError for what is no solution, ValueError for one that does not fit a problem."""
    if not isinstance(solution, Solution):
        raise TypeError(f"{name} is of type {type(solution).__name__}; it must be a Solution")
    horizon, n_controls = problem.horizon, problem.n_controls
    check_array(f"{name}.states", solution.states, (horizon + 1, problem.n_states))
    check_array(f"{name}.controls", solution.controls, (horizon, n_controls))
    gains = (horizon, n_controls, problem.n_tangent)
    check_array(f"{name}.feedback_gains", solution.feedback_gains, gains)
