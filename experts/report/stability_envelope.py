"""Stability envelope: the longest step, fastest motion and stiffest joints that each integrator holds.

Three motions without inputs are pushed further and further, each in one quantity:

- step: a slow free motion of the scene, in longer and longer steps;
- rate: the same directions, faster and faster, over as many radians, in the scene's steps;
- stiffness: all joints but spherical ones on springs at rest, slightly deflected, in the scene's steps; gears
  are rigid and without friction, and wheels are at rest.

In the first two, an integrator holds while the tip ends close to that of the method of order 8 with short
steps. In the third, it holds while the vibration stays bounded. Without dampers, the only time constant of a
robot on springs k is 1 / sqrt(k): steps h at stiffness k do what steps dt do at k (h / dt)^2. So the step
varies in place of the stiffness, and one scene is compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.report_page import Section
from dq_space_arm_env.common.tables import Column, Row
from dq_space_arm_env.kernels import Kernels, compile_scene
from dq_space_arm_env.scene import INTEGRATORS, Scene
from dq_space_arm_env.scene.bodies import freedoms
from experts.problems.shooting_problem import FloatArray
from experts.report.effort import Announce, Effort
from experts.report.integrator_precision import left_out, tip_error

CLOSE = 0.01
"""An integrator holds while the tip ends within so many m and rad."""
GROWTH = 2.0
"""A vibration is bounded if its second half is larger than the first by at most this factor."""
SLOW = 0.2  # rad/s
TURN = 2.0  # rad, of the fastest part in both motions
DURATION = TURN / SLOW  # s, of the slow motion
SWINGS = 1000  # steps of the vibration
DEFLECTION, LARGEST_SWING = 1e-4, 1e-2  # rad; at the limit of symplectic Euler, swings are 10 times as large
STIFFNESS = 1.0  # N m/rad, of the compiled scene
_FINE_STEPS = 2000  # at least, of references
_STEP_RANGE, _RATE_RANGE, _STIFFNESS_RANGE = (1e-5, DURATION), (1e-3, 1e3), (1e-6, 1e7)

Holds = Callable[[float], bool]


def measure(scene: Scene, effort: Effort, announce: Announce) -> dict[str, list[Row]]:
    """The envelope of each integrator."""
    scene = scene.replace(simulation={"precision": "float64"})
    dt = scene.simulation.dt
    searches = [
        ("step", "s", _slow_motion(scene), dt, _STEP_RANGE),
        ("rate", "rad/s", _fast_motion(scene), 1.0, _RATE_RANGE),
    ]
    if _sprung_coordinates(scene):
        springs = {"N m/rad" if link.unit == "rad" else "N/m" for link in scene.links if link.freedoms == 1}
        searches.append(("stiffness", " or ".join(sorted(springs)), _vibration(scene), 1.0, _STIFFNESS_RANGE))
    rows: list[Row] = []
    integrators = [name for name, entry in INTEGRATORS.items() if entry.takes(scene)]
    for index, integrator in enumerate(integrators):
        announce(integrator, index, len(integrators))
        for quantity, unit, holds, first, (low, high) in searches:
            ratio = effort.ratio**2 if quantity == "stiffness" else effort.ratio
            found = largest(partial(holds, integrator), first, low, high, ratio)
            rows.append(
                {
                    "integrator": integrator,
                    "quantity": quantity,
                    "unit": unit,
                    "largest": found,
                    "is_end_of_search": found >= high,
                }
            )
    return {"envelope": rows}


def largest(holds: Holds, first: float, low: float, high: float, ratio: float) -> float:
    """Largest value in [low, high] at which a condition holds, up to a ratio; 0 if it does not at the lowest.

    The search moves from the first value up or down in factors of 10, then bisects.
    """
    good, bad = 0.0, math.inf
    value = first
    while good == 0.0 or bad == math.inf:
        if holds(value):
            good = value
            if value >= high:
                return high
            value = min(10.0 * value, high)
        else:
            bad = value
            if value <= low:
                return 0.0
            value = max(value / 10.0, low)
    while bad > ratio * good:
        value = math.sqrt(good * bad)
        good, bad = (value, bad) if holds(value) else (good, value)
    return good


def _start(kernels: Kernels, rate: float) -> FloatArray:
    """The scene's start in motion, base and joints turning in directions of their own, no part faster."""
    rng, where, x = np.random.default_rng(0), kernels.layout.state, kernels.layout.initial_state.copy()
    x[where.linear_velocity] = 0.0
    for part in (where.angular_velocity, where.joint_rates):
        directions = rng.uniform(-1.0, 1.0, x[part].shape)
        x[part] = rate * directions / max(np.abs(directions).max(initial=0.0), 1e-9)
    return x


