"""Stiff joints that swing widely, and joints that turn into a damper, in steps of 15 ms.

An arm floats freely; one joint is deflected from the rest of its spring, or turns fast against its damper.
The reference is the method of order 8 in steps that resolve the fastest motion. Every cell of stiffness and
deflection must be right, or tell that it is not: by an error above 1, or by NaN.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial

import numpy as np

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome

GROUP = "finite deflections"

METHODS = tuple(name for name, entry in INTEGRATORS.items() if "tolerance" in entry.tolerances)
STIFFNESS = (1e2, 1e4, 1e6, 1e8, 1e10)  # N m/rad
DAMPING_RATIOS = (0.0, 0.5)
DEFLECTIONS = (1e-4, 1e-2, 0.1, 1.0)  # rad
DAMPERS = (1e2, 1e4, 1e6)  # N m s/rad
RATES = (1e-2, 0.1, 1.0)  # rad/s
STEPS, TIME_STEP = 20, 0.015  # of the methods; s
JOINT = 1  # of the arm of `free-floating`
_INERTIA, _LEAST_INERTIA = 2.8, 2.0  # that the joint turns at its rest, and at least, kg m^2
RIGHT = 1e-3
"""Largest error of pose and angles at the end, rad and m: swings of 1 rad multiply errors of 1e-6 a step."""


def cases() -> Iterator[Case]:
    criterion = (
        f"pose and angles after {STEPS} steps of 15 ms within {RIGHT:g} rad and m, or told that they are not"
    )
    for name in METHODS:
        for stiffness in STIFFNESS:
            for ratio in DAMPING_RATIOS:
                damping = 2.0 * ratio * float(np.sqrt(stiffness * _INERTIA))
                title = f"{stiffness:g} N m/rad, {'damped by half' if damping else 'undamped'}"
                run = partial(_cells, name, stiffness, damping, DEFLECTIONS, (0.0,))
                yield Case(GROUP, title, name, criterion, run, RIGHT, "rad, m")
        for damping in DAMPERS:
            title = f"damper of {damping:g} N m s/rad"
            run = partial(_cells, name, 0.0, damping, (0.0,), RATES)
            yield Case(GROUP, title, name, criterion, run, RIGHT, "rad, m")


@cache
def _arm() -> Kernels:
    """Kernels of which stiffness and damping of the joint are the parameters."""
    scene = load_scene("free-floating")
    links = [link.model_dump() for link in scene.links]
    rest = scene.initial_state.joint_angles[JOINT]
    links[JOINT] |= {"stiffness": 1.0, "damping": 1.0, "rest_angle": rest}
    parameters = [f"links.{JOINT}.stiffness", f"links.{JOINT}.damping"]
    return compile_scene(scene.replace(name="stiff joint", links=links, parameters=parameters))


def _start(kernels: Kernels, deflection: float, rate: float) -> FloatArray:
    where, x = kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.base_velocity] = [0.02, -0.01, 0.015, 0.01, 0.0, -0.01]
    x[where.joint_rates] = [0.05, rate, -0.04]
    x[where.joint_angles.start + JOINT] += deflection
    return x


@cache
def _reference(stiffness: float, damping: float, deflection: float, rate: float) -> FloatArray | None:
    """The end by the method of order 8, in steps of at most half the shortest time constant.

    None for a motion so violent that steps of two thirds end elsewhere.
    """
    kernels, duration, p = _arm(), STEPS * TIME_STEP, np.array([stiffness, damping])
    fastest = float(np.sqrt(stiffness / _LEAST_INERTIA)) + damping / _LEAST_INERTIA
    count = max(2000, int(2.0 * duration * fastest))
    x, still = _start(kernels, deflection, rate), np.zeros(kernels.n_u)
    ends = [
        kernels.simulate(x, still, steps, duration / steps, "rk8", every=steps, p=p)[-1]
        for steps in (count, 3 * count // 2)
    ]
    moved = _moved(kernels, *ends)
    return np.asarray(ends[1]) if moved < 0.1 * RIGHT else None


def _moved(kernels: Kernels, x: FloatArray, other: FloatArray) -> float:
    """Largest difference of pose and angles, rad and m; infinite if it is not a number."""
    moved = np.abs(kernels.difference(x, other))[: -6 - kernels.layout.n_joints].max()
    return float(moved) if np.isfinite(moved) else np.inf


def _cells(
    integrator: str,
    stiffness: float,
    damping: float,
    deflections: tuple[float, ...],
    rates: tuple[float, ...],
    effort: Effort,
) -> Outcome:
    """Judge all deflections, or rates, of one spring or damper."""
    kernels, p = _arm(), np.array([stiffness, damping])
    curve, told, violent = [], [], []
    for size in deflections if len(deflections) > 1 else rates:
        deflection, rate = (size, 0.0) if len(deflections) > 1 else (0.0, size)
        x, worst = _start(kernels, deflection, rate), 0.0
        for _ in range(STEPS):
            x, error = kernels.checked_step(x, np.zeros(kernels.n_u), TIME_STEP, integrator, p=p)
            worst = max(worst, float(error) if error <= 1.0 else np.inf)
        if worst > 1.0:
            told.append(f"{size:g}")
            continue
        reference = _reference(stiffness, damping, deflection, rate)
        if reference is None:
            violent.append(f"{size:g}")
            continue
        curve.append((size, _moved(kernels, reference, x)))
    parts = [("told that it is not right", told), ("no two steps of order 8 agree", violent)]
    sentence = "; ".join(f"{words}: {', '.join(sizes)}" for words, sizes in parts if sizes)
    if not curve:
        return NotClaimed(sentence)
    return Handled(max(error for _, error in curve), sentence, tuple(curve))
