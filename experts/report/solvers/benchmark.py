"""The benchmark of the expert, scene by scene and part by part; what is measured is printed at once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from dq_space_arm_env import Scene
from experts.arm_problem import ArmProblem
from experts.box_ddp import BoxDDP
from experts.guesses import GuidedDDP
from experts.problem import FloatArray, as_problem
from experts.receding_horizon import RecedingHorizonExpert
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.solvers.accuracy import NOMINAL_START, SolverComparison, compare_solvers
from experts.report.solvers.best_known import Search
from experts.report.solvers.contenders import contenders
from experts.report.solvers.effort import ACCURACY, HORIZON, ITERATIONS, STARTS, Effort
from experts.report.solvers.iterations import IterationCosts, measure_iterations
from experts.report.solvers.ours import uninterrupted
from experts.report.solvers.random_starts import RandomStarts, draw_starts, solve_random_starts
from experts.report.solvers.receding import Flight, measure_flights
from experts.report.solvers.tables import (
    print_comparison,
    print_flights,
    print_iterations,
    print_random_starts,
)


@dataclass
class ExpertBenchmark:
    """What is measured; it grows, so that an interrupt leaves what there is.

    Attributes:
        effort: How much to measure.
        seed: Seed of random starts and disturbances.
        iterations: What iterations cost, by scene and integrator.
        comparisons: Solvers from the same start, by scene and start.
        random_starts: Random starts, by scene.
        flights: Episodes of the receding-horizon expert.
        notes: What is left out, and why.
    """

    effort: Effort
    seed: int
    iterations: list[IterationCosts] = field(default_factory=list)
    comparisons: list[SolverComparison] = field(default_factory=list)
    random_starts: list[RandomStarts] = field(default_factory=list)
    flights: list[Flight] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @staticmethod
    def check(scene: Scene, parts: Collection[str]) -> None:
        """Refuse a scene that cannot be measured, before time is spent on others.

        Args:
            scene: The scene.
            parts: Those of `effort.PARTS` to measure.

        Raises:
            ValueError: If it has no actuator, or one without a limit and the receding horizon is a part.
        """
        as_problem(scene)
        if HORIZON in parts:
            RecedingHorizonExpert(scene)

    def run(self, console: Console, scene: Scene, parts: Collection[str]) -> None:
        """Measure a scene, and print it.

        Args:
            console: Where to print.
            scene: The scene.
            parts: Those of `effort.PARTS` to measure.

        Raises:
            KeyboardInterrupt: If the user interrupts.
            ValueError: If the scene is one that `check` refuses.
        """
        if ITERATIONS in parts:
            self._measure_iterations(console, scene)
        if ACCURACY in parts or STARTS in parts:
            problem = _warm_problem(scene)
            guided = GuidedDDP(problem, max_iterations=self.effort.max_iterations)
            library_seconds = _solve_library(guided)
            if ACCURACY in parts:
                self._note(
                    console,
                    f"GuidedDDP has solved the nominal start of scene {scene.name} beforehand, in "
                    f"{library_seconds:.2g} s: it is compared from random starts only.",
                )
                self._compare_solvers(console, problem, guided)
            if STARTS in parts:
                self._solve_random_starts(console, problem, guided, library_seconds)
        if HORIZON in parts:
            self._fly(console, scene)

    def _measure_iterations(self, console: Console, scene: Scene) -> None:
        found = []
        for integrator in COMPARED_INTEGRATORS:
            found.append(measure_iterations(ArmProblem(scene, integrator), self.effort))
            self.iterations.append(found[-1])
        print_iterations(console, found)

    def _compare_solvers(self, console: Console, problem: ArmProblem, guided: GuidedDDP) -> None:
        """Compare on the nominal start with each integrator, on random ones with the scene's own."""
        chosen = problem.scene.simulation.integrator
        states = draw_starts(problem, self.effort.compared_starts, self.seed)
        for integrator in dict.fromkeys((*COMPARED_INTEGRATORS, chosen)):
            same = integrator == chosen
            variant = problem if same else _warm_problem(problem.scene, integrator)
            entrants, notes = contenders(variant, guided if same else None, self.effort)
            self._note(console, *notes)
            search = Search(variant, guided.library, self.effort.max_iterations)
            starts: list[tuple[str, FloatArray | None]] = [(NOMINAL_START, None)]
            if same:
                starts += [(f"random start {i}", state) for i, state in enumerate(states)]
            for name, x0 in starts:
                comparison = compare_solvers(variant, entrants, search, name, x0, self.effort)
                self.comparisons.append(comparison)
                print_comparison(console, comparison)

    def _note(self, console: Console, *notes: str) -> None:
        """Say once what is to be known."""
        for note in notes:
            if note not in self.notes:
                self.notes.append(note)
                console.print(Text(note))

    def _solve_random_starts(
        self, console: Console, problem: ArmProblem, guided: GuidedDDP, library_seconds: float
    ) -> None:
        scene = problem.scene
        found = RandomStarts(scene.name, scene.simulation.integrator, self.seed, library_seconds)
        self.random_starts.append(found)
        states = draw_starts(problem, self.effort.starts, self.seed)
        try:
            with _progress(console, f"{scene.name}: random starts", len(states)) as advance:
                for start in solve_random_starts(problem, guided, self.effort, states):
                    found.starts.append(start)
                    advance()
        finally:  # an interrupt leaves something to be seen
            print_random_starts(console, found)

    def _fly(self, console: Console, scene: Scene) -> None:
        flights = []
        try:
            with _progress(console, f"{scene.name}: horizons and disturbances", None) as advance:
                for flight in measure_flights(ArmProblem(scene), self.effort, self.seed):
                    flights.append(flight)
                    self.flights.append(flight)
                    advance()
        except RuntimeError as error:  # no maneuver can be simulated from the start
            self._note(console, f"Scene {scene.name}: no receding horizon, for {error}")
        finally:
            print_flights(console, flights)


def _warm_problem(scene: Scene, integrator: str | None = None) -> ArmProblem:
    """Make a scene's problem, and take one iteration, so that no time is that of the compiler."""
    problem = ArmProblem(scene, integrator)
    uninterrupted(BoxDDP(problem, max_iterations=1).solve())
    return problem


def _solve_library(guided: GuidedDDP) -> float:
    """Have the library solved, which is done at the first look; duration, s."""
    started = perf_counter()
    len(guided.library)
    return perf_counter() - started


@contextmanager
def _progress(console: Console, title: str, total: int | None) -> Iterator[Callable[[], None]]:
    """Show how far a loop is: a bar on a terminal, nothing elsewhere.

    Yields:
        To be called after every round.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # Refreshed by hand: a thread of its own would compete with the solver.
    with Progress(
        *columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.update(task, advance=1, refresh=True)
