"""Error against run time: every integrator follows the expert's maneuver in a scene.

The reference is the method of order 8 in steps so short that halving them changes nothing; that of order 6
tells how far to trust it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.report_page import Section
from dq_space_arm_env.common.tables import Column, Row
from dq_space_arm_env.kernels import Kernels, compile_scene
from dq_space_arm_env.kernels.bound import KernelCall
from dq_space_arm_env.scene import INTEGRATORS, Scene, StateLayout
from experts.ddp.box_ddp import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.problems.shooting_problem import FloatArray
from experts.report.effort import Announce, Effort
from experts.report.maneuver_run import in_substeps
from experts.report.timing import three_digits, time_in_turns

ACCURACIES = (1e-3, 1e-6, 1e-9)
"""Errors of the tip to reach, m and rad; also the relative tolerances of adaptive integrators."""
BATCH = 1024
"""Motions side by side on one core."""
LOST = 1.0
"""Beyond this error of the tip, m or rad, a motion has nothing to do with the right one."""
_FAR_OFF = 1e6  # entries of a diverged state
_TIMED_STEP = 8  # steps per input in the runs that are timed, of methods that do not iterate
_FINEST_REFERENCE = 64  # steps per input
_AGREEMENT = 1e-12  # m, rad; of the reference with half its steps
_ASYMPTOTIC, _ROUNDING = 1e-3, 1e-11  # errors that show an order of convergence lie between
_FLOORS, _UNCERTAINTIES, _SLOPES = 6.0, 30.0, 3
LARGEST_FLOOR = 1e-8
"""Errors that stop falling above it, m or rad, have not met rounding."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion under inputs that are held for a time step each."""

    scene: Scene  # in double precision
    start: FloatArray  # shape (n_x,)
    controls: FloatArray  # shape (holds, n_u)
    parameters: FloatArray | None = None  # what varies, shape (holds, n_p); nominal if None

    def end(self, kernels: Kernels, integrator: str, per_hold: int) -> FloatArray:
        """State at the end, shape (n_x,), with a number of steps for each input."""
        end: FloatArray = self.states(kernels, integrator, per_hold, per_hold * len(self.controls))[-1]
        return end

    def states(self, kernels: Kernels, integrator: str, per_hold: int, every: int) -> FloatArray:
        """States along the motion."""
        controls = np.repeat(self.controls, per_hold, axis=0)
        dt = self.scene.simulation.dt / per_hold
        p = None if self.parameters is None else in_substeps(kernels, self.parameters, per_hold)
        with np.errstate(all="ignore"):
            states = kernels.simulate(self.start, controls, len(controls), dt, integrator, every, p)
        return np.asarray(states)


def expert_motion(scene: Scene, max_iterations: int) -> Motion:
    """The expert's maneuver, converged or not; free motion where the expert diverges."""
    scene = scene.replace(simulation={"precision": "float64"})
    solution = uninterrupted(BoxDDP(scene, max_iterations=max_iterations).solve())
    controls = solution.controls if np.isfinite(solution.cost) else np.zeros_like(solution.controls)
    return Motion(scene, np.array(solution.states[0]), np.array(controls), solution.parameters[:-1])


def tip_error(kernels: Kernels, x: FloatArray, reference: FloatArray) -> float:
    """Distance [m] or angle [rad], the largest, between the tips of two states; inf if diverged."""
    if not np.abs(x).max() < _FAR_OFF:  # NaN is not smaller either
        return float("inf")
    tips = [tuple(kernels.tip_poses(each).T) for each in (x, reference)]
    return float(np.maximum(poses.error_distance(*tips), poses.error_angle(*tips)).max())


def reference_end(motion: Motion) -> tuple[FloatArray, float]:
    """State at the end of a motion, shape (n_x,), and the uncertainty of its tip, m or rad.

    Rosenbrock methods step in where joints are too stiff for the explicit ones.
    """
    kernels = compile_scene(motion.scene)
    pairs = [("rk8", "rk6"), ("rodas5p", "rodas4")]
    for method, other in (pair for pair in pairs if INTEGRATORS[pair[0]].takes(motion.scene)):
        per_hold, end = 4, motion.end(kernels, method, 4)
        while per_hold < _FINEST_REFERENCE:
            finer = motion.end(kernels, method, 2 * per_hold)
            change, per_hold, end = tip_error(kernels, end, finer), 2 * per_hold, finer
            if change < _AGREEMENT:
                break
        if np.isfinite(end).all():
            uncertainty = tip_error(kernels, motion.end(kernels, other, per_hold), end)
            if uncertainty < LOST:
                return end, uncertainty
    raise ValueError("no two integrators follow the expert's maneuver to the same end, even in short steps")


