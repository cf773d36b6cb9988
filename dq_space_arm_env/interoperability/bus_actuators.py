"""Reaction wheels and thrusters for a spacecraft of which only mass and inertia are known."""

from __future__ import annotations

import numpy as np

from dq_space_arm_env.scene import Scene
from dq_space_arm_env.viewing.rendering.spacecraft import equivalent_box

_BUS = 105.0  # mass of the bus that these wheels are for, kg; others are in proportion
_WHEEL = {"inertia": 0.0075, "torque": 0.2, "power": 80.0}  # kg m^2, N m, W
_SPEED = 540.0  # rad/s
_SPECIFIC_IMPULSE = 60.0  # s, of cold gas
_JET_WEIGHT = 0.3  # 1/N^2, of the scene `thrusters`
_PLACE = 0.45  # of the edges of the bus, from its center
# Corners of the bus, and directions of the forces there: pairs of neighbors push along an axis of the base,
# and turn it about each axis, either way.
_JETS = (
    ((1, 1, 1), (-1, -1, -1)),
    ((1, 1, -1), (1, -1, 1)),
    ((1, -1, 1), (-1, 1, 1)),
    ((1, -1, -1), (1, 1, -1)),
    ((-1, 1, 1), (1, 1, -1)),
    ((-1, 1, -1), (-1, 1, 1)),
    ((-1, -1, 1), (1, -1, 1)),
    ((-1, -1, -1), (-1, -1, -1)),
)


def with_wheels(scene: Scene, arrangement: str) -> Scene:
    """The scene with reaction wheels instead of an ideal torque, in size for the mass of its base.

    Wheels of 4 N m s and 0.2 N m are for a bus of about 100 kg; others are in proportion to the mass. The
    constraint `wheels` tells the expert their largest speeds and powers.

    Args:
        scene: A scene.
        arrangement: `pyramid` for four wheels, `orthogonal` for three.

    Returns:
        The scene; momenta of the wheels are states.
    """
    share = scene.base.mass / _BUS
    wheels = {name: float(f"{value * share:.3g}") for name, value in _WHEEL.items()}
    limits = {"name": "wheels", "kind": "wheel_limits", "margin": 1.0, "tolerance": 1.0, "observed": 100.0}
    return scene.replace(
        actuators={"base_torque": None, "wheels": {"set": arrangement, "speed": _SPEED, **wheels}},
        constraints=[*(each.model_dump() for each in scene.constraints), limits],
    )


def with_jets(scene: Scene, force: float) -> Scene:
    """The scene with eight thrusters at the corners of its bus instead of an ideal force.

    The bus is the box of the base's mass and inertia. Each jet pushes along a diagonal; together they push
    and turn the base along and about every axis.

    Args:
        scene: A scene.
        force: Largest force of each thruster, N.

    Returns:
        The scene; the forces of the thrusters are inputs.
    """
    edges, _ = equivalent_box(scene.base.mass, np.diag(np.diag(scene.base.inertia)))
    jets = [
        {
            "position": [
                float(f"{_PLACE * edge * sign:.4g}") for edge, sign in zip(edges, corner, strict=True)
            ],
            "direction": direction,
            "force": force,
            "specific_impulse": _SPECIFIC_IMPULSE,
        }
        for corner, direction in _JETS
    ]
    return scene.replace(
        actuators={"base_force": None, "thrusters": jets},
        cost={"thruster_force": _JET_WEIGHT},
    )
