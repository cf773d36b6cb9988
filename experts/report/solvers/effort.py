"""How much the benchmark of the expert measures."""

from __future__ import annotations

from dataclasses import dataclass

ITERATIONS, ACCURACY, STARTS, HORIZON = "iterations", "accuracy", "starts", "horizon"
PARTS = (ITERATIONS, ACCURACY, STARTS, HORIZON)
"""What can be measured: cost of an iteration, time to accuracy, random starts, receding horizon."""


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        repeats: Solves of each kind; the median of their times counts.
        piece_repeats: Samples of each piece of an iteration.
        max_iterations: Largest number of iterations of a solve.
        compared_starts: Random starts on which solvers are compared, besides the nominal one; with the
            scene's integrator, the nominal one with each.
        starts: Random starts of each scene.
        horizons: Stages that the receding-horizon expert looks ahead.
        episodes: Episodes of each kind of random disturbance.
        other_masses: Whether masses are among the disturbances: each is a scene to be compiled.
        papers_states: Whether the paper's formulation is compared: half a minute to be compiled.
        peers: Whether other solvers are compared, those that are installed.
        slow_peers: Also those that take minutes.
    """

    repeats: int = 5
    piece_repeats: int = 30
    max_iterations: int = 200
    compared_starts: int = 1
    starts: int = 40
    horizons: tuple[int, ...] = (25, 50, 100, 200)
    episodes: int = 1
    other_masses: bool = True
    papers_states: bool = True
    peers: bool = True
    slow_peers: bool = False


QUICK = Effort(
    repeats=1,
    piece_repeats=5,
    compared_starts=1,
    starts=2,
    horizons=(25,),
    other_masses=False,
    papers_states=False,
    peers=False,
)
FULL = Effort(repeats=9, piece_repeats=100, compared_starts=4, starts=200, episodes=5, slow_peers=True)
