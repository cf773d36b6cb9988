"""A payload caught and released: the mass jumps, the momentum of the whole stays."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, rotations
from dq_space_arm_env.kernels.capture import catch_payload
from dq_space_arm_env.scene import Payload
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, Outcome, largest, refusal
from scripts.benchmarks.stability.scenes import random_state

GROUP = "payloads"

KEPT = 1e-13
FACTORS = (1e-6, 1e-3, 1.0, 1e3, 1e6)  # masses of payloads, in multiples of the scene's


class Momentum(NamedTuple):
    """Momentum in inertial axes, angular about the origin."""

    linear: FloatArray
    angular: FloatArray


def cases() -> Iterator[Case]:
    for factor in FACTORS:
        criterion = "linear and angular momentum of robot and payload kept to 1e-13, no energy gained"
        run = partial(_caught, factor)
        title = f"payload of {50.0 * factor:g} kg caught"
        yield Case(GROUP, title, "catch_payload", criterion, run, KEPT, "of the parts")
        criterion = "momentum of robot and payload kept to 1e-13"
        run = partial(_released, factor)
        title = f"payload of {50.0 * factor:g} kg released"
        yield Case(GROUP, title, "kernels", criterion, run, KEPT, "of the parts")
    yield Case(GROUP, "caught twice", "catch_payload", "refused", _caught_twice)
    yield Case(GROUP, "NaN in the payload's twist", "catch_payload", "refused", _caught_nan)


def _kernels(factor: float) -> tuple[Kernels, Kernels]:
    """The scene `payload` without and with its payload, of another mass."""
    scene = load_scene("payload")
    assert scene.payload is not None
    inertia = (factor * np.array(scene.payload.inertia)).tolist()
    heavy = {"mass": factor * scene.payload.mass, "inertia": inertia}
    return compile_scene(scene.replace(payload=None)), compile_scene(scene.replace(payload=heavy))


def _of_robot(kernels: Kernels, x: FloatArray) -> Momentum:
    """Momentum of a robot about the origin; the kernels give the angular one about its center of mass."""
    found = kernels.momentum(x)
    return Momentum(found[:3], found[3:] + np.cross(_center(kernels, x), found[:3]))


def _center(kernels: Kernels, x: FloatArray) -> FloatArray:
    """Center of mass of a robot, in inertial axes."""
    scene, frames = kernels.scene, kernels.frame_poses(x)
    bodies = [(scene.base.mass, (0.0, 0.0, 0.0), frames[0])]
    bodies += [
        (link.mass, link.center_of_mass, frame) for link, frame in zip(scene.links, frames[1:], strict=False)
    ]
    if scene.payload is not None:
        bodies.append((scene.payload.mass, scene.payload.center_of_mass, frames[-1]))
    total = sum(mass for mass, _, _ in bodies)
    center = np.zeros(3)
    for mass, where, frame in bodies:
        center += mass / total * _point(frame, where)
    return center


def _point(frame: FloatArray, p: tuple[float, ...]) -> FloatArray:
    q = tuple(frame.tolist())
    point: FloatArray = np.array(poses.position(q)) + np.array(rotations.rotate(q[:4], p))
    return point


def _of_payload(payload: Payload, tip: FloatArray, twist: FloatArray) -> Momentum:
    """Momentum of a payload about the origin, from its twist in tip axes."""
    turn: FloatArray = np.array(poses.to_matrix(tuple(tip.tolist()))[0])
    omega, center = twist[:3], np.array(payload.center_of_mass)
    linear = turn @ (payload.mass * (twist[3:] + np.cross(omega, center)))
    angular = turn @ (np.array(payload.inertia) @ omega)
    return Momentum(linear, angular + np.cross(_point(tip, payload.center_of_mass), linear))


def _energy(payload: Payload, twist: FloatArray) -> float:
    omega = twist[:3]
    velocity = twist[3:] + np.cross(omega, payload.center_of_mass)
    return 0.5 * float(payload.mass * velocity @ velocity + omega @ np.array(payload.inertia) @ omega)


def _difference(before: list[Momentum], after: list[Momentum]) -> float:
    """Change of the total, relative to the largest part; the worse one of linear and angular."""
    worst = 0.0
    for part in Momentum._fields:
        terms = [getattr(momentum, part) for momentum in before]
        change = sum(terms) - sum(getattr(momentum, part) for momentum in after)
        worst = largest(worst, float(np.abs(change).max() / max(np.abs(term).max() for term in terms)))
    return worst


def _caught(factor: float, effort: Effort) -> Outcome:
    free, loaded = _kernels(factor)
    payload = loaded.scene.payload
    assert payload is not None
    worst = 0.0
    for seed in range(effort.samples):
        rng = np.random.default_rng(seed)
        x, twist = random_state(free, rng), rng.normal(size=6)
        after = catch_payload(free, loaded, x, twist)
        before = [_of_robot(free, x), _of_payload(payload, free.tip_pose(x), twist)]
        worst = largest(worst, _difference(before, [_of_robot(loaded, after)]))
        energy = free.energy(x) + _energy(payload, twist)
        if loaded.energy(after) > energy * (1.0 + 1e-12):
            return Handled(np.inf, f"energy grows from {energy:.6g} J to {loaded.energy(after):.6g} J")
    return Handled(worst)


def _tip_twist(kernels: Kernels, x: FloatArray) -> FloatArray:
    """Twist of the tip in tip axes, from the twists of base and joints in the joints' frames."""
    where, frames = kernels.layout.state, [tuple(frame) for frame in kernels.frame_poses(x).tolist()]
    velocity = x[where.base_velocity]
    twist = (0.0, *velocity[:3].tolist(), 0.0, *velocity[3:].tolist())
    for joint, (inner, outer) in enumerate(pairwise(frames[:-1])):
        relative = dq.multiply(dq.conjugate(inner), outer)
        twist = dq.inverse_adjoint(relative, twist)
        twist = (*twist[:3], twist[3] + float(x[where.joint_rates][joint]), *twist[4:])
    twist = dq.inverse_adjoint(dq.multiply(dq.conjugate(frames[-2]), frames[-1]), twist)
    return np.array([*twist[1:4], *twist[5:8]])


def _released(factor: float, effort: Effort) -> Outcome:
    free, loaded = _kernels(factor)
    payload = loaded.scene.payload
    assert payload is not None
    worst = 0.0
    for seed in range(effort.samples):
        x = random_state(free, np.random.default_rng(seed))
        after = [_of_robot(free, x), _of_payload(payload, free.tip_pose(x), _tip_twist(free, x))]
        worst = largest(worst, _difference([_of_robot(loaded, x)], after))
    return Handled(worst)


def _caught_twice(effort: Effort) -> Outcome:
    _, loaded = _kernels(1.0)
    x = loaded.layout.initial_state
    return refusal(lambda: catch_payload(loaded, loaded, x, np.zeros(6)), naming="payload")


def _caught_nan(effort: Effort) -> Outcome:
    free, loaded = _kernels(1.0)
    twist = np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0])
    return refusal(
        lambda: catch_payload(free, loaded, free.layout.initial_state, twist), naming="payload_twist"
    )
