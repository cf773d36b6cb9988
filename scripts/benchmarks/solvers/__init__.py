"""Cost gap of the expert against seconds, beside other solvers where they are installed.

runs            one solve in the same terms for every solver; the project's own solvers in these terms
iterations      what an iteration costs, whole and in pieces
accuracy        how soon solvers come close to the best known cost, from the same start
random_starts   how often the expert converges, succeeds, and finds the best known minimum
receding        the receding-horizon expert under disturbances
mismatched      the receding-horizon expert in worlds with springs or loads that its scene does not have
tracking        the tip's error behind a target that moves, beside the paper's formulation
own_problems    problems of one's own: cart-pole and planar quadrotor, beside Crocoddyl
constrained     random starts of scenes with constraints, beside IPOPT and fatrop
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import perf_counter

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.tables import Column
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.guesses.guided import GuidedDDP
from experts.problems.arm_problem import ArmProblem, as_problem
from experts.problems.shooting_problem import FloatArray
from experts.receding_horizon import RecedingHorizonExpert
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Picture, Row, Table, note, one_by_one, time_column
from scripts.benchmarks.solvers.accuracy import NOMINAL_START, compare_solvers, contenders
from scripts.benchmarks.solvers.constrained import measure_constrained
from scripts.benchmarks.solvers.iterations import measure_iterations
from scripts.benchmarks.solvers.mismatched import measure_mismatches
from scripts.benchmarks.solvers.own_problems import measure_own_problems
from scripts.benchmarks.solvers.random_starts import draw_starts, measure_starts
from scripts.benchmarks.solvers.receding import measure_flights
from scripts.benchmarks.solvers.runs import GAPS, Search
from scripts.benchmarks.solvers.tracking import measure_tracking
from scripts.benchmarks.subjects import compared_integrators

ITERATIONS, ACCURACY, STARTS, HORIZON, MISMATCH, TRACKING, OWN, CONSTRAINED = PARTS = (
    "iterations",
    "accuracy",
    "starts",
    "horizon",
    "mismatch",
    "tracking",
    "own",
    "constrained",
)


def measure(effort: Effort) -> Iterator[Row]:
    """Measure scene by scene, part by part; scenes that cannot be measured are refused before the first."""
    parts = effort.only or PARTS
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise ValueError(f"only: {unknown[0]!r} is unknown; choose from {', '.join(PARTS)}")
    scenes = [
        load_scene(name)
        for name in (effort.shipped(()) if effort.name == "full" else effort.shipped(("paper",)))
    ]
    for scene in scenes:
        as_problem(scene)
        if HORIZON in parts:
            RecedingHorizonExpert(scene)
    for scene in scenes:
        yield from one_by_one(f"scene {scene.name}", _measure_scene(scene, parts, effort))
    if MISMATCH in parts and effort.other_masses:
        yield from measure_mismatches(effort)
    if TRACKING in parts:
        yield from measure_tracking()
    if OWN in parts:
        yield from measure_own_problems(effort)
    if CONSTRAINED in parts:
        yield from measure_constrained(effort)


def _measure_scene(scene: Scene, parts: Sequence[str], effort: Effort) -> Iterator[Row]:
    """Measure the parts that every scene has."""
    if ITERATIONS in parts:
        for integrator in compared_integrators(scene):
            yield from measure_iterations(ArmProblem(scene, integrator), effort)
    if ACCURACY in parts or STARTS in parts:
        problem = _warm_problem(scene)
        guided = GuidedDDP(problem, max_iterations=effort.max_iterations)
        started = perf_counter()
        guided.prepare()
        seconds = perf_counter() - started
        yield note(
            f"GuidedDDP solved the nominal start of scene {scene.name} beforehand in {seconds:.2g} s; "
            "it is compared from random starts only."
        )
        if ACCURACY in parts:
            yield from _compare(problem, guided, effort)
        if STARTS in parts:
            yield from measure_starts(problem, guided, seconds, effort)
    if HORIZON in parts:
        yield from measure_flights(ArmProblem(scene), effort)


def _compare(problem: ArmProblem, guided: GuidedDDP, effort: Effort) -> Iterator[Row]:
    """Compare on the nominal start with each integrator, on random ones with the scene's own.

    Scenes with constraints are left out: iterations have penalties in their cost, and may violate them.
    """
    if problem.constraints is not None:
        yield note(
            f"The times to the best known cost leave out scene {problem.scene.name}: costs on the way to its "
            "constraints do not compare."
        )
        return
    chosen = problem.scene.simulation.integrator
    states = draw_starts(problem, effort.compared_starts, effort.seed)
    for integrator in dict.fromkeys((*compared_integrators(problem.scene), chosen)):
        same = integrator == chosen
        variant = problem if same else _warm_problem(problem.scene, integrator)
        entrants, notes = contenders(variant, guided if same else None, effort)
        yield from map(note, notes)
        search = Search(variant, guided.library, effort.max_iterations)
        starts: list[tuple[str, FloatArray | None]] = [(NOMINAL_START, None)]
        if same:
            starts += [(f"random start {i}", state) for i, state in enumerate(states)]
        for name, x0 in starts:
            yield from compare_solvers(variant, entrants, search, name, x0, effort)


def _warm_problem(scene: Scene, integrator: str | None = None) -> ArmProblem:
    """A scene's problem after one iteration, which leaves nothing to compile."""
    problem = ArmProblem(scene, integrator)
    uninterrupted(BoxDDP(problem, max_iterations=1).solve())
    return problem