def _end(kernels: Kernels, x: FloatArray, steps: int, dt: float, integrator: str) -> FloatArray:
    with np.errstate(all="ignore"):
        end: FloatArray = kernels.simulate(x, np.zeros(kernels.n_u), steps, dt, integrator, every=steps)[-1]
    return end


def _precise_end(kernels: Kernels, x: FloatArray, steps: int, dt: float) -> FloatArray:
    """The end of a motion by the method of order 8; by a stiff one where that is unstable."""
    for integrator in ("rk8", "rodas5p"):
        end = _end(kernels, x, steps, dt, integrator)
        if np.isfinite(end).all():
            return end
    raise ValueError(
        f"no integrator follows a free motion of scene {kernels.scene.name} in steps of {dt:.1e} s"
    )


def _slow_motion(scene: Scene) -> Callable[[str, float], bool]:
    kernels = compile_scene(scene)
    x = _start(kernels, SLOW)
    finest = max(math.ceil(DURATION / scene.simulation.dt) * 4, _FINE_STEPS)
    reference = _precise_end(kernels, x, finest, DURATION / finest)

    def holds(integrator: str, dt: float) -> bool:
        steps = max(round(DURATION / dt), 1)
        end = _end(kernels, x, steps, DURATION / steps, integrator)
        return tip_error(kernels, end, reference) <= CLOSE

    return holds


def _fast_motion(scene: Scene) -> Callable[[str, float], bool]:
    kernels, dt = compile_scene(scene), scene.simulation.dt

    def steps(rate: float) -> int:
        return math.ceil(min(TURN / rate, DURATION) / dt)

    @cache
    def reference(rate: float) -> FloatArray:
        finer = math.ceil(_FINE_STEPS / steps(rate))
        return _precise_end(kernels, _start(kernels, rate), finer * steps(rate), dt / finer)

    def holds(integrator: str, rate: float) -> bool:
        end = _end(kernels, _start(kernels, rate), steps(rate), dt, integrator)
        return tip_error(kernels, end, reference(rate)) <= CLOSE

    return holds


def on_springs(scene: Scene) -> Scene:
    """The scene with each joint on a spring at rest, spherical ones aside, without dampers and wrench.

    Gears are rigid and without friction: no time constant remains but that of the springs.
    """
    angles = dict(zip(freedoms(scene.links), scene.initial_state.joint_angles, strict=True))
    rigid = {"friction": 0.0, "stiffness": None, "damping": 0.0}
    links = [
        link.model_copy(
            update={
                "stiffness": 0.0,
                "damping": 0.0,
                "motor": link.motor and link.motor.model_copy(update=rigid),
            }
        )
        for link in scene.links
    ]
    for (index, axis), angle in angles.items():
        if not axis:
            links[index] = links[index].model_copy(update={"stiffness": STIFFNESS, "rest_angle": angle})
    return scene.replace(links=links, tip_wrench=None)


def _sprung_coordinates(scene: Scene) -> list[int]:
    """Places of the joints on springs among the coordinates of all joints."""
    ends = np.cumsum([len(link.coordinates) for link in scene.links])
    return [int(end) - 1 for link, end in zip(scene.links, ends, strict=True) if link.freedoms == 1]


