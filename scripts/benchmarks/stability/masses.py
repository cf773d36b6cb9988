"""Extreme masses and inertias, for every formulation of the dynamics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from dq_space_arm_env import Scene, load_scene
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import (
    Case,
    Handled,
    NotClaimed,
    Outcome,
    Refused,
    largest,
    refusal,
    worst_point,
)
from scripts.benchmarks.stability.references import (
    FORMULATIONS,
    MINIMAL,
    MINIMAL_SINGLE,
    PINOCCHIO,
    SCHUR,
    SINGLE,
    Errors,
    Sample,
    errors,
    linear_system,
)
from scripts.benchmarks.stability.scenes import random_state, with_links, with_mass_ratio

GROUP = "masses"
BACKWARD, FORWARD = "backward error", "forward error"

BACKWARD_BOUND = 1e-12
_COARSER = float(np.finfo(np.float32).eps / np.finfo(np.float64).eps)
ROUNDING = {SINGLE: _COARSER, MINIMAL_SINGLE: _COARSER}
"""Roundings of a formulation in those of double precision."""
SMALLEST_RATIO = {MINIMAL_SINGLE: 1e-2}
"""Lightest base, in arm masses, whose accelerations a formulation claims to give with three digits."""
BY_ROW_BOUNDS = {SCHUR: 1e-10}
"""Bounds of the row-wise backward error over mass ratios, where they are not 1e-11, in double precision.

The backward error in norms is far below 1e-12 whatever the formulation: the heaviest body sets the norms. Row
by row, nothing hides behind it.
"""
NEEDLE_BOUNDS = {SCHUR: 1e-7}
"""Bounds for needles, where they are not 1e-12.

The entries of the Schur complement are as large as 1 over the smallest moment, and cancel in the
accelerations: as many digits are lost as the ratio has. The system itself does not cancel: solved once more
for its residual, it gives all of them back.
"""
FORWARD_BOUNDS = {MINIMAL: 1e-8, MINIMAL_SINGLE: 1e-3, PINOCCHIO: 1e-8, SINGLE: 1e-5}
"""Bounds of the forward error, where they are not 1e-12.

