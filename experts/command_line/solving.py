"""A solve: prepared, solved, judged, saved."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console, ConsoleRenderable

from dq_space_arm_env import Scene
from dq_space_arm_env.command_line.simulated_episode import (
    Start,
    begin,
    catch_rows,
    error_rows,
    flown_catches,
)
from dq_space_arm_env.command_line.verb import keeping
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.tables import plain_table
from dq_space_arm_env.environment.catches import Catch, ends_held
from dq_space_arm_env.scene import StateLayout
from experts import BoxDDP, GuidedDDP, Solution, StopReason
from experts.maneuver import Maneuver
from experts.problems.arm_problem import ArmProblem
from experts.report import SolveProgress, reproduction

AS_IF_CAUGHT = "as if the payload were caught; `dq-space-arm simulate` flies on without it"
TO_CATCH = (
    "let the robot coast in one step before the catch, with cost.pose and cost.tip_twist of 1e6 there: "
    "docs/maneuver.md, Phases"
)
"""What helps where a catch is missed."""
SPARED = 0.1
"""An actuator that never takes so large a share of its limit is hardly used."""


@dataclass(frozen=True, eq=False)
class SolveRun:
    """A solve and its result."""

    scene: Scene
    start: Start
    solver: str
    solution: Solution
    final_errors: tuple[float, ...]  # see `Kernels.tip_errors`; infinite where the motion has diverged
    catches: list[Catch]
    preparation_seconds: float  # compile or load, and solve the guesses' source, s
    preparation_iterations: int | None  # of the solve from the scene's own start; None without
    solve_seconds: float  # s

    @property
    def interrupted(self) -> bool:
        """Whether the user stopped it."""
        return self.solution.stop_reason is StopReason.INTERRUPTED

    @property
    def is_success(self) -> bool:
        """Whether the payload is caught where it is to be, and all tips end within the tolerances."""
        return self.ends_within and ends_held(self.catches)

    @property
    def ends_within(self) -> bool:
        """Whether all tips end within the scene's tolerances."""
        tolerances = self.scene.success.tolerances
        return all(error <= most for error, most in zip(self.final_errors, tolerances, strict=False))


def check_figures() -> None:
    """Refuse figures without Matplotlib."""
    if find_spec("matplotlib") is None:
        raise ValueError('--figures needs matplotlib: pip install "dq-space-arm[plots]"')


def default_folder(scene: str, seed: int | None) -> Path:
    """Name the folder of a solution of a scene, given by its name or file."""
    folder = reproduction.results_folder(scene, "solutions")
    return folder if seed is None else folder.with_name(f"{folder.name}-{seed}")


def solve(
    scene: Scene,
    console: Console,
    *,
    seed: int | None = None,
    start: str | None = None,
    guided: bool = True,
    max_iterations: int | None = None,
) -> SolveRun:
    """Solve a scene."""
    limits: dict[str, Any] = {} if max_iterations is None else {"max_iterations": max_iterations}
    began = perf_counter()
    with SolveProgress(console, scene) as progress:
        with keeping("nothing is saved yet, as the first trajectory comes after the preparation"):
            begun = begin(scene, seed, start)
            solver: BoxDDP | GuidedDDP = GuidedDDP(scene, **limits) if guided else BoxDDP(scene, **limits)
            before = None
            if isinstance(solver, GuidedDDP):
                solver.prepare(progress.update)  # now, to time this solve alone
                before = sum(known.iterations for known in solver.library)
        prepared = perf_counter()
        progress.start()
        solution = solver.solve(begun.state, callback=progress.update, parameters=begun.parameters)
    solved = perf_counter()
    errors = _final_errors(scene, solution)
    caught = flown_catches(begun, solution.states, solution.controls)
    # The files are of the episode's scene, where what was drawn is constant; what changes on the way is not.
    every, kept = (StateLayout.of(each).parameters.names for each in (scene, begun.episode_scene))
    solution.parameters = solution.parameters[:, [every.index(name) for name in kept]]
    solution.metadata |= {"scene": begun.episode_scene.model_dump(mode="json"), "start": begun.title}
    name = type(solver).__name__
    return SolveRun(scene, begun, name, solution, errors, caught, prepared - began, before, solved - prepared)


def _final_errors(scene: Scene, solution: Solution) -> tuple[float, ...]:
    """See `SolveRun.final_errors`."""
    errors = ArmProblem(scene).kernels.tip_errors(solution.states[-1], p=solution.parameters[-1])
    return tuple(errors.tolist()) if math.isfinite(solution.cost) else (math.inf,) * len(errors)


