"""How a robot in MJCF looks: geoms like those in the project's pictures, a camera, a light, a sky."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import ArrayLike

from dq_space_arm_env.algebra import dual_quaternion, poses, rotations
from dq_space_arm_env.interoperability.exporting import tip_on_its_body, words
from dq_space_arm_env.scene import Base, Link, Payload, Scene, Shape
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.scene.shapes import COLORS, color_of
from dq_space_arm_env.validation.fields import Three
from dq_space_arm_env.viewing.picture_format import PictureFormat
from dq_space_arm_env.viewing.rendering.camera import SUN, Camera, camera_of
from dq_space_arm_env.viewing.rendering.spacecraft import (
    AXIS_COLORS,
    SpacecraftModel,
    equivalent_box,
    frames_before,
)

_THIN = 0.25  # radius of the axes at tip and target over that of the last link
_PICTURE = PictureFormat(1920, 1440)  # the largest that MuJoCo may draw offscreen


def add_surroundings(root: Element, world: Element, scene: Scene) -> None:
    """Add sky, camera, light, and the class of all geoms, which neither collide nor weigh anything."""
    defaults = SubElement(root, "default")
    SubElement(defaults, "geom", contype="0", conaffinity="0", density="0", group="1")
    visual = SubElement(root, "visual")
    SubElement(visual, "headlight", ambient="0.4 0.4 0.4", diffuse="0.1 0.1 0.12", specular="0 0 0")
    SubElement(visual, "global", offwidth=str(_PICTURE.width), offheight=str(_PICTURE.height))
    stars = {"mark": "random", "markrgb": "1 1 1", "random": "0.002"}
    night = {"type": "skybox", "builtin": "gradient", "rgb1": "0.03 0.04 0.08", "rgb2": "0.05 0.08 0.15"}
    SubElement(SubElement(root, "asset"), "texture", {**night, **stars, "width": "512", "height": "3072"})
    camera = camera_of(SpacecraftModel(scene).region, scene.base.motion == "planar", _PICTURE)
    right, down, _ = camera.axes
    SubElement(
        world,
        "camera",
        name="overview",
        pos=words(camera.position),
        xyaxes=words([*right, *-down]),
        fovy=words([_field_of_view(camera)]),
    )
    shining = -SUN @ camera.axes
    light = {"name": "sun", "pos": words(camera.position), "dir": words(shining / np.linalg.norm(shining))}
    SubElement(world, "light", {**light, "directional": "true", "diffuse": "0.7 0.7 0.7"})


def _field_of_view(camera: Camera) -> float:
    """Between lower and upper edge of the picture, deg."""
    return math.degrees(2.0 * math.atan(0.5 * camera.height / camera.focal_length))


def add_target(world: Element, scene: Scene, name: str) -> None:
    """Add the target where it is at the start: a mocap body with its shapes, which moves nothing."""
    target, body = (each if each is None else np.atleast_2d(each)[0] for each in shown_target(scene))
    assert target is not None
    place = target if body is None else body
    element = SubElement(world, "body", {"name": name, "mocap": "true", **placed(place.tolist())})
    add_shapes(element, scene.target.geometry, COLORS["metal"])
    goal = dual_quaternion.multiply(dual_quaternion.conjugate(tuple(place)), tuple(target))
    add_mark(element, scene, name, goal)


def add_mark(body: Element, scene: Scene, name: str, pose: Sequence[float]) -> None:
    """Add a site, with its axes in red, green and blue as sites without names."""
    SubElement(body, "site", {"name": name, **placed(pose)})
    model = SpacecraftModel(scene)
    matrix, position = (np.array(part) for part in poses.to_matrix(tuple(pose)))
    for axis, color in zip(matrix.T, AXIS_COLORS, strict=True):
        ends = [*position, *(position + model.axis_length * axis)]
        radius = _THIN * model.radius(scene.tip_body)
        look = {"type": "cylinder", "fromto": words(ends), "size": words([radius])}
        SubElement(body, "site", {**look, "rgba": words([*color, 1.0])})


def placed(pose: Sequence[float]) -> dict[str, str]:
    """Attributes of a pose, a dual quaternion of shape (8,), real part dimensionless, dual part m."""
    rotation, position = poses.to_rotation_and_position(tuple(pose))
    return {"pos": words(position), "quat": words(rotation)}


def add_shapes(body: Element, shapes: Sequence[Shape], color: Three) -> None:
    """Add shapes that a scene gives."""
    for shape in shapes:
        x, y, z = (0.5 * edge for edge in shape.edges)
        size, kind = ((x, y, z), "box") if shape.cylinder is None else ((x, z), "cylinder")
        _add(body, kind, size, color_of(shape, color), placed(shape.pose.dual_quaternion))


def add_base(body: Element, base: Base) -> None:
    """Add the base's shapes, or the homogeneous box of its inertia."""
    if base.geometry:
        add_shapes(body, base.geometry, COLORS["foil"])
    else:
        _add_box(body, base, (0.0, 0.0, 0.0), COLORS["foil"])


