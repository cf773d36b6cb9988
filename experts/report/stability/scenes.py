"""Scenes and states that the cases are made of."""

from __future__ import annotations

from typing import Any

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene, load_scene
from dq_space_arm_env.algebra import screw
from experts.problem import FloatArray

PRECISIONS = ("float64", "float32")
INERTIA = [[0.02, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]]


def with_simulation(scene: Scene, **changes: Any) -> Scene:
    """A scene that is discretized otherwise.

    Args:
        scene: The scene.
        **changes: Fields of its simulation.

    Returns:
        The new scene.
    """
    return scene.replace(simulation={**scene.simulation.model_dump(), **changes})


def paper(precision: str = "float64", scene: str = "paper") -> Kernels:
    """Functions of a shipped scene in a precision.

    Args:
        precision: "float64" or "float32".
        scene: Its name; that of the paper by default.

    Returns:
        The functions.
    """
    return compile_scene(with_simulation(load_scene(scene), precision=precision))


def applied(integrator: str, precision: str) -> str:
    """What a case is applied to, in words.

    Args:
        integrator: Name of the integrator.
        precision: "float64", which goes without saying, or "float32".

    Returns:
        The words.
    """
    return integrator if precision == "float64" else f"{integrator}, {precision}"


def rounded(array: FloatArray, kernels: Kernels) -> FloatArray:
    """Numbers as a scene's precision holds them.

    Args:
        array: Numbers.
        kernels: Functions of the scene.

    Returns:
        The same, rounded, in double precision.
    """
    return array.astype(kernels.dtype).astype(np.float64)


def with_mass_ratio(ratio: float) -> Scene:
    """The paper's robot with another base.

    Args:
        ratio: Mass of the base in multiples of that of all links.

    Returns:
        The scene; the base's inertia goes with its mass.
    """
    scene = load_scene("paper")
    factor = ratio * sum(link.mass for link in scene.links) / scene.base.mass
    inertia = (factor * np.array(scene.base.inertia)).tolist()
    return scene.replace(
        base={**scene.base.model_dump(), "mass": factor * scene.base.mass, "inertia": inertia}
    )


def with_links(scene: Scene, **changes: Any) -> Scene:
    """A scene whose links all differ in the same fields.

    Args:
        scene: The scene.
        **changes: Fields of each link.

    Returns:
        The new scene.
    """
    return scene.replace(links=[{**link.model_dump(), **changes} for link in scene.links])


def with_base(scene: Scene, **changes: Any) -> Scene:
    """A scene with another base.

    Args:
        scene: The scene.
        **changes: Fields of the base.

    Returns:
        The new scene.
    """
    return scene.replace(base={**scene.base.model_dump(), **changes})


def sprung_joint(stiffness: float = 0.0, damping: float = 0.0) -> Scene:
    """A base that moves in the plane, and one link on a spring and a damper.

    Args:
        stiffness: Of the spring, N m/rad.
        damping: Of the damper, N m s/rad.

    Returns:
        The scene.
    """
    planar = load_scene("planar")
    link = {**planar.links[0].model_dump(), "stiffness": stiffness, "damping": damping}
    return planar.replace(links=[link], initial_state={}, spread={}, name="sprung joint")


def sprung_inertia(scene: Scene) -> float:
    """Inertia that the joint of `sprung_joint` turns, base and link recoiling, the link stretched out.

    Args:
        scene: From `sprung_joint`.

    Returns:
        The inertia, kg m^2: torque over joint acceleration.
    """
    base, link = scene.base, scene.links[0]
    lever, reach = link.joint.position[0], link.center_of_mass[0]
    mass = base.mass * link.mass / (base.mass + link.mass)
    whole = base.inertia[2][2] + link.inertia[2][2] + mass * (lever + reach) ** 2
    own = link.inertia[2][2] + mass * reach**2
    coupled = link.inertia[2][2] + mass * reach * (lever + reach)
    return own - coupled**2 / whole


def random_state(kernels: Kernels, rng: np.random.Generator, scale: float = 1.0) -> FloatArray:
    """A state anywhere: any attitude, positions of meters.

    Args:
        kernels: Functions of the scene.
        rng: Random generator.
        scale: Size of rates, rad/s and m/s.

    Returns:
        State, shape (n_x,), units of `kernels.layout.state`.
    """
    where, x = kernels.layout.state, rng.normal(size=kernels.n_x)
    twist = rng.normal(size=6)
    if kernels.layout.planar:
        twist[[0, 1, 5]] = 0.0
    pose = np.array(screw.exponential(tuple(twist.tolist())))
    x[where.pose] = pose[[0, 3, 5, 6]] if kernels.layout.planar else pose
    x[where.base_velocity] *= scale
    x[where.joint_rates] *= scale
    return x


def walk(
    kernels: Kernels, state: FloatArray, controls: FloatArray, dt: float, integrator: str | None = None
) -> FloatArray:
    """States along a sequence of inputs.

    Args:
        kernels: Functions of the scene.
        state: First state, shape (n_x,), units of `kernels.layout.state`.
        controls: Inputs, shape (n, n_u), units of `kernels.layout.control`.
        dt: Time step, s.
        integrator: Name of the integrator; the scene's by default.

    Returns:
        States, shape (n + 1, n_x), in the scene's precision.
    """
    if not len(controls):
        return np.asarray(state, kernels.dtype)[None]
    return kernels.simulate(state, controls, len(controls), dt, integrator)