def _deflected(kernels: Kernels) -> tuple[FloatArray, NDArray[np.int64]]:
    """The start at rest with its springs deflected, and the places of their joints in the state."""
    x, where = _start(kernels, 0.0), kernels.layout.state
    x[where.wheel_momenta] = 0.0
    sprung = where.joint_angles.start + np.array(_sprung_coordinates(kernels.scene), np.int64)
    x[sprung] += DEFLECTION * np.random.default_rng(0).uniform(0.5, 1.0, sprung.shape)
    return x, sprung


def _vibration(scene: Scene) -> Callable[[str, float], bool]:
    kernels, dt = compile_scene(on_springs(scene)), scene.simulation.dt
    x, sprung = _deflected(kernels)
    rest = kernels.layout.initial_state[sprung]

    def holds(integrator: str, stiffness: float) -> bool:
        h = dt * math.sqrt(stiffness / STIFFNESS)
        with np.errstate(all="ignore"):
            states = kernels.simulate(x, np.zeros(kernels.n_u), SWINGS, h, integrator)
            sizes = np.abs(states[:, sprung] - rest).max(axis=1)
            early, late = sizes[: SWINGS // 2].max(), sizes[SWINGS // 2 :].max()
        # A vibration that has blown up may stay as large as it is: its size counts, too.
        return bool(late <= GROWTH * early and max(early, late) <= LARGEST_SWING)

    return holds


def section(scene: Scene, found: dict[str, list[Row]]) -> Section:
    """The section of the report."""
    rows, dt = found["envelope"], scene.simulation.dt
    made = Section(
        "stability",
        "Stability envelope",
        f"Step: the longest in which an integrator follows a free motion of {SLOW:g} rad/s, {DURATION:g} s. "
        f"Rate: the fastest motion that it follows over {TURN:g} rad, {DURATION:g} s at most, in the scene's "
        f"steps of {dt:g} s. "
        "Stiffness: that of the stiffest joints, with rigid gears and no friction, whose swings of "
        f"{DEFLECTION:g} rad stay bounded over {SWINGS} of these steps. An integrator follows a "
        f"motion if the tip ends within {CLOSE:g} m and rad of a precise solution.",
    )
    units = {row["quantity"]: row["unit"] for row in rows}
    wide = []
    for integrator in dict.fromkeys(row["integrator"] for row in rows):
        own = [row for row in rows if row["integrator"] == integrator]
        values = {row["quantity"]: _limit(row) for row in own}
        wide.append({"integrator": integrator, **values})
    columns = [
        Column(quantity, f"{quantity}\n{unit}", missing="no joints")
        for quantity, unit in (
            ("step", f"s\n{TURN:g} rad at {SLOW:g} rad/s"),
            ("rate", f"rad/s\nover {TURN:g} rad"),
            ("stiffness", f"{units.get('stiffness', 'N m/rad')}\nswings of {DEFLECTION:g} rad"),
        )
    ]
    made.add_rows("limits", wide, ["integrator", *columns], "The largest that each integrator holds")
    made.notes.append(
        f"These are limits of short motions and small swings: longer spins, and stiff joints that swing by "
        f"more than {DEFLECTION:g} rad, fail earlier."
    )
    made.notes += left_out(scene)

    def draw() -> bytes:
        from experts.figures.plots import Plot

        bars = [{**row, "panel": f"{row['quantity']} [{row['unit']}]"} for row in rows if row["largest"]]
        return Plot("largest", "integrator", facet="panel", log="x", columns=3, labels={"largest": ""}).png(
            bars
        )

    made.add_figure("stability", "The largest that each integrator holds.", draw)
    return made


def _limit(row: Row) -> str:
    if row["is_end_of_search"]:
        return f"≥ {row['largest']:g}"
    return f"{row['largest']:.2g}" if row["largest"] else "none"
