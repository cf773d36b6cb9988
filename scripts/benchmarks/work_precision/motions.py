"""Motions that every integrator follows: a free body, the maneuver, a spin, stiff joints, a long chain.

Also the expert's maneuver in each scene, which decides on the scene's own integrator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.scene import InitialState, Spread
from experts import BoxDDP
from experts.ddp.solution import uninterrupted
from experts.problems.shooting_problem import FloatArray

DEFAULT_ACCURACY = 1e-4
"""Error of the tip [m, rad] that a scene's own integrator stays below: a thousandth of the 10 cm within
which scene paper succeeds."""
STIFFNESS = 1e4  # spring of the stiff joint, N m/rad
STIFF_JOINT = 1
CHAIN_JOINTS = 8
_LONGEST = 64
"""Time steps of the scene in the longest step of a free motion: halved six times, it is the scene's."""


@dataclass(frozen=True, eq=False)
class MotionCase:
    """A motion from a start under inputs that are held for equal times."""

    name: str
    title: str
    scene: Scene
    start: FloatArray  # state at time 0, shape (n_x,), units of the scene's layout
    controls: FloatArray  # inputs, shape (holds, n_u)
    hold: float  # time that each row of inputs is held for, s; steps divide it
    coarsest: int
    limit: float  # error [m, rad] that some method must stay below, or accuracy has regressed
    is_smooth: bool = True
    with_paper_form: bool = False
    has_other_code: bool = True
    parameters: FloatArray | None = None  # of each hold, shape (holds, n_p); nominal ones if None

    @property
    def duration(self) -> float:
        """Length of the motion, s."""
        return len(self.controls) * self.hold

    @property
    def is_single_body(self) -> bool:
        return not self.scene.links


def make_case(name: str, duration: float) -> MotionCase:
    return CASES[name](duration)


def _free(
    name: str,
    title: str,
    scene: Scene,
    duration: float,
    *,
    twist: tuple[float, ...],
    rates: tuple[float, ...] = (),
    limit: float,
    is_smooth: bool = True,
) -> MotionCase:
    """A motion without inputs, as long as some of the longest steps."""
    kernels = compile_scene(scene)
    start = kernels.layout.initial_state.astype(np.float64)
    start[kernels.layout.state.base_velocity] = twist
    start[kernels.layout.state.joint_rates] = rates
    longest = _LONGEST * scene.simulation.dt
    steps, controls = max(round(duration / longest), 1), np.zeros((1, kernels.n_u))
    return MotionCase(name, title, scene, start, controls, steps * longest, steps, limit, is_smooth)


def body_scene() -> Scene:
    """A base alone with three different moments of inertia; its tip is a point 1 m from its center."""
    return load_scene("paper").replace(
        name="body",
        base={"mass": 105, "inertia": [12, 9, 5]},
        links=[],
        wrist=None,
        tip={"position": [1, 0, 0]},
        actuators={"base_force": None, "joint_torque": None, "wrist_rate": None},
        initial_state=InitialState(),
        spread=Spread(),
    )


def _body(duration: float) -> MotionCase:
    twist = (0.03, 1.0, 0.02, 0.05, -0.03, 0.02)
    title = "Body alone, turning over (Dzhanibekov), 1 rad/s"
    return _free("body", title, body_scene(), duration, twist=twist, limit=1e-12)


def _maneuver(duration: float) -> MotionCase:
    scene = load_scene("paper")
    dt = scene.simulation.dt
    steps = min(max(round(duration / dt), 1), scene.simulation.steps)
    solution = uninterrupted(BoxDDP(scene, second_order="gauss_newton").solve())
    return MotionCase(
        "maneuver",
        "The paper's maneuver, the expert's inputs",
        scene,
        np.array(solution.states[0], dtype=np.float64),
        np.array(solution.controls[:steps], dtype=np.float64),
        dt,
        1,
        limit=1e-11,
        with_paper_form=True,
    )


def scene_case(name: str) -> MotionCase:
    """The expert's maneuver in a scene."""
    scene = load_scene(name)
    solution = uninterrupted(BoxDDP(scene).solve())
    return MotionCase(
        name,
        name,
        scene,
        np.array(solution.states[0], dtype=np.float64),
        np.array(solution.controls, dtype=np.float64),
        scene.simulation.dt,
        1,
        limit=DEFAULT_ACCURACY,
        has_other_code=False,
        parameters=np.array(solution.parameters[:-1], dtype=np.float64),
    )


def _spin(duration: float) -> MotionCase:
    return _free(
        "spin",
        "Arm let go in a spin of 2 rad/s",
        load_scene("free-floating"),
        duration,
        twist=(1.2, -0.8, 1.4, 0.1, -0.1, 0.2),
        rates=(0.5, -0.4, 0.3),
        limit=1e-7,
    )


def stiff_scene(damping: float = 0.0) -> Scene:
    """The paper's arm with a stiff spring at rest in its second joint."""
    scene = load_scene("paper")
    links: list[Any] = list(scene.links)
    links[STIFF_JOINT] = links[STIFF_JOINT].model_copy(
        update={
            "stiffness": STIFFNESS,
            "damping": damping,
            "rest_angle": scene.initial_state.joint_angles[STIFF_JOINT],
        }
    )
    return scene.replace(name="stiff joint", links=links)


_STIFF_MOTION: Mapping[str, Any] = {"twist": (0.2, -0.1, 0.15, 0.05, 0.0, -0.05), "rates": (0.3, 0.0, -0.4)}


def _stiff(duration: float) -> MotionCase:
    title = f"Stiff joint, {STIFFNESS:g} N m/rad"
    return _free("stiff", title, stiff_scene(), duration, **_STIFF_MOTION, limit=1e-8, is_smooth=False)


def _damped(duration: float) -> MotionCase:
    title = f"Stiff joint, {STIFFNESS:g} N m/rad, with 500 N m s/rad"
    return _free("damped", title, stiff_scene(500.0), duration, **_STIFF_MOTION, limit=1e-8, is_smooth=False)


def chain_scene() -> Scene:
    """The arm of scene six-joint, continued by more of its links."""
    scene = load_scene("six-joint")
    links = [link.model_copy(update={"torque_limit": None}) for link in scene.links]
    for index in range(CHAIN_JOINTS - len(links)):
        # Roll and pitch alternate.
        links.append(links[4 + index % 2].model_copy(update={"name": f"joint {len(links) + 1}"}))
    angles = (*scene.initial_state.joint_angles, *(0.3,) * (CHAIN_JOINTS - len(scene.links)))
    return scene.replace(
        name="long chain", links=links, initial_state=InitialState(joint_angles=angles), spread=Spread()
    )


def _chain(duration: float) -> MotionCase:
    rates = (0.3, -0.2, 0.25, 0.4, -0.3, 0.5, 0.3, -0.4)
    return _free(
        "chain",
        f"Chain of {CHAIN_JOINTS} joints, let go",
        chain_scene(),
        duration,
        twist=(0.1, -0.1, 0.15, 0.0, 0.05, 0.0),
        rates=rates,
        limit=1e-8,
    )


CASES: Mapping[str, Callable[[float], MotionCase]] = {
    "body": _body,
    "maneuver": _maneuver,
    "spin": _spin,
    "stiff": _stiff,
    "damped": _damped,
    "chain": _chain,
}
"""Makes each case for a duration."""