def save(run: SolveRun, folder: Path, *, figures: bool) -> list[Path]:
    """Write the files of a run."""
    summary = {**record(run), **provenance()}
    files = reproduction.save(run.solution, run.start.episode_scene, summary, folder)
    if figures and math.isfinite(run.solution.cost):
        from experts.figures import write_figures

        maneuver = Maneuver(run.start.episode_scene, run.solution.states, run.solution.controls)
        files += write_figures(maneuver, folder)
    return files


def record(run: SolveRun) -> dict[str, Any]:
    """Describe a run for programs."""
    solution = run.solution
    attitude, position, *velocities = run.final_errors
    found = {
        "scene": run.scene.name,
        "start": run.start.title,
        "initial_state": run.start.state.tolist(),
        "solver": run.solver,
        "guess": solution.metadata.get("guess", "zero controls"),
        "cost": solution.cost,
        "converged": solution.converged,
        "stop_reason": solution.stop_reason.value,
        "message": solution.message,
        "optimality": solution.optimality,
        "iterations": solution.iterations,
        "preparation_seconds": run.preparation_seconds,
        "preparation_iterations": run.preparation_iterations,
        "solve_seconds": run.solve_seconds,
        "final_attitude_error_deg": attitude,
        "final_position_error_m": position,
        "is_success": run.is_success,
    }
    if velocities:
        turning, moving = velocities
        found |= {"final_angular_velocity_error_deg_s": turning, "final_velocity_error_m_s": moving}
    if run.catches:
        found["missed_catches"] = [catch.phase for catch in run.catches if not catch.is_met]
    return {name: json_value(value) for name, value in found.items()}


def table(run: SolveRun) -> ConsoleRenderable:
    """Describe a run for people."""
    solution = run.solution
    verdict = "converged" if solution.converged else f"NOT converged ({solution.stop_reason.value})"
    guess = str(solution.metadata.get("guess", "zero controls"))
    if guess.startswith("policy"):
        guess = "the prepared maneuver, with its feedback gains"
    prepared = "machine code loaded or compiled"
    if run.preparation_iterations is not None:
        prepared += f"; the maneuver from its own start, {run.preparation_iterations} iterations"
    seconds = f"{run.solve_seconds:.2f} s"
    long_steps = solution.metadata.get("long_steps", ())
    if long_steps:
        prepared += " in long steps"
        seconds += f", after {sum(attempt['iterations'] for attempt in long_steps)} in long steps"
    if solution.converged and solution.iterations == 0:
        seconds += ": the initial guess is already optimal"
    led, condition = "", ""
    is_led = solution.constraints is not None and not run.scene.constraints
    if is_led:
        led = "the tolerances are constraints: the cheapest maneuver would miss the target"
    elif not run.ends_within and any(each["constrained"] for each in solution.metadata.get("attempts", ())):
        led = "of the cheapest maneuver; none that reaches the target was found"
    if not ends_held(run.catches):
        led = "; ".join(filter(None, (AS_IF_CAUGHT, led)))
        condition = " as if caught"
    maneuver = Maneuver(run.start.episode_scene, solution.states, solution.controls)
    rows = [
        ("start", run.start.title, ""),
        ("preparation", f"{run.preparation_seconds:.1f} s", prepared),
        ("solver", run.solver, f"initial guess: {guess}"),
        ("cost J", f"{solution.cost:.6f}", led),
        *([_dearest(maneuver)] if is_led else []),
        ("end", verdict, solution.message),
        ("iterations", str(solution.iterations), seconds),
    ]
    for catch in run.catches:
        rows += catch_rows(catch)
        rows += [] if catch.is_met else [("  to meet it", "", TO_CATCH)]
    rows += error_rows(run.scene.success, run.final_errors, condition)
    if not run.ends_within and math.isfinite(solution.cost):
        rows += _spared(maneuver)
    return plain_table(f"Scene {run.scene.name}", ("", "", ""), rows)


def _dearest(maneuver: Maneuver) -> tuple[str, str, str]:
    """The actuator that takes most of the cost: its weight keeps the cheapest maneuver from the target."""
    dearest = max(maneuver.actuators, key=lambda actuator: actuator.effort)
    helps = f"a smaller cost.{dearest.name}, or a larger cost.terminal_pose, leads that one nearer"
    return f"  {dearest.name}", f"{dearest.effort:.6f}", f"the dearest input: {helps}"


def _spared(maneuver: Maneuver) -> Iterator[tuple[str, str, str]]:
    """Actuators that a maneuver hardly uses, though it misses the target: their weights make them dear."""
    for actuator in maneuver.actuators:
        limited = actuator.limits > 0.0
        share = float(np.max(actuator.largest[limited] / actuator.limits[limited], initial=0.0))
        if share < SPARED:
            used = f"at most {100.0 * share:.1g} % of its limit"
            yield "hardly used", actuator.name, f"{used}: a smaller cost.{actuator.name} leads farther"
