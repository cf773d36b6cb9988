"""Time steps of the environment where the motion is fast: actions of all kinds on shipped robots, and spins.

An episode must end with its tip right, or `Kernels.numerical_error` must tell that it does not: motions under
actions that are held are chaotic, and no accuracy of single steps saves them. The reference is the method of
order 8 with a tolerance of 1e-11, a thousand times smaller than that of the companion that tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.robots import OTHER_MOTIONS, robots
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome
from scripts.benchmarks.stability.time_steps import moving_start

GROUP = "divided steps"

RIGHT = 1e-3
"""Largest error of the tip at the end of an episode that counts as right, rad and m."""
SPINS = (20.0, 50.0, 100.0)  # rad/s, for 1 s
METHODS = tuple(name for name, entry in INTEGRATORS.items() if "tolerance" in entry.uses)
_REFERENCE = 1e-11  # tolerance, rad and m
_HELD, _SWITCHED = 100, 20  # steps

Actions = Callable[[np.random.Generator, tuple[int, int, int]], FloatArray]


def _held(rng: np.random.Generator, shape: tuple[int, int, int], steps: int, signs: bool) -> FloatArray:
    """Actions that change every few steps, of any size or at the limits; shape (N, B, n_u)."""
    drawn = rng.uniform(-1.0, 1.0, (-(-shape[0] // steps), *shape[1:]))
    return np.repeat(np.sign(drawn) if signs else drawn, steps, axis=0)[: shape[0]]


ACTIONS: dict[str, Actions] = {
    "random": partial(_held, steps=1, signs=False),
    "constant at the limits": lambda rng, shape: _held(rng, shape, shape[0], True),
    f"held for {_HELD} steps": partial(_held, steps=_HELD, signs=False),
    f"bang-bang every {_SWITCHED} steps": partial(_held, steps=_SWITCHED, signs=True),
}


def cases() -> Iterator[Case]:
    criterion = f"episodes whose tip ends more than {RIGHT:g} rad or m off without being told: none"
    for name in (*robots(), *OTHER_MOTIONS):
        for kind in ACTIONS:
            run = partial(_episodes, name, kind)
            title, subject = f"{kind} actions", f"scene {name}"
            yield Case(GROUP, title, subject, criterion, run, 0.0, "episodes", scene=name)
    for spin in SPINS:
        for method in METHODS:
            criterion = f"tip after 1 s in steps of 15 ms within {RIGHT:g} rad and m, or told that it is not"
            run = partial(_spin, method, spin)
            yield Case(GROUP, f"spin of {spin:g} rad/s", method, criterion, run, RIGHT, "rad, m")


@cache
def _reference(scene: Scene) -> Kernels:
    keys = {"integrator": "rk8", "rtol": None, "atol": None, "tolerance": _REFERENCE}
    return compile_scene(scene.replace(simulation=keys))


def _walk(kernels: Kernels, x: FloatArray, u: FloatArray, divided: bool) -> FloatArray:
    """States under inputs of shape (N, B, n_u), whole steps or divided ones; shape (N + 1, B, n_x)."""
    states = [x]
    for controls in u:
        take = kernels.checked_step if divided else kernels.step
        found = take(states[-1], controls)
        states.append(found[0] if isinstance(found, tuple) else found)
    return np.array(states)


def _apart(kernels: Kernels, states: FloatArray, reference: FloatArray) -> FloatArray:
    """Distance [m] or angle [rad] of the tips, the larger one, infinite for what is no number; shape (B,)."""
    tips = [kernels.tip_pose(each).T for each in (states, reference)]
    apart = np.maximum(poses.error_distance(*tips), poses.error_angle(*tips))
    return np.where(np.isfinite(apart), apart, np.inf)


def _episodes(name: str, kind: str, effort: Effort) -> Outcome:
    """Fly episodes in whole and in divided steps, and ask for the divided ones how far off they are."""
    scene = load_scene(name)
    kernels, rng = compile_scene(scene), np.random.default_rng(0)
    count = effort.action_episodes
    shape = scene.simulation.steps, count, kernels.n_u
    u = kernels.layout.control_limit * ACTIONS[kind](rng, shape)
    x = np.tile(kernels.layout.initial_state, (count, 1))
    states = _walk(kernels, x, u, divided=True)
    right = _walk(_reference(scene), x, u, divided=True)[-1]
    whole, divided = (
        _apart(kernels, ends, right) for ends in (_walk(kernels, x, u, divided=False)[-1], states[-1])
    )
    told = ~(kernels.numerical_error(states, u)[-1] <= 0.5 * RIGHT)
    silent = int(((divided > RIGHT) & ~told).sum())
    return Handled(
        silent,
        f"of {count} episodes {int((divided <= RIGHT).sum())} right, {int(told.sum())} told; median error "
        f"{np.median(divided):.1e}, in whole steps {np.median(whole):.1e} with "
        f"{int(np.isinf(whole).sum())} diverged",
    )


def _spin(method: str, spin: float, effort: Effort) -> Outcome:
    """Let the paper's robot tumble, its joints moving, in the scene's steps."""
    scene = load_scene("paper").replace(simulation={"integrator": method, "tolerance": 1e-6})
    kernels = compile_scene(scene)
    x = moving_start(kernels)
    x[kernels.layout.state.angular_velocity] = spin * np.array([0.48, -0.6, 0.64])
    still = np.zeros((round(1.0 / scene.simulation.dt), 1, kernels.n_u))
    states, right, whole = (
        _walk(each, x[None], still, divided)
        for each, divided in ((kernels, True), (_reference(scene), True), (kernels, False))
    )
    told = float(kernels.numerical_error(states, still)[-1, 0])
    error, blunt = (float(_apart(kernels, each[-1], right[-1])[0]) for each in (states, whole))
    if not told <= 0.5 * RIGHT:
        return NotClaimed(f"told to be {told:.0e} off; it is {error:.0e}, in whole steps {blunt:.0e}")
    return Handled(error, f"told to be {told:.0e} off; in whole steps {blunt:.0e}")