BENCHMARK = Benchmark(
    "solvers",
    "The expert: cost gap against seconds",
    "What an iteration costs; how soon solvers come close to the best known cost, from the scene's start and "
    "from random ones; and the expert that replans in flight.",
    measure,
    tables=(
        Table(
            "iterations",
            "Scene {scene}, {integrator}, from zero controls\nbest and median solve; median iteration, ms",
            (
                "variant",
                Column("iterations", "itera-\ntions"),
                Column("cost", "cost J", ".7g"),
                Column("stop_reason", "end"),
                time_column("best_s", "solve s"),
                time_column("median_s", "median"),
                time_column("iteration_ms", "itera-\ntion"),
                time_column("derivatives_ms", "deriva-\ntives"),
                time_column("sweep_ms", "sweep"),
                time_column("rollout_ms", "roll-\nout"),
                time_column("rest_ms", "rest"),
            ),
            by=("scene", "integrator"),
        ),
        Table(
            "pieces",
            "Scene {scene}: pieces of an iteration along the best trajectory, ms",
            (
                "integrator",
                "samples",
                time_column("first_derivatives", "first\nderivatives"),
                time_column("second_derivatives", "second\nderivatives"),
                time_column("gauss_newton_sweep", "Gauss-\nNewton\nsweep"),
                time_column("exact_sweep", "exact\nsweep"),
                time_column("rollout"),
                time_column("gauss_newton_iteration", "Gauss-\nNewton\niteration"),
                time_column("exact_iteration", "exact\niteration"),
                time_column("ratio"),
            ),
            by=("scene",),
        ),
        Table(
            "comparisons",
            "Scene {scene}, {integrator}, {start}: best known J {best_known:.7g}",
            (
                "solver",
                Column("iterations", "itera-\ntions"),
                Column("converged", "con-\nverged"),
                Column("cost", "cost J", ".7g"),
                Column("above_best", "above\nbest", ".0e"),
                *(time_column(f"s_to_{gap:g}", f"s to\n{100 * gap:g} %") for gap in GAPS),
                time_column("total_s", "s to\nend"),
                time_column("ms_per_iteration", "ms per\niter."),
            ),
            by=("scene", "integrator", "start"),
        ),
        Table(
            "start summaries",
            "GuidedDDP from random starts\nof `env.reset(seed=)`; best: of twelve further guesses",
            (
                "scene",
                "starts",
                Column("converged", "con-\nverged", ".1%"),
                Column("succeeded", "success", ".1%"),
                Column("close", "within\n1e-4 of\nbest", ".1%"),
                Column("iterations_median", "itera-\ntions,\nmedian", ".0f"),
                Column("iterations_90", "90 %", ".0f"),
                Column("coarsening", "long\nsteps"),
                Column("long_step_iterations_median", "itera-\ntions,\nmedian", ".0f"),
                time_column("seconds_median", "seconds,\nmedian"),
                time_column("seconds_90", "90 %"),
                time_column("preparation_s", "prepa-\nration"),
            ),
        ),
        Table(
            "flights",
            "Scene {scene}: receding horizon, period {period_ms:g} ms\nmean costs, largest errors of the "
            "tip; J of the undisturbed plan {plan_cost:.6g}",
            (
                "disturbance",
                "horizon",
                time_column("median_ms", "ms,\nmedian"),
                time_column("percentile_99_ms", "ms,\n99 %"),
                Column("late", format=".1%"),
                Column("cost", "expert", ".6g"),
                Column("policy_cost", "plan's\nfeedback", ".6g"),
                Column("open_loop_cost", "plan's\ncontrols", ".6g"),
                Column("success", format=".0%"),
                Column("replans", "new\nplans", ".1f"),
                Column("attitude_error_deg", "largest\nerror\ndeg"),
                Column("position_error_m", "largest\nerror\nm"),
            ),
            by=("scene",),
        ),
        Table(
            "mismatches",
            "Scene {scene}: receding horizon in worlds that its scene does not know\nunaware, and estimating "
            "what differs; over the starts from which the informed optimum succeeds",
            (
                "mismatch",
                "starts",
                Column("informed", "informed\noptimum", ".0%"),
                Column("unaware", "success:\nunaware", ".0%"),
                Column("identified", "esti-\nmating", ".0%"),
                Column("unaware_above", "cost above:\nunaware", ".1%"),
                Column("identified_above", "esti-\nmating", ".1%"),
                Column("unaware_violated", "violated:\nunaware", ".1%"),
                Column("identified_violated", "esti-\nmating", ".1%"),
                Column("replans", "new\nplans", ".1f"),
                time_column("unaware_ms", "ms:\nunaware"),
                time_column("identified_ms", "esti-\nmating"),
            ),
            by=("scene",),
        ),
        Table(
            "tracking",
            "Scene {scene}: error of the tip over time\nfixed: the paper's formulation, its target at rest "
            "where it is halfway",
            (
                Column("time", "time, s"),
                Column("angle_deg", "angle,\ndeg", ".2g"),
                Column("distance_mm", "distance,\nmm", ".2g"),
                Column("fixed_angle_deg", "fixed:\nangle", ".2g"),
                Column("fixed_distance_mm", "fixed:\ndistance", ".2g"),
            ),
            by=("scene",),
        ),
        Table(
            "own problems",
            "Problem of one's own: {name}\nthe same kernels for all; best and median solve",
            (
                "solver",
                Column("iterations", "itera-\ntions"),
                Column("converged", "con-\nverged"),
                Column("cost", "cost J", ".8g"),
                Column("above_best", "above\nbest", ".0e"),
                time_column("best_ms", "solve\nms"),
                time_column("median_ms", "median"),
                time_column("ms_per_iteration", "ms per\niter."),
            ),
            by=("name",),
        ),
        Table(
            "constrained summaries",
            "Scene {scene}, N = 50: random starts under constraints\nmedians of the starts that are solved; "
            "solver: its time without derivatives and rollouts",
            (
                "solver",
                "starts",
                Column("solved", format=".0%"),
                Column("best", "within\n0.1 % of\nbest", ".0%"),
                Column("iterations", "itera-\ntions", ".0f"),
                time_column("seconds"),
                time_column("sweep_ms", "solver,\nms per\niter."),
            ),
            by=("scene",),
        ),
        Table(
            "constrained",
            "Scene {scene}, start {start}",
            (
                "solver",
                "solved",
                Column("cost", "cost J", ".8g"),
                Column("above_best", "above\nbest", ".0e"),
                Column("violation", format=".0e"),
                Column("iterations", "itera-\ntions"),
                time_column("seconds"),
                Column("stop_reason", "end"),
            ),
            by=("scene", "start"),
        ),
    ),
    pictures=(
        Picture(
            "solvers",
            "histories",
            "Cost above the best known one over time, for each solver and start.",
            {
                "x": "seconds",
                "y": "gap",
                "color": "solver",
                "facet": "panel",
                "log": "xy",
                "floor": 1e-8,
                "levels": GAPS,
                "labels": {"seconds": "time [s]", "gap": "cost above the best known [$-$]"},
            },
            where=lambda row: row["iteration"] > 0,
        ),
        Picture(
            "random_starts",
            "random starts",
            "Cost of each random start over the time of the solve.",
            {"x": "seconds", "y": "cost", "color": "solver", "facet": "scene", "log": "x", "join": False},
        ),
        Picture(
            "constrained",
            "solved shares",
            "Share of random starts under constraints that are solved within a time.",
            {
                "x": "seconds",
                "y": "share",
                "color": "solver",
                "facet": "scene",
                "log": "x",
                "labels": {"seconds": "time of a solve [s]", "share": "solved starts, share [$-$]"},
            },
        ),
    ),
    packages=("crocoddyl", "pin"),
)
