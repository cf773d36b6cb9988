"""Reaction wrenches and accelerations of arms whose masses are far apart, against free bodies with 50 digits.

Each part is judged by its own size: a light base accelerates 1e12 times faster than its arm, and next to it
an arm's accelerations could be all wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from dq_space_arm_env import Scene
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, largest, worst_point
from scripts.benchmarks.stability.free_bodies import Solution, free_bodies
from scripts.benchmarks.stability.masses import samples
from scripts.benchmarks.stability.scenes import random_arm

GROUP = "reactions"
LIGHTEST = 1e-12  # kg, that a scene may have

WRENCHES, ACCELERATIONS = "reaction wrenches", "accelerations"

Make = Callable[[], Scene]


def cases() -> Iterator[Case]:
    for joints, wrench, acceleration in ((1, 3e-14, 5e-14), (3, 6e-14, 6e-14), (6, 6e-14, 3e-13)):
        name = f"base to arm mass 1e-12 to 1e12, {joints} joint{'s' * (joints > 1)}"
        for subject, bound in ((WRENCHES, wrench), (ACCELERATIONS, acceleration)):
            yield _case(name, subject, bound, partial(_ratios, joints, subject))
    heavy, robot = 1.0 / LIGHTEST, [1.0] * 4
    for name, masses, payload, wrench, acceleration in (
        ("light links between heavy ones", [1.0, LIGHTEST] * 3 + [1.0], 0.0, 5e-13, 5e-14),
        ("heavy links between light ones", [LIGHTEST, 1.0] * 3 + [LIGHTEST], 0.0, 5e-14, 5e-14),
        (f"payload of {heavy:g} times a link's mass", robot, heavy, 3e-13, 1e-13),
    ):
        make = partial(random_arm, masses, 0, payload)
        for subject, bound in ((WRENCHES, wrench), (ACCELERATIONS, acceleration)):
            yield _case(name, subject, bound, partial(_one, make, subject))
    make, criterion = partial(random_arm, [1.0, *[LIGHTEST] * 6, 1.0], 0), "not claimed; finite"
    yield Case(GROUP, "six light links between heavy ones", WRENCHES, criterion, partial(_heavy_ends, make))


def _case(name: str, subject: str, bound: float, run: Callable[[Effort], Outcome]) -> Case:
    criterion = f"{subject} against 50 digits, each part relative to its own size, below {bound:g}"
    return Case(GROUP, name, subject, criterion, run, bound, "1")


def wrench_error(found: FloatArray, exact: Solution) -> float:
    """Largest error of a reaction wrench, relative to the largest component of its force or torque."""
    found, right = found.reshape(-1, 5), exact.reactions[:, :5]
    return largest(*(_relative(found[:, part], right[:, part]) for part in (slice(0, 3), slice(3, 5))))


def acceleration_error(found: FloatArray, exact: Solution) -> float:
    """Largest error of the base's angular or linear acceleration, or of a joint's, relative to its size."""
    right = exact.accelerations
    base = _relative(found[:6].reshape(2, 3), right[:6].reshape(2, 3))
    return largest(base, _relative(found[6:, None], right[6:, None]))


def _relative(found: FloatArray, right: FloatArray) -> float:
    """Largest error of a row, relative to the row's largest entry."""
    return float((np.abs(found - right).max(axis=1) / np.abs(right).max(axis=1)).max())


def _worst(scene: Scene, subject: str, count: int) -> float:
    errors = []
    for sample in samples(scene, count):
        exact, given = free_bodies(sample), (sample.state, sample.control)
        if subject == WRENCHES:
            errors.append(wrench_error(sample.kernels.reaction_wrenches(*given), exact))
        else:
            errors.append(acceleration_error(sample.kernels.forward_dynamics(*given), exact))
    return largest(*errors)


def _ratios(joints: int, subject: str, effort: Effort) -> Outcome:
    """An arm of another shape for each mass ratio, the squares of the effort's."""
    found = []
    for seed, root in enumerate(effort.mass_ratios):
        ratio = min(max(root**2, LIGHTEST), 1.0 / LIGHTEST)
        scene = random_arm([ratio, *[1.0 / joints] * joints], seed)
        found.append((ratio, _worst(scene, subject, -(-effort.samples // joints))))
    ratio, error = worst_point(found)
    return Handled(error, f"worst at a ratio of {ratio:g}")


def _one(make: Make, subject: str, effort: Effort) -> Outcome:
    return Handled(_worst(make(), subject, effort.samples))


def _heavy_ends(make: Make, effort: Effort) -> Outcome:
    error = _worst(make(), WRENCHES, effort.samples)
    if not np.isfinite(error):
        return Handled(error)
    return NotClaimed(
        "six joints leave one heavy body nothing to transmit to the other, and rounding in proportion to its "
        f"mass takes the place of what the links need: relative error {error:.1e}"
    )