def measure(scene: Scene, effort: Effort, announce: Announce) -> dict[str, list[Row]]:
    """Errors and times of all integrators; ValueError where they would be those of different robots."""
    if any(chain.delay for chain in StateLayout.of(scene).chains):
        raise ValueError(
            "delays of actuators are whole steps, so another step would be another robot: leave them out"
        )
    announce("the expert's maneuver", 0, 4)
    motion = expert_motion(scene, effort.max_iterations)
    announce("the reference", 1, 4)
    end, uncertainty = reference_end(motion)
    announce("times of the integrators", 2, 4)
    variants = list(_variants(motion.scene))
    times = list(_step_times(motion, variants, effort))
    announce("errors of the integrators", 3, 4)
    points: list[Row] = []
    for (integrator, kernels, tolerance), found in zip(variants, times, strict=True):
        for per_hold in (1,) if tolerance is not None else effort.steps_per_input:
            single, batch = found.get(per_hold) or found[_TIMED_STEP]
            step = motion.scene.simulation.dt / per_hold
            # No error is known better than the reference, which is itself a motion of this list.
            error = max(tip_error(kernels, motion.end(kernels, integrator, per_hold), end), uncertainty)
            points.append(
                {
                    "integrator": integrator,
                    "order": INTEGRATORS[integrator].order,
                    "step_s": step,
                    "tolerance": tolerance,
                    "error": error if error < LOST else None,
                    "single_us": 1e-3 * single / step,
                    "batch_us": 1e-3 * batch / step,
                }
            )
    reference = {"uncertainty": uncertainty, "duration_s": len(motion.controls) * scene.simulation.dt}
    return {"points": points, "reference": [reference]}


_Variant = tuple[str, Kernels, float | None]


def _variants(scene: Scene) -> Iterator[_Variant]:
    """Each integrator with its kernels; adaptive ones with several tolerances."""
    for name, entry in INTEGRATORS.items():
        if not entry.takes(scene):
            continue
        if not entry.is_adaptive:
            yield name, compile_scene(scene), None
            continue
        for tolerance in ACCURACIES:
            changes = {"integrator": name, **entry.within(tolerance)}
            yield name, compile_scene(scene.replace(simulation=changes)), tolerance


def left_out(scene: Scene) -> list[str]:
    """A sentence that names the integrators that do not take the scene's robot, if any."""
    names = [name for name, entry in INTEGRATORS.items() if not entry.takes(scene)]
    reason = "they do not take spherical joints or propellant that burns"
    return [f"Left out: {', '.join(names)}; {reason}."] if names else []


def _step_times(
    motion: Motion, variants: Sequence[_Variant], effort: Effort
) -> Iterator[dict[int, tuple[float, float]]]:
    """Times of a step of one motion, and of each of a batch on one core, ns, by steps per input.

    A step of a method that does not iterate takes the same, however long it is: one is timed.
    """
    runs: list[Callable[[], object]] = []
    timed: list[tuple[int, ...]] = []
    for integrator, kernels, tolerance in variants:
        lengths = effort.steps_per_input if INTEGRATORS[integrator].iterates else (_TIMED_STEP,)
        timed.append((1,) if tolerance is not None else lengths)
        along = _along(motion, kernels, BATCH)
        for per_hold in timed[-1]:
            call = step_call(kernels, integrator, *along, motion.scene.simulation.dt / per_hold)
            runs += [partial(motion.end, kernels, integrator, per_hold), partial(call, BATCH)]
    samples = iter(time_in_turns(runs, effort.repeats, effort.sample_seconds))
    for lengths in timed:
        pairs = ((per_hold, next(samples).best_ns, next(samples).best_ns) for per_hold in lengths)
        steps = len(motion.controls)
        yield {count: (single / (steps * count), batch / BATCH) for count, single, batch in pairs}


def step_call(
    kernels: Kernels, integrator: str, states: FloatArray, controls: FloatArray, step: float
) -> KernelCall:
    """A step of many states at once, shapes (B, n_x) and (B, n_u), into an array of its own."""
    kernel = kernels.kernel("step", integrator=integrator)
    parameters = np.tile(kernels.parameters.nominal.astype(states.dtype), (len(states), 1))
    arrays = {"x": states, "u": controls, "parameters": parameters, "h": np.array([step], states.dtype)}
    return KernelCall(kernel, {**arrays, kernel.outputs[0].name: np.zeros_like(states)})


def _along(motion: Motion, kernels: Kernels, count: int) -> tuple[FloatArray, FloatArray]:
    """States along a motion and the inputs there, shapes (count, n_x) and (count, n_u)."""
    states = motion.states(kernels, "rk8", 4, every=4)
    if not np.isfinite(states).all():  # a step from there would be timed
        states = motion.states(kernels, "rodas5p", 4, every=4)
    places = np.linspace(0, len(motion.controls) - 1, count).astype(int)
    return np.ascontiguousarray(states[places]), np.ascontiguousarray(motion.controls[places])


def observed_order(steps: Sequence[float], errors: Sequence[float], uncertainty: float = 0.0) -> float | None:
    """Order of convergence that errors at shorter and shorter steps show; None if too few show it."""
    least = min(errors)
    is_rounding = errors[-1] > 0.5 * errors[-2] and least < LARGEST_FLOOR
    floor = least if is_rounding else 0.0
    last = errors.index(least) if least < LARGEST_FLOOR else len(errors) - 1  # what follows is rounding
    smallest = max(_ROUNDING, _UNCERTAINTIES * uncertainty, _FLOORS * floor)
    slopes = [
        float(np.log(errors[i] / errors[i + 1]) / np.log(steps[i] / steps[i + 1]))
        for i in range(last)
        if errors[i] < _ASYMPTOTIC and errors[i + 1] > smallest
    ]
    return float(np.median(slopes[-_SLOPES:])) if slopes else None