def add_payload(body: Element, payload: Payload) -> None:
    """Add the payload's shapes, or the homogeneous box of its inertia."""
    if payload.geometry:
        add_shapes(body, payload.geometry, COLORS["teal"])
    else:
        _add_box(body, payload, payload.center_of_mass, COLORS["teal"])


def add_arm(bodies: Sequence[Element], scene: Scene) -> None:
    """Add links and joints to base and links, which are in the order of the scene."""
    model = SpacecraftModel(scene)
    own = [scene.base.geometry, *(link.geometry for link in scene.links)]
    for number, start, end in _rods(scene):
        if own[number]:
            continue
        thick, color = (1.0, COLORS["white"]) if number else (1.2, COLORS["metal"])
        radius = thick * model.radius(number)
        if np.linalg.norm(np.subtract(end, start)) > 0.1 * radius:
            _add(bodies[number], "cylinder", [radius], color, {"fromto": words([*start, *end])})
    carrying = set(frames_before(scene)[0])
    for number, link in enumerate(scene.links, start=1):
        if own[number]:
            add_shapes(bodies[number], own[number], COLORS["white"])
            continue
        if number not in carrying:
            _add_box(bodies[number], link, link.center_of_mass, COLORS["white"])
        radius = model.radius(number)
        if link.is_spherical:
            _add(bodies[number], "sphere", [1.5 * radius], COLORS["slate"])
        elif not link.is_fixed:
            _add(bodies[number], "cylinder", [1.5 * radius, 1.6 * radius], COLORS["slate"])
    if scene.wrist is not None and not own[scene.tip_body]:
        place = {"pos": words(scene.wrist.frame.position)}
        size = [1.5 * model.radius(scene.tip_body)]
        _add(bodies[scene.tip_body], "sphere", size, COLORS["slate"], place)


def _rods(scene: Scene) -> Iterator[tuple[int, Sequence[float], Sequence[float]]]:
    """The body and the ends, in its frame, of each rod from a joint to what its link carries."""
    before, offsets = frames_before(scene)
    for number, end in zip(before, offsets, strict=True):
        if number <= len(scene.links):
            yield number, (0.0, 0.0, 0.0), end
        else:  # from the wrist, which is no body here, to the tip
            assert scene.wrist is not None
            _, tip = poses.to_rotation_and_position(tip_on_its_body(scene))
            yield scene.tip_body, scene.wrist.frame.position, tip


def _add_box(body: Element, of: Base | Link | Payload, center: Sequence[float], color: Three) -> None:
    size, axes = equivalent_box(of.mass, of.inertia)
    axes = axes * [1.0, 1.0, np.sign(np.linalg.det(axes))]
    place = {"pos": words(center), "quat": words(rotations.from_matrix(axes.tolist()))}
    _add(body, "box", 0.5 * size, color, place)


def _add(body: Element, kind: str, size: ArrayLike, color: Three, at: dict[str, str] | None = None) -> None:
    look = {"type": kind, "size": words(np.asarray(size).tolist()), "rgba": words([*color, 1.0])}
    SubElement(body, "geom", {**look, **(at or {})})
