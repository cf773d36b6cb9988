"""Guided DDP: initial guesses from solved maneuvers, rolled out from the requested start.

From zero controls a solve may end in a poor minimum, with joints wound up and the tip far from its target;
the controls of a maneuver solved for another start do little better, because their errors accumulate over the
stages. The policy of a solved maneuver, u = u_k + K_k (x (-) x_k), rolled out from the new start, corrects
itself: its trajectory lies in the valley of its own minimum. One good maneuver per scene is therefore enough,
and worth some effort (`START_REGULARIZATIONS`). It serves other targets as well, as it is or moved along with
the target: in empty space a maneuver may begin anywhere.

Where a policy strays too far from its maneuver, kinematics provide a guess: one screw motion leads the tip to
the target, and the arm follows (`screw_motion`).

All of this happens in few, long steps first, where a solve takes a tenth of the time and several guesses can
be compared. The policy found there, followed in the problem's own steps, is a few iterations away from their
minimum; where it is more, a solve in half the long steps comes between. Nothing is compiled for it: the
length of a step is an input of the kernels.

Where thrust is expensive and the base drifts, the cheapest maneuver may end outside the tolerances of the
task. Then they become constraints, and the solve goes on from there: it finds the cheapest maneuver that
reaches the target. Kernels with constraints are compiled for the first start that needs them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from experts.ddp.box_ddp import BoxDDP
from experts.ddp.second_order import SecondOrder
from experts.ddp.solution import Callback, IterationRecord, Solution, StopReason
from experts.guesses.policies import coarsened, follow, policies, refined, track
from experts.guesses.preparation import Preparation, keep_preparation, preparation_key, read_preparation
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
NEAR_REGULARIZATION = 0.0
"""First regularization where constraints begin, or steps become shorter: the minimum is near."""
LARGEST_COARSENING = 8
"""Most steps in a long one."""
NEAR_ITERATIONS = 10
"""Long steps are short enough if their policy is within so many iterations of the problem's own minimum."""
NEAR_ITERATIONS_CONSTRAINED = 40
"""The same where there are constraints, whose multipliers follow."""
CREEPING = 30
"""Iterations in long steps beyond which Gauss-Newton's model creeps, and the mirrored one is tried."""
SAME_MINIMUM = 1e-6
"""Minima whose costs differ by a smaller share are the same."""
CHEAPER = 0.999
"""The mirrored model is taken if the cost of its minimum is below this share of Gauss-Newton's."""


RESERVE = 0.05
"""Share of the tolerances that demonstrations and controllers keep free for rounding and disturbances."""


class _Guess(NamedTuple):
    """Controls to start a solve from."""

    name: str  # in the solution's metadata
    controls: FloatArray | None  # shape (N, n_u); None for zeros
    cost: float  # of their rollout; inf if not finite or unknown
    regularization: float  # first one of the solve
    interrupted: bool = False  # whether the user stopped the solve that led to it
    long_steps: tuple[dict[str, Any], ...] = ()  # the attempts in long steps that led to it
    multipliers: FloatArray | None = None  # of the constrained maneuver that it comes from, if it is one


class _Attempt(NamedTuple):
    """A solve."""

    guess: str
    solution: Solution


