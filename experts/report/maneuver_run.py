"""A maneuver from beginning to end: solved from zero controls, replayed in the environment, and timed."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np

from dq_space_arm_env.environment.rollouts import Rollout, StateFeedback, rollout
from dq_space_arm_env.kernels import Kernels, compile_scene
from dq_space_arm_env.scene import Scene, StateLayout
from dq_space_arm_env.scene.parameters import CATCH
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import IterationRecord, Solution, uninterrupted
from experts.maneuver import Maneuver
from experts.problems.arm_problem import in_double_precision
from experts.problems.shooting_problem import FloatArray

REPLAY_TOLERANCE = 1e-9
"""Largest relative difference between the cost of the replay and the solver's."""


@dataclass(frozen=True, eq=False)
class ManeuverRun:
    """A solved maneuver and its replay."""

    scene: Scene
    solution: Solution
    replay: Rollout  # of one episode
    finer_errors: tuple[float, float] | None  # deg and m at the end, see `errors_with_finer_steps`
    zero_control_cost: float  # J of doing nothing, where the solver starts
    tolerance: float  # relative decrease of the cost below which the solver has converged
    preparation_seconds: float  # to compile scene and solver, or to load both from the cache
    solve_seconds: float

    @cached_property
    def maneuver(self) -> Maneuver:
        """The trajectory of the solution."""
        return Maneuver(self.scene, self.solution.states, self.solution.controls)

    @property
    def is_finite(self) -> bool:
        """Whether there is a trajectory to look at: a diverged solve has none."""
        return math.isfinite(self.solution.cost) and bool(np.isfinite(self.solution.states).all())

    @property
    def replay_cost(self) -> float:
        """J that the environment charges."""
        return float(self.replay.cost[0])

    @property
    def cost_terms(self) -> dict[str, float]:
        """Terms of J that the environment charges, by their names in `info`."""
        return {name: float(sums[0]) for name, sums in self.replay.cost_terms.items()}

    @property
    def replay_difference(self) -> float:
        """Relative difference between the costs of the replay and of the solver; as it is where J is 0."""
        return abs(self.replay_cost - self.solution.cost) / (abs(self.solution.cost) or 1.0)

    @property
    def replay_agrees(self) -> bool:
        """Whether the environment charges what the solver planned, up to rounding."""
        return self.replay_difference <= REPLAY_TOLERANCE


def run_maneuver(
    scene: Scene,
    max_iterations: int | None = None,
    on_start: Callable[[], None] = lambda: None,
    on_iteration: Callable[[IterationRecord], None] | None = None,
) -> ManeuverRun:
    """Solve a scene from zero controls and replay the plan, both in double precision.

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
    exact = in_double_precision(scene)
    # First of all: a scene that cannot be replayed is refused before the solve.
    nothing = replay(exact, np.zeros((scene.simulation.steps, StateLayout.of(scene).n_u)))
    _compile_solver(scene)
    solver = BoxDDP(scene) if max_iterations is None else BoxDDP(scene, max_iterations=max_iterations)
    prepared = perf_counter()
    on_start()
    solution = solver.solve(callback=on_iteration)
    solved = perf_counter()
    solution.metadata["scene"] = scene.model_dump(mode="json")
    return ManeuverRun(
        scene=scene,
        solution=solution,
        replay=replay(exact, solution.controls),
        finer_errors=errors_with_finer_steps(exact, solution.controls),
        zero_control_cost=float(nothing.cost[0]),
        tolerance=solver.tolerance,
        preparation_seconds=prepared - started,
        solve_seconds=solved - prepared,
    )


def _compile_solver(scene: Scene) -> None:
    """Take one iteration, to keep the compiler's time out of the solve's."""
    uninterrupted(BoxDDP(scene, max_iterations=1).solve())


def replay(scene: Scene, controls: FloatArray) -> Rollout:
    """Play controls, shape (N, n_u), in the environment from the scene's nominal start."""
    kernels = compile_scene(scene)
    actions = kernels.layout.to_action(controls, kernels.stage_parameters()[: len(controls)])
    return rollout(StateFeedback(lambda states, step: actions[step, None]), scene)


def errors_with_finer_steps(
    scene: Scene, controls: FloatArray, substeps: int = 4
) -> tuple[float, float] | None:
    """Errors of the worst tip [deg, m] at the end of a plan that RK4 integrates with a shorter time step.

    None where an actuator has a delay: it is whole steps, and shorter in shorter ones.
    """
    if any(chain.delay for chain in StateLayout.of(scene).chains):
        return None
    kernels, dt = compile_scene(scene), scene.simulation.dt / substeps
    finer = np.repeat(controls, substeps, axis=0)
    rows = in_substeps(kernels, kernels.stage_parameters()[: len(controls)], substeps)
    with np.errstate(all="ignore"):
        start = kernels.layout.initial_state
        end = kernels.simulate(start, finer, len(finer), dt, "rk4", every=len(finer), p=rows)[-1]
    attitude, position, *_ = kernels.tip_errors(end, p=kernels.stage_parameters()[-1]).tolist()
    return attitude, position


def in_substeps(kernels: Kernels, rows: FloatArray, substeps: int) -> FloatArray:
    """Parameters of shorter steps, shape (N substeps, n_p), from those of N stages, (N, n_p)."""
    finer: FloatArray = np.repeat(rows, substeps, axis=0)
    for entry in kernels.parameters.indices(CATCH):  # at the end of a stage alone
        finer[np.arange(len(finer)) % substeps < substeps - 1, entry] = 0.0
    return finer
