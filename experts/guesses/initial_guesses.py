"""Controls to start a solve from: policies of solved maneuvers, a screw motion, zeros.

From zero controls a solve may end in a poor minimum, with joints wound up and the tip far from its target;
the controls of a maneuver solved for another start do little better, because their errors accumulate over the
stages. The policy of a solved maneuver, u = u_k + K_k (x (-) x_k), rolled out from the new start, corrects
itself: its trajectory lies in the valley of its own minimum. It serves other targets as well, as it is or
moved along with the target: in empty space a maneuver may begin anywhere.

Where a policy strays too far from its maneuver, kinematics provide a guess: one screw motion leads the tip to
the target, and the arm follows (`screw_motion`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from experts.ddp.solution import Solution
from experts.guesses.policies import follow, policies, track
from experts.guesses.screw_motion import ScrewMotion
from experts.problems.shooting_problem import FloatArray, ShootingProblem

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

KinematicGuess = Callable[[FloatArray], ScrewMotion]


class Guess(NamedTuple):
    """Controls to start a solve from."""

    name: str  # in the solution's metadata
    controls: FloatArray | None  # shape (N, n_u); None for zeros
    cost: float  # of their rollout; inf if not finite or unknown
    regularization: float  # first one of the solve
    interrupted: bool = False  # whether the user stopped the solve that led to it
    long_steps: tuple[dict[str, Any], ...] = ()  # the attempts in long steps that led to it
    multipliers: FloatArray | None = None  # of the constrained maneuver that it comes from, if it is one


def zero_controls(regularization: float = ZERO_REGULARIZATION) -> Guess:
    """The last resort."""
    return Guess("zero controls", None, np.inf, regularization)


def ranked_guesses(
    problem: ShootingProblem,
    start: FloatArray,
    library: Sequence[Solution],
    kinematic_guess: KinematicGuess | None,
) -> list[Guess]:
    """List the guesses from a start whose rollouts are finite, the cheapest first."""
    constraints = getattr(problem, "constraints", None)
    rollouts, strayed = [], True
    for i, solution in enumerate(library):
        for name, policy in policies(solution, problem).items():
            trial = follow(policy, problem, start)
            guess = Guess(f"policy {i}{name}", trial.controls, trial.cost, POLICY_REGULARIZATION)
            # A similar problem may have other constraints.
            if constraints is not None and solution.multipliers.shape == constraints.multipliers.shape:
                guess = guess._replace(multipliers=multipliers_of(solution))
            rollouts.append(guess)
            strayed = strayed and trial.cost > STRAYED * solution.cost
    motion = _motion(kinematic_guess, start) if strayed and kinematic_guess is not None else None
    if motion is not None:
        controls, cost = track(problem, *motion)
        rollouts.append(Guess("screw motion", controls, cost, SCREW_REGULARIZATION))
    return sorted((guess for guess in rollouts if np.isfinite(guess.cost)), key=lambda guess: guess.cost)


def _motion(kinematic_guess: KinematicGuess, start: FloatArray) -> ScrewMotion | None:
    """The guess from a start; None where kinematics overflow."""
    try:
        with np.errstate(all="ignore"):
            motion = kinematic_guess(start)
    except np.linalg.LinAlgError:
        return None
    return motion if all(np.isfinite(each).all() for each in motion) else None


def multipliers_of(solution: Solution) -> FloatArray | None:
    """Multipliers of a solution to start another solve with; None where it needs none."""
    return solution.multipliers if solution.multipliers.any() else None