def cheapest(rows: Iterable[Row], accuracy: float, time: str) -> Row | None:
    """The row of the smallest time, a column, among those whose error is at most an accuracy."""
    good = [row for row in rows if row["error"] is not None and row["error"] <= accuracy]
    return min(good, key=lambda row: float(row[time]), default=None)


def section(scene: Scene, found: dict[str, list[Row]]) -> Section:
    """The section of the report."""
    points, (reference,) = found["points"], found["reference"]
    made = Section(
        "precision",
        "Error against run time",
        f"Every integrator follows the expert's maneuver, {reference['duration_s']:g} s, in the scene's time "
        "step and shorter ones. The error is that of the tip at the end; times are per simulated second, of "
        f"one motion and of one of {BATCH} on one core.",
    )
    made.add_rows("cheapest", _choices(points), _CHOICE_COLUMNS, "The cheapest integrator and step")
    made.add_rows("integrators", _summaries(points, reference["uncertainty"]), _SUMMARY_COLUMNS)
    made.notes.append(
        "Reference: the method of order 8 in short steps, or a stiff one where that fails; another one ends "
        f"{reference['uncertainty']:.0e} m or rad from there, as which smaller errors count."
    )
    made.notes += left_out(scene)
    own = [row for row in points if row["integrator"] == scene.simulation.integrator]
    if own:
        error, tolerance = own[0]["error"], own[0]["tolerance"]
        ends = "loses the maneuver" if error is None else f"ends {error:.1e} m or rad off"
        within = "" if tolerance is None else f" and a tolerance of {tolerance:g}"  # not the scene's
        made.notes.append(
            f"The scene's own integrator, {scene.simulation.integrator} with steps of "
            f"{scene.simulation.dt:g} s{within}, {ends}."
        )

    def draw() -> bytes:
        from experts.figures.plots import Plot

        labels = {"time_us": "time per simulated second [µs]", "error": "error of the tip [m, rad]"}
        rows = [{**row, "time_us": row[key], "way": way} for key, way in _WAYS.items() for row in points]
        return Plot(
            "time_us", "error", color="integrator", facet="way", log="xy", levels=ACCURACIES, labels=labels
        ).png(rows)

    made.add_figure("precision", "Lower left is better; dashed: 1e-3, 1e-6, 1e-9.", draw)
    return made


_WAYS = {"single_us": "one motion", "batch_us": f"one of {BATCH} on one core"}


def _step_text(row: Row) -> str:
    return f"{row['step_s']:.3g} s" if row["tolerance"] is None else f"tolerance {row['tolerance']:g}"


def _choices(points: Sequence[Row]) -> Iterator[Row]:
    """The cheapest integrator for each accuracy and way."""
    for accuracy in ACCURACIES:
        for time, way in _WAYS.items():
            row = cheapest(points, accuracy, time)
            facts: dict[str, Any] = {"accuracy": accuracy, "way": way, "integrator": "not reached"}
            if row is not None:
                kept = {key: row[key] for key in ("integrator", "step_s", "tolerance", "error")}
                facts |= {**kept, "step": _step_text(row), "us": row[time]}
            yield facts


def _summaries(points: Sequence[Row], uncertainty: float) -> Iterator[Row]:
    """Orders, times of a step and errors of each integrator."""
    for name in dict.fromkeys(row["integrator"] for row in points):
        rows = [row for row in points if row["integrator"] == name]
        known = [row for row in rows if row["error"] is not None]
        shown = None
        if len(known) > 1 and known[0]["tolerance"] is None:
            steps, errors = ([row[key] for row in known] for key in ("step_s", "error"))
            shown = observed_order(steps, errors, uncertainty)
        least = min(known, key=lambda row: float(row["error"]), default=None)
        yield {
            "integrator": name,
            "order": rows[0]["order"],
            "observed_order": shown,
            "single_step_ns": 1e3 * rows[0]["single_us"] * rows[0]["step_s"],
            "batch_step_ns": 1e3 * rows[0]["batch_us"] * rows[0]["step_s"],
            "error_at_scene_step": rows[0]["error"],
            "least_error": None if least is None else least["error"],
            "at": "-" if least is None else _step_text(least),
        }


_CHOICE_COLUMNS = (
    Column("accuracy", "error\nm, rad", "g"),
    Column("way", ""),
    "integrator",
    Column("step", "step"),
    Column("us", "µs", three_digits),
    Column("error", "its error", ".0e"),
)
_SUMMARY_COLUMNS = (
    "integrator",
    "order",
    Column("observed_order", "shown", ".1f"),
    Column("single_step_ns", "ns/step\none", three_digits),
    Column("batch_step_ns", f"ns/step\nof {BATCH}", three_digits),
    Column("error_at_scene_step", "error at the\nscene's step", ".0e", "lost"),
    Column("least_error", "least\nerror", ".0e", "lost"),
    "at",
)