In minimal coordinates the entries of the mass matrix are sums over all bodies, in which a light base is lost
in the rounding of a heavy arm: eps over the mass ratio. An articulated-body algorithm that ends at the base,
like Pinocchio's, adds the arm to the base and loses as much. Ours ends at the heaviest body: light ones are
added to heavy ones, after the joint between them has been eliminated, never the other way round. Redundant
coordinates never add up the bodies.
"""
PAYLOAD_BOUNDS = {**FORWARD_BOUNDS, SCHUR: 1e-11}  # the same for a payload that outweighs the robot
HEAVY = 1e6  # mass of the heavy payload in multiples of the one of its scene


def cases() -> Iterator[Case]:
    needle = (1e-8, 1.0, 1.0)
    for name in FORMULATIONS:
        yield _mass_ratios(name, BACKWARD)
        yield _mass_ratios(name, FORWARD)
        bound = NEEDLE_BOUNDS.get(name, BACKWARD_BOUND)
        criterion = f"row-wise backward error of the accelerations below {bound:g}"
        criterion += " times 2^29, for the coarser rounding" if name in ROUNDING else ""
        bound *= ROUNDING.get(name, 1.0)
        for what, scene in (("links", _with_needles(needle)), ("base", _with_needle_base(needle))):
            title, run = f"needle {what}, inertia ratio 1e-8", partial(_inertias, scene, name)
            yield Case(GROUP, title, name, criterion, run, bound, "1")
        if name not in SMALLEST_RATIO:
            yield _heavy_payload(name)
    smallest = SMALLEST_RATIO[MINIMAL_SINGLE]
    criterion = "not claimed: the mass matrix has no digits left; finite"
    yield Case(
        GROUP, f"base to arm mass below {smallest:g}, {FORWARD}", MINIMAL_SINGLE, criterion, _light_base
    )
    yield from _refusals()


def _light_base(effort: Effort) -> Outcome:
    light = [ratio for ratio in effort.mass_ratios if ratio < SMALLEST_RATIO[MINIMAL_SINGLE]]
    found = [
        (
            ratio,
            largest(
                *(
                    judge(sample, MINIMAL_SINGLE).forward
                    for sample in samples(with_mass_ratio(ratio), effort.samples)
                )
            ),
        )
        for ratio in light
    ]
    if not all(np.isfinite(error) for _, error in found):
        return Handled(np.inf)
    listed = ", ".join(f"{error:.1e} at {ratio:g}" for ratio, error in found)
    return NotClaimed(f"single precision loses the base in the rounding of the arm: relative errors {listed}")


def _with_needles(moments: tuple[float, ...]) -> Callable[[], Scene]:
    return lambda: with_links(load_scene("paper"), inertia=[0.5 * moment for moment in moments])


def _with_needle_base(moments: tuple[float, ...]) -> Callable[[], Scene]:
    return lambda: load_scene("paper").replace(base={"inertia": [10.0 * moment for moment in moments]})


def _mass_ratios(formulation: str, measure: str) -> Case:
    backward = measure == BACKWARD
    single = formulation in ROUNDING
    if backward:
        bound = BY_ROW_BOUNDS.get(formulation, 10.0 * BACKWARD_BOUND)
        criterion = (
            f"backward error of the accelerations below {BACKWARD_BOUND:g} in norms, {bound:g} row by row"
        )
        bound *= ROUNDING.get(formulation, 1.0)
        criterion += " times 2^29, for the coarser rounding" if single else ""
    else:
        bound = FORWARD_BOUNDS.get(formulation, 1e-12)
        criterion = f"error of the accelerations against 50 digits below {bound:g}"
        smallest = SMALLEST_RATIO.get(formulation)
        criterion += f" from a ratio of {smallest:g} on" if smallest else ""
    name = f"base to arm mass 1e-6 to 1e6, {measure}"
    run = partial(_ratios, formulation, measure)
    return Case(GROUP, name, formulation, criterion, run, bound, "1")


def _heavy_payload(formulation: str) -> Case:
    bound = PAYLOAD_BOUNDS.get(formulation, 1e-12)
    criterion = f"error of the accelerations against 50 digits below {bound:g}"
    run = partial(_forward, _with_heavy_payload, formulation)
    return Case(GROUP, f"payload of {HEAVY:g} times its mass", formulation, criterion, run, bound, "1")


def _with_heavy_payload() -> Scene:
    scene = load_scene("payload")
    if scene.payload is None:
        raise ValueError("scene payload: its payload is missing")
    inertia = (HEAVY * np.array(scene.payload.inertia)).tolist()
    return scene.replace(payload={"mass": HEAVY * scene.payload.mass, "inertia": inertia})


def _forward(scene: Callable[[], Scene], formulation: str, effort: Effort) -> Outcome:
    found = [judge(sample, formulation) for sample in samples(scene(), effort.samples)]
    return Handled(
        largest(*(e.forward for e in found)), f"backward error {max(e.backward for e in found):.1e}"
    )


def samples(scene: Scene, count: int) -> list[Sample]:
    """Random states and inputs of a scene."""
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        sample = Sample.of(scene, np.zeros(0), np.zeros(0))
        state = random_state(sample.kernels, rng)
        if sample.kernels.dtype == np.float32:
            state = state.astype(np.float32).astype(np.float64)
        found.append(Sample.of(scene, state, rng.normal(size=sample.kernels.n_u)))
    return found


def judge(sample: Sample, formulation: str) -> Errors:
    """Errors of the accelerations that a formulation gives."""
    if formulation in ROUNDING:
        state, control = (
            array.astype(np.float32).astype(np.float64) for array in (sample.state, sample.control)
        )
        sample = Sample.of(sample.scene, state, control)
    found = FORMULATIONS[formulation](sample)
    return errors(linear_system(sample.tree, sample.motion), sample.motion, found)


def _ratios(formulation: str, measure: str, effort: Effort) -> Outcome:
    curve, claimed, by_norm = [], [], 0.0
    for ratio in effort.mass_ratios:
        found = [judge(sample, formulation) for sample in samples(with_mass_ratio(ratio), effort.samples)]
        worst = largest(*(e.by_row if measure == BACKWARD else e.forward for e in found))
        by_norm = largest(by_norm, *(e.backward for e in found))
        curve.append((ratio, worst))
        if measure == BACKWARD or ratio >= SMALLEST_RATIO.get(formulation, 0.0):
            claimed.append(worst)
    ratio, worst = worst_point(curve)
    note = f"worst at a ratio of {ratio:g}: {worst:.1e}"
    if measure == BACKWARD:
        note += f"; in norms {by_norm:.1e}"
        if not by_norm < BACKWARD_BOUND * ROUNDING.get(formulation, 1.0):
            return Handled(np.inf, note, tuple(curve))
    return Handled(largest(*claimed), note, tuple(curve))


def _inertias(scene: Callable[[], Scene], formulation: str, effort: Effort) -> Outcome:
    found = [judge(sample, formulation) for sample in samples(scene(), effort.samples)]
    forward = largest(*(e.forward for e in found))
    return Handled(largest(*(e.by_row for e in found)), f"forward error {forward:.1e}")


def _refusals() -> Iterator[Case]:
    wrong: Mapping[str, tuple[Callable[[], Scene], str]] = {
        "link without inertia about one axis": (_with_needles((0.0, 1.0, 1.0)), "inertia"),
        "inertia ratio 1e-13": (_with_needles((1e-13, 1.0, 1.0)), "inertia"),
        "base without inertia about one axis": (_with_needle_base((0.0, 1.0, 1.0)), "inertia"),
        "inertia that no body has (1, 1, 3)": (_with_needles((1.0, 1.0, 3.0)), "inertia"),
        "link without mass": (lambda: with_links(load_scene("paper"), mass=0.0), "mass"),
        "base with negative mass": (lambda: load_scene("paper").replace(base={"mass": -1.0}), "mass"),
        "infinite mass": (lambda: load_scene("paper").replace(base={"mass": np.inf}), "mass"),
    }

    def refused(make: Callable[[], Scene], naming: str, effort: Effort) -> Refused:
        return refusal(make, naming=naming)

    for name, (make, naming) in wrong.items():
        yield Case(GROUP, name, "scene", "refused, naming field and value", partial(refused, make, naming))
