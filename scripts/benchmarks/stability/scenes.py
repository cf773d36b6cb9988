"""Scenes and states of the cases."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene, load_scene
from dq_space_arm_env.algebra import screw
from dq_space_arm_env.scene import InitialState, Spread
from experts.problems.shooting_problem import FloatArray

PRECISIONS = ("float64", "float32")


def paper(precision: str = "float64", scene: str = "paper") -> Kernels:
    """Kernels of a shipped scene in a precision."""
    return compile_scene(load_scene(scene).replace(simulation={"precision": precision}))


def applied(integrator: str, precision: str) -> str:
    """Subject of a case: integrator and precision, unless that is double."""
    return integrator if precision == "float64" else f"{integrator}, {precision}"


def rounded(array: FloatArray, kernels: Kernels) -> FloatArray:
    """Numbers rounded to the precision of a scene, in double precision."""
    return array.astype(kernels.dtype).astype(np.float64)


def with_mass_ratio(ratio: float) -> Scene:
    """The paper's robot with another base."""
    scene = load_scene("paper")
    factor = ratio * sum(link.mass for link in scene.links) / scene.base.mass
    inertia = (factor * np.array(scene.base.inertia)).tolist()
    return scene.replace(base={"mass": factor * scene.base.mass, "inertia": inertia})


def with_links(scene: Scene, **changes: Any) -> Scene:
    """A scene with the same fields changed in all links."""
    return scene.replace(links=[{**link.model_dump(), **changes} for link in scene.links])


def random_arm(masses: Sequence[float], seed: int, payload: float = 0.0) -> Scene:
    """An arm of any shape: masses of base and links [kg], springs, dampers, motors, a wrench at the tip.

    The inertias are those of clouds of points half a meter wide.
    """
    rng = np.random.default_rng(seed)

    def body(mass: float, **place: Any) -> dict[str, Any]:
        points = 0.25 * rng.normal(size=(6, 3))
        points -= points.mean(axis=0)
        inertia = mass / 6 * (np.sum(points**2) * np.eye(3) - points.T @ points)
        return {"mass": mass, "inertia": inertia.tolist(), **place}

    def pose() -> dict[str, Any]:
        rotation = rng.normal(size=4)
        rotation /= np.linalg.norm(rotation)
        return {"position": rng.uniform(-1.0, 1.0, 3).tolist(), "rotation": rotation.tolist()}

    def center() -> list[float]:
        return [float(entry) for entry in rng.uniform(-0.5, 0.5, 3)]

    passive = {"stiffness": 3.0, "rest_angle": 0.2, "damping": 0.5}
    links = [
        body(mass, name=f"link {i}", center_of_mass=center(), joint=pose(), **passive)
        for i, mass in enumerate(masses[1:], start=1)
    ]
    given = {
        "name": "random arm",
        "base": body(masses[0]),
        "links": links,
        "tip": pose(),
        "payload": body(payload, center_of_mass=center()) if payload else None,
        "tip_wrench": {"force": center(), "torque": center()},
        "actuators": {name: {"limit": 1.0} for name in ("base_force", "base_torque", "joint_torque")},
        "target": {"pose": {"position": [1.0, 0.0, 0.0]}},
    }
    return Scene.model_validate(given)


def sprung_joint(stiffness: float = 0.0, damping: float = 0.0) -> Scene:
    """A planar base, and one link on a spring [N m/rad] and a damper [N m s/rad]."""
    planar = load_scene("planar")
    link = {**planar.links[0].model_dump(), "stiffness": stiffness, "damping": damping}
    return planar.replace(links=[link], initial_state=InitialState(), spread=Spread(), name="sprung joint")


def sprung_inertia(scene: Scene) -> float:
    """Inertia that the joint of `sprung_joint` turns, kg m^2: torque over acceleration, link stretched."""
    base, link = scene.base, scene.links[0]
    lever, reach = link.joint.position[0], link.center_of_mass[0]
    mass = base.mass * link.mass / (base.mass + link.mass)
    whole = base.inertia[2][2] + link.inertia[2][2] + mass * (lever + reach) ** 2
    own = link.inertia[2][2] + mass * reach**2
    coupled = link.inertia[2][2] + mass * reach * (lever + reach)
    return own - coupled**2 / whole


def random_state(kernels: Kernels, rng: np.random.Generator) -> FloatArray:
    """A state anywhere: any attitude, positions of meters."""
    where, x = kernels.layout.state, rng.normal(size=kernels.n_x)
    twist = rng.normal(size=6)
    if kernels.layout.planar:
        twist[[0, 1, 5]] = 0.0
    pose = np.array(screw.exponential(tuple(twist.tolist())))
    x[where.pose] = pose[[0, 3, 5, 6]] if kernels.layout.planar else pose
    return x


def walk(
    kernels: Kernels,
    state: FloatArray,
    controls: FloatArray,
    dt: float,
    integrator: str | None = None,
    p: FloatArray | None = None,
) -> FloatArray:
    """States along inputs, shape (n, n_u): shape (n + 1, n_x), in the scene's precision."""
    if not len(controls):
        return np.asarray(state, kernels.dtype)[None]
    return kernels.simulate(state, controls, len(controls), dt, integrator, p=p)
