"""Shapes that pictures draw for a body: boxes and cylinders. They change no motion."""

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.pose import Pose
from dq_space_arm_env.validation.fields import SIZES, Size, Three, read_numbers
from dq_space_arm_env.validation.problems import Model, Problem, problem

COLORS: Mapping[str, Three] = {
    "foil": (1.0, 0.74, 0.34),
    "metal": (0.62, 0.65, 0.70),
    "dark_metal": (0.24, 0.26, 0.31),
    "radiator": (0.80, 0.82, 0.85),
    "cells": (0.16, 0.27, 0.58),
    "white": (0.95, 0.95, 0.96),
    "slate": (0.36, 0.42, 0.52),
    "teal": (0.42, 0.60, 0.58),
}
"""Colors by name: red, green, blue, 0 to 1."""

_HEXADECIMAL = re.compile(r"#[0-9a-f]{6}")


def _read_edges(value: Any) -> Three:
    edges = read_numbers(value, 3, SIZES)
    if not all(edge > 0 for edge in edges):
        raise problem("must be 3 finite numbers, each greater than 0")
    x, y, z = edges
    return (x, y, z)


def _read_color(value: Any) -> str:
    color = value.lower() if isinstance(value, str) else ""
    if color not in COLORS and not _HEXADECIMAL.fullmatch(color):
        wanted = did_you_mean(color, COLORS, 'it must be a name or "#rrggbb"')
        raise problem(f"unknown color; {wanted}")
    return color


class Cylinder(Model):
    """A cylinder about the z axis of its shape's frame, as long on either side of the origin."""

    radius: Size = Field(description="radius of the cylinder, m")
    length: Size = Field(description="length of the cylinder along z, m")


class Shape(Model):
    """A box or a cylinder that pictures draw for a body, with its center at the origin of `pose`."""

    box: Annotated[Three, BeforeValidator(_read_edges)] | None = Field(
        default=None,
        description="edge lengths of a box along x, y and z of its pose, m; absent: the shape is a cylinder",
    )
    cylinder: Cylinder | None = Field(
        default=None, description="cylinder about the z axis of its pose; absent: the shape is a box"
    )
    pose: Pose = Field(
        default_factory=Pose,
        description="pose of the shape in the frame of the body, m: base frame e0, joint frame of a link, "
        "tip frame of the payload, or frame of the target",
    )
    color: Annotated[str, BeforeValidator(_read_color)] | None = Field(
        default=None,
        description=f'{", ".join(COLORS)}, or "#rrggbb" in quotes; absent: foil for the base, white for '
        "links, teal for the payload, metal for the target",
    )

    @property
    def edges(self) -> Three:
        """Edge lengths of the box, or of that around the cylinder, along the axes of `pose`, m."""
        if self.cylinder is not None:
            return (2.0 * self.cylinder.radius, 2.0 * self.cylinder.radius, self.cylinder.length)
        return self.box or (0.0, 0.0, 0.0)  # which a valid shape has

    def _problems(self) -> Iterator[Problem]:
        """Find a shape that is not one of the two."""
        if self.box is None and self.cylinder is None:
            yield Problem((), {}, "must have box: [x, y, z] or cylinder: {radius, length}, m")
        elif self.box is not None and self.cylinder is not None:
            yield Problem(("cylinder",), self.cylinder, "a shape is one solid: remove it, or remove box")


def geometry_field(body: str) -> Any:
    """The field `geometry` of a body.

    Args:
        body: What pictures would draw without it, in words.

    Returns:
        A pydantic field, empty by default; dumps of scenes without it are as old as those scenes.
    """
    return Field(
        default=(),
        exclude_if=lambda shapes: not shapes,
        description=f"shapes that pictures draw for it, without effect on the motion; empty: {body}",
    )


def color_of(shape: Shape, default: Three) -> Three:
    """Red, green and blue of a shape.

    Args:
        shape: The shape.
        default: Color where the shape names none, red, green, blue, 0 to 1.

    Returns:
        Red, green, blue, 0 to 1.
    """
    if shape.color is None:
        return default
    if shape.color in COLORS:
        return COLORS[shape.color]
    red, green, blue = bytes.fromhex(shape.color[1:])
    return (red / 255.0, green / 255.0, blue / 255.0)