class GuidedDDP:
    """Box-DDP that makes its own guesses and reaches the target; give each thread its own.

    The guesses, cheapest rollout first, are the policies of a library of solved maneuvers and, where all of
    them stray, the screw motion of an arm's tip to its target; then zero controls. They are solved one after
    another until one converges and, if the problem has tolerances, ends within them. A minimum that ends
    outside is led to the target: the tolerances become constraints (`ArmProblem.constrained`).
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
            attempts: Most guesses to solve for a start.
            compare: Whether to solve that many, and keep the best solution, rather than stop at the first
                that converges within the tolerances. In long steps they are always compared.
            coarsening: Steps in a long one, in which a maneuver is solved first; it divides the number of
                stages. Several are solved in one after another, the longest first, each a multiple of the
                next. 1 leaves that out. None tries 8 and less on first use, also halved before the problem's
                own steps, and takes the first that is fine enough for the problem's own initial state; arms
                only.
            max_iterations: Most iterations from one guess.
            tolerance: See `BoxDDP`.
            second_order: See `BoxDDP`; where long steps are tried and Gauss-Newton's model creeps, None takes
                the mirrored one if that finds a better minimum.

        Raises:
            TypeError: If scene_or_problem is neither a scene nor a problem.
            ValueError: If a setting is out of range or unknown, the problem contradicts itself, or a solution
                of the library is not finite or has other sizes than the problem.
        """
        check_at_least("remember", remember, 0)
        check_at_least("attempts", attempts, 1)
        if not 0.0 <= reserve < 0.5:
            raise ValueError(f"reserve is {reserve}; it must be at least 0 and less than 0.5")
        self._settings: dict[str, Any] = {
            "max_iterations": max_iterations,
            "tolerance": tolerance,
            "second_order": second_order,
        }
        self._solver = BoxDDP(scene_or_problem, **self._settings)
        self.problem: ShootingProblem = self._solver.problem
        self.attempts = attempts
        self.reach_target, self.reserve = reach_target, reserve
        self._has_constraints = getattr(self.problem, "constraints", None) is not None
        self._constrained_solver: BoxDDP | None = None  # nothing is compiled for it until it is needed
        self._kinematic_guess: Callable[[FloatArray], ScrewMotion] | None = None
        if screw_motion and isinstance(self.problem, ArmProblem):
            self._kinematic_guess = partial(guess_screw_motion, self.problem)
        self.compare = compare
        self._chooses_model = second_order is None and self.problem.has_second_order
        self._vacancies = remember
        self._library = None if library is None else list(library)
        for i, solution in enumerate(self._library or ()):
            _check_sizes(f"library[{i}]", solution, self.problem)
        self._coarse: GuidedDDP | None = None
        self._coarsening: tuple[int, ...] | None = None if isinstance(self.problem, ArmProblem) else ()
        if coarsening is not None:
            self._coarsening = self._check_coarsening(coarsening)
            if self._coarsening:
                self._coarse = self._in_long_steps(self._coarsening)

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
            self._library = self._solve_initial_state()
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
        return self._solver.second_order.value

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
            The best trajectory found; its cost is always the problem's own. Its multipliers, and its report
            `constraints`, tell what reaching the target took, if the cheapest maneuver would have missed it.
            `metadata["guess"]` names its guess, and `metadata["attempts"]` lists guess, cost, iterations and
            stop reason of each solve and whether it was constrained, `metadata["long_steps"]` those in long
            steps before.

        Raises:
            ValueError: If x0 or parameters have the wrong shape or are not finite, or an input has no cost of
                its own.
            KeyboardInterrupt: If the user interrupts the preparation of the library.
        """
        given = self.problem.parameters.checked(parameters)
        _ = self.coarsening  # finding it takes nominal parameters, and so does the preparation of the library
        if self._coarse is None:
            _ = self.library
        self.problem.parameters.set(given)
        start = np.asarray(self.problem.initial_state if x0 is None else x0, dtype=np.float64)
        check_array("x0", start, (self.problem.n_states,))
        attempts: list[_Attempt] = []
        long_steps: tuple[dict[str, Any], ...] = ()
        for guess in self._guesses(start, callback):
            long_steps += guess.long_steps
            attempts += self._attempts(guess, start, callback, attempts)
            last = attempts[-1].solution
            if last.stop_reason is StopReason.INTERRUPTED or (self._is_good(last) and not self.compare):
                break
        # Constraints that did not help are dropped.
        good = [attempt for attempt in attempts if self._is_good(attempt.solution)]
        own = [attempt for attempt in attempts if attempt.solution.problem is self.problem]
        best = min(good or own or attempts, key=lambda attempt: attempt.solution.cost)
        solution = best.solution
        solution.metadata["guess"] = best.guess
        solution.metadata["attempts"] = [_summary(attempt) for attempt in attempts]
        solution.metadata["long_steps"] = list(long_steps)
        self._remember(solution)
        return solution

    def _attempts(
        self, guess: _Guess, start: FloatArray, callback: Callback | None, before: Sequence[_Attempt]
    ) -> list[_Attempt]:
        """Solve from a guess, and lead a minimum that ends outside the tolerances to the target.

        A minimum that one of the attempts before found was led from there.
        """
        solution = self._solve_from(guess, start, callback)
        attempts = [_Attempt(guess.name, solution)]
        misses = solution.converged and not self._is_good(solution)
        can_be_led = isinstance(self.problem, ArmProblem | WindowProblem) and solution.constraints is None
        costs = [attempt.solution.cost for attempt in before]
        known = np.isclose(costs, solution.cost, rtol=SAME_MINIMUM, atol=0.0).any()
        if self.reach_target and misses and can_be_led and not known:
            solver = self._constrained
            solver.initial_regularization = NEAR_REGULARIZATION
            rows = self.problem.parameters.rows
            led = solver.solve(start, solution.controls, callback, parameters=rows)
            attempts.append(_Attempt(guess.name, led))
        return attempts

    def _remember(self, solution: Solution) -> None:
        """Add a solution to the library if there is room and it is new."""
        if self._coarse is not None:
            return  # it has the library
        known = solution.iterations == 0  # its guess, a policy, was already optimal
        if self._vacancies > 0 and self._library is not None and solution.converged and not known:
            self._library.append(solution)
            self._vacancies -= 1

    def _guesses(self, start: FloatArray, callback: Callback | None) -> Iterator[_Guess]:
        """Make the guesses to solve, one after another."""
        if self._coarse is not None:
            guess = self._coarse_guess(self._coarse, start, callback)
            if guess is not None:
                yield guess
        yield from self._own_guesses(start, self.library)

    def _own_guesses(self, start: FloatArray, library: Sequence[Solution]) -> list[_Guess]:
        """List the guesses to solve, cheapest rollout first; zero controls are the last resort."""
        rollouts, strayed = [], True
        for i, solution in enumerate(library):
            for name, policy in policies(solution, self.problem).items():
                trial = follow(policy, self.problem, start)
                guess = _Guess(f"policy {i}{name}", trial.controls, trial.cost, POLICY_REGULARIZATION)
                if self._has_constraints:
                    guess = guess._replace(multipliers=_multipliers(solution))
                rollouts.append(guess)
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

    def _coarse_guess(
        self, coarse: "GuidedDDP", start: FloatArray, callback: Callback | None
    ) -> _Guess | None:
        """Solve in long steps, and follow the policy in the problem's own; None if that diverges."""
        factor = self.problem.horizon // coarse.problem.horizon

        def report(record: IterationRecord) -> None:
            """Relate costs to the problem's own stages."""
            costs = {name: factor * getattr(record, name) for name in ("cost", "expected_decrease")}
            if callback is not None:
                callback(record._replace(**costs))

        found = coarse.solve(start, report, parameters=self.problem.parameters.rows[::factor])
        policy = refined(found, self.problem)
        trial = follow(policy, self.problem, start)
        if not np.isfinite(trial.cost):
            return None
        facts = found.metadata
        attempts = facts["long_steps"] + facts["attempts"]  # those in steps twice as long come first
        return _Guess(
            facts["guess"],
            trial.controls,
            trial.cost,
            NEAR_REGULARIZATION,
            interrupted=found.stop_reason is StopReason.INTERRUPTED,
            long_steps=tuple({**attempt, "cost": factor * attempt["cost"]} for attempt in attempts),
            multipliers=_multipliers(policy),
        )

    def _solve_from(self, guess: _Guess, start: FloatArray, callback: Callback | None = None) -> Solution:
        """Solve, with the tolerances as constraints if the guess has multipliers of theirs."""
        solver = self._solver_for(guess)
        solver.initial_regularization = guess.regularization
        return solver.solve(
            start,
            guess.controls,
            _interrupt if guess.interrupted else callback,
            parameters=self.problem.parameters.rows,
            multipliers=guess.multipliers,
        )

    def _solver_for(self, guess: _Guess) -> BoxDDP:
        """The solver of a guess; its multipliers may be those of tolerances."""
        return self._solver if self._has_constraints or guess.multipliers is None else self._constrained

    @property
    def _constrained(self) -> BoxDDP:
        """The solver of the same problem with its tolerances as constraints."""
        if self._constrained_solver is None:
            problem = cast(ArmProblem | WindowProblem, self.problem).constrained(self.reserve)
            self._constrained_solver = BoxDDP(problem, **self._settings)
        return self._constrained_solver

    def _is_good(self, solution: Solution) -> bool:
        """Whether a solution has converged, and ends within the tolerances if the problem has any."""
        if not solution.converged:
            return False
        misses: Callable[[FloatArray], float] | None = getattr(self.problem, "misses", None)
        return misses is None or misses(solution.states[-1]) <= 1.0

    def _check_coarsening(self, given: int | Sequence[int]) -> tuple[int, ...]:
        """Return the factors that are more than 1; raise ValueError if one is no multiple of the next."""
        factors = tuple(given) if isinstance(given, Sequence) else (given,)
        for factor, next_one in zip(factors, (*factors[1:], 1), strict=True):
            if not isinstance(factor, int | np.integer) or factor < 1 or factor % next_one:
                raise ValueError(
                    f"coarsening is {factors}; it must be whole numbers of steps, each a multiple of the next"
                )
        found = tuple(int(factor) for factor in factors if factor > 1)
        if found and not isinstance(self.problem, ArmProblem):
            raise ValueError(f"coarsening is {factors}; only the maneuver of a scene has long steps")
        return found

    def _in_long_steps(self, coarsening: Sequence[int]) -> "GuidedDDP":
        """Make the solver in long steps, with the settings of this one; its library is this one's."""
        known, factor = self._library, coarsening[-1]
        return GuidedDDP(
            cast(ArmProblem, self.problem).coarsened(factor),
            library=None if known is None else [coarsened(member, factor) for member in known],
            screw_motion=self._kinematic_guess is not None,
            reach_target=self.reach_target,
            reserve=self.reserve,
            remember=self._vacancies,
            attempts=self.attempts,
            compare=len(coarsening) == 1,
            coarsening=[longer // factor for longer in coarsening[:-1]] or 1,
            **self._settings,
        )

    def _prepare(self) -> None:
        """Find how to solve this maneuver, or read what another process found."""
        key, known = None, None
        if type(self.problem) is ArmProblem and self._library is None and self._vacancies == 0:
            names = ("attempts", "reach_target", "reserve")
            settings = {**self._settings, **{name: getattr(self, name) for name in names}}
            kinematic = self._kinematic_guess is not None
            key = preparation_key(self.problem, {**settings, "screw_motion": kinematic})
            known = read_preparation(key)
        if known is None:
            self._coarsening = self._find_coarsening()
            if key is not None:
                found = self._coarsening, self._solver.second_order.value, self._longest.library
                keep_preparation(key, Preparation(*found))
            return
        if known.second_order != self._solver.second_order:
            self._take_model(known.second_order)
        if known.coarsening:
            self._coarse = self._in_long_steps(known.coarsening)
        self._longest._library = list(known.library)
        self._coarsening = known.coarsening

    @property
    def _longest(self) -> "GuidedDDP":
        """The solver in the longest steps, whose library is this one's."""
        return self if self._coarse is None else self._coarse._longest

    def _take_model(self, second_order: str) -> None:
        """Solve with other second derivatives from now on."""
        self._settings = {**self._settings, "second_order": second_order}
        self._solver, self._constrained_solver = BoxDDP(self.problem, **self._settings), None
        self._chooses_model = False

    def _find_coarsening(self) -> tuple[int, ...]:
        """Find the longest steps whose policy leads to the minimum in the problem's own."""
        horizon = self.problem.horizon
        for factor in range(LARGEST_COARSENING, 1, -1):
            if horizon % factor == 0 and cast(ArmProblem, self.problem).can_coarsen(factor):
                coarse = self._with_best_model(factor)
                if self._leads_to_minimum(coarse):
                    self._coarse = coarse
                    return (factor,)
                halved = self._in_halved_steps(coarse)
                if halved is not None and self._leads_to_minimum(halved):
                    self._coarse = halved
                    return (factor, factor // 2)
        return ()

    def _in_halved_steps(self, coarse: "GuidedDDP") -> "GuidedDDP | None":
        """Make the solver in half the long steps, which begins where the long ones end; None if it is no use.

        Where fast motions bend a narrow valley, most iterations lead along it: they are cheaper there. It is
        no use where long steps are so inaccurate that their policy strays in the problem's own, nor where
        half of them are those, or no whole number of them.
        """
        factor = self.problem.horizon // coarse.problem.horizon
        if factor % 2 or factor == 2 or not coarse.library:
            return None
        policy = refined(coarse.library[0], self.problem)
        if follow(policy, self.problem, self.problem.initial_state).cost > STRAYED * policy.cost:
            return None
        halved = self._in_long_steps((factor, factor // 2))
        halved._coarse = coarse
        return halved

    def _with_best_model(self, factor: int) -> "GuidedDDP":
        """Make the solver in long steps, with the mirrored model from now on if that pays."""
        coarse = self._in_long_steps((factor,))
        if self._chooses_model and coarse.library and coarse.library[0].iterations > CREEPING:
            settings = self._settings
            self._settings = {**settings, "second_order": SecondOrder.MIRRORED.value}
            mirrored = self._in_long_steps((factor,))
            if mirrored.library and mirrored.library[0].cost < CHEAPER * coarse.library[0].cost:
                self._take_model(SecondOrder.MIRRORED.value)
                return mirrored
            self._settings = settings
        return coarse

    def _leads_to_minimum(self, coarse: "GuidedDDP") -> bool:
        """Whether the policy in long steps is near a minimum in the problem's own, from its own start."""
        start = self.problem.initial_state
        self.problem.parameters.set(None)
        guess = self._coarse_guess(coarse, start, None)
        if guess is None:
            return False
        constrained = guess.multipliers is not None
        solver = self._solver_for(guess)
        most = solver.max_iterations
        solver.max_iterations = NEAR_ITERATIONS_CONSTRAINED if constrained else NEAR_ITERATIONS
        try:
            solution = self._solve_from(guess, start)
        finally:
            solver.max_iterations = most
        if solution.stop_reason is StopReason.INTERRUPTED:
            raise KeyboardInterrupt
        return solution.converged

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


def _multipliers(solution: Solution) -> FloatArray | None:
    """Multipliers of a solution to start another solve with; None where it needs none."""
    return solution.multipliers if solution.multipliers.any() else None


def _interrupt(record: IterationRecord) -> None:
    """End a solve as the user ended the one before."""
    raise KeyboardInterrupt


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
        "constrained": solution.constraints is not None,
        "cost": solution.cost,
        "iterations": solution.iterations,
        "stop_reason": solution.stop_reason.value,
    }
