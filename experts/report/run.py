"""A maneuver from beginning to end: solved from zero controls, carried out, and timed."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.scene import StateLayout
from experts.box_ddp import BoxDDP
from experts.report.maneuver import Maneuver
from experts.report.replay import Replay, errors_with_finer_steps, replay
from experts.solution import IterationRecord, Solution, StopReason

REPLAY_TOLERANCE = 1e-9
"""Largest relative difference between the return of the replay and minus the solver's cost."""


@dataclass(frozen=True, eq=False)
class ManeuverRun:
    """A solved maneuver, and what became of it.

    Attributes:
        scene: The scene.
        solution: What the solver found.
        replay: The plan in the environment.
        finer_errors: Attitude error [deg] and position error [m] at the end, if the same controls are
            integrated with RK4 and a quarter of the time step.
        zero_control_cost: Cost of doing nothing, where the solver starts; dimensionless.
        tolerance: Relative decrease of the cost below which the solver has converged.
        preparation_seconds: Time to compile the scene and the solver, or to load both from the cache, s.
        solve_seconds: Time of the solve, s.
    """

    scene: Scene
    solution: Solution
    replay: Replay
    finer_errors: tuple[float, float]
    zero_control_cost: float
    tolerance: float
    preparation_seconds: float
    solve_seconds: float

    @cached_property
    def maneuver(self) -> Maneuver:
        """The trajectory of the solution."""
        return Maneuver(self.scene, self.solution.states, self.solution.controls)

    @property
    def is_finite(self) -> bool:
        """Whether there is a trajectory to look at: a diverged one has none."""
        return math.isfinite(self.solution.cost) and bool(np.isfinite(self.solution.states).all())

    @property
    def replay_difference(self) -> float:
        """Difference between the return of the replay and minus the solver's cost, relative to the cost."""
        return abs(self.replay.total_reward + self.solution.cost) / abs(self.solution.cost)

    @property
    def replay_agrees(self) -> bool:
        """Whether the environment charges what the solver has planned, up to rounding."""
        return self.replay_difference <= REPLAY_TOLERANCE


def run_maneuver(
    scene: Scene,
    max_iterations: int | None = None,
    on_start: Callable[[], None] | None = None,
    on_iteration: Callable[[IterationRecord], None] | None = None,
) -> ManeuverRun:
    """Solve a scene from zero controls and carry the plan out.

    Args:
        scene: The scene.
        max_iterations: Largest number of iterations; the solver's default if None.
        on_start: Called when everything is compiled and the solve begins.
        on_iteration: Called after every iteration.

    Returns:
        The run; also when the solve was interrupted, with the best trajectory so far.

    Raises:
        KeyboardInterrupt: If interrupted outside of the solve.
        ValueError: If the environment refuses the scene, or the number of iterations is negative.
    """
    started = perf_counter()
    # First of all, so that a scene which cannot be replayed is refused before the solve.
    nothing = replay(scene, np.zeros((scene.simulation.steps, StateLayout.of(scene).n_u)))
    _compile_solver(scene)
    solver = BoxDDP(scene) if max_iterations is None else BoxDDP(scene, max_iterations=max_iterations)
    prepared = perf_counter()
    if on_start is not None:
        on_start()
    solution = solver.solve(callback=on_iteration)
    solved = perf_counter()
    solution.metadata["scene"] = scene.model_dump(mode="json")
    return ManeuverRun(
        scene=scene,
        solution=solution,
        replay=replay(scene, solution.controls),
        finer_errors=errors_with_finer_steps(scene, solution.controls),
        zero_control_cost=-nothing.total_reward,
        tolerance=solver.tolerance,
        preparation_seconds=prepared - started,
        solve_seconds=solved - prepared,
    )


def _compile_solver(scene: Scene) -> None:
    """Take one iteration, so that the time of the solve is not that of the compiler."""
    if BoxDDP(scene, max_iterations=1).solve().stop_reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt
