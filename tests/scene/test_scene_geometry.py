"""Shapes of bodies: they survive YAML, change no content, and mistakes in them are named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dq_space_arm_env.command_line.scene_template import commented_yaml
from dq_space_arm_env.scene import Cylinder, Scene, Shape, list_scenes, load_scene

Change = Callable[..., dict[str, Any]]
Refusals = Callable[[dict[str, Any]], list[str]]

NAN = float("nan")
CUBE = {"box": [1, 1, 1]}
SHAPES: list[dict[str, Any]] = [
    {"box": [1, 0.5, 0.2], "color": "cells"},
    {
        "cylinder": {"radius": 0.1, "length": 2},
        "pose": {"position": [0, 0, 1], "rotation": {"axis": [1, 0, 0], "angle": 30}},
        "color": "#1A2b3C",
    },
]
BODIES = ("base", "links.0", "links.1", "payload", "target")


@pytest.fixture
def drawn(data: dict[str, Any], change: Change) -> Scene:
    """A scene in which every body has two shapes."""
    change(data, "wrist")
    change(data, "actuators.wrist_rate")
    change(data, "payload", {"mass": 5, "inertia": [1, 1, 1]})
    for body in BODIES:
        change(data, f"{body}.geometry", SHAPES)
    return Scene.model_validate(data)


def bare(scene: Scene) -> Scene:
    return scene.replace({f"{body}.geometry": [] for body in BODIES})


def test_shapes_survive_yaml(drawn: Scene, tmp_path: Path) -> None:
    assert drawn.base.geometry[0] == Shape(box=(1.0, 0.5, 0.2), color="cells")
    assert drawn.target.geometry[1].cylinder == Cylinder(radius=0.1, length=2.0)
    assert drawn.links[1].geometry[1].color == "#1a2b3c"
    path = tmp_path / "scene.yaml"
    drawn.to_yaml(path)
    assert load_scene(path) == drawn
    path.write_text(commented_yaml(drawn), encoding="utf-8")
    assert load_scene(path) == drawn
    assert Scene.model_validate(drawn.model_dump()) == drawn
    assert len({drawn, Scene.model_validate(drawn.model_dump())}) == 1


def test_they_are_no_content_and_absent_where_there_are_none(drawn: Scene) -> None:
    """Nothing that follows from a scene, no machine code, no data set, depends on its looks."""
    plain = bare(drawn)
    assert plain != drawn
    assert plain.content_hash() == drawn.content_hash()
    assert "geometry" not in plain.to_yaml()
    assert drawn.to_yaml().count("geometry:") == len(BODIES)
    assert drawn.replace({"base.mass": 3.0}).content_hash() != drawn.content_hash()


def test_hashes_and_files_of_scenes_without_them_are_as_old_as_the_scenes() -> None:
    assert load_scene("paper").content_hash() == (
        "00c7f1939550ce9bb98c79cbbbf75369abecf77800cac4d08bb71fb2ec370d27"
    )
    with_shapes = [name for name in list_scenes() if "geometry:" in load_scene(name).to_yaml()]
    assert with_shapes == [
        "approach-corridor",
        "capture-and-detumble",
        "dual-arm",
        "plume",
        "release",
        "servicing",
        "sliding",
        "solar-panels",
        "tracking",
        "tumbling-target",
    ]


def test_one_shape_changes_by_its_path(drawn: Scene) -> None:
    changed = drawn.replace({"target.geometry.0.color": "teal"})
    assert [shape.color for shape in changed.target.geometry] == ["teal", "#1a2b3c"]
    assert changed.target.geometry[0].box == (1.0, 0.5, 0.2)


@pytest.mark.parametrize(
    ("shape", "field", "what"),
    [
        ({"box": [1, NAN, 1]}, ".box = ", "3 finite numbers (edge lengths of a box"),
        ({"box": [1, -1, 1]}, ".box = [1, -1, 1]", "each greater than 0"),
        ({"box": [1, 0, 1]}, ".box = ", "each greater than 0"),
        ({"box": [1, 1]}, ".box = ", "3 finite numbers; it has 2"),
        ({"box": [1, 1, 1e9]}, ".box = ", "at most 1e+06"),
        ({"cylinder": {"radius": -1, "length": 1}}, ".cylinder.radius = -1", "greater than 0 (radius"),
        (
            {"cylinder": {"radius": 1, "length": NAN}},
            ".cylinder.length = nan",
            "finite number greater than 0",
        ),
        ({"cylinder": {"radius": 1}}, ".cylinder.length: missing", "length of the cylinder along z, m"),
        ({"cylinder": [1, 1]}, ".cylinder = [1, 1]", "must be a mapping"),
        ({"cylindre": {"radius": 1}}, ".cylindre: unknown key", "did you mean 'cylinder'?"),
        ({}, " = {}", "must have box: [x, y, z] or cylinder: {radius, length}, m"),
        ({**CUBE, "cylinder": {"radius": 1, "length": 1}}, ".cylinder = ", "remove it, or remove box"),
        ({**CUBE, "color": "foyl"}, ".color = 'foyl'", "did you mean 'foil'?"),
        ({**CUBE, "color": "#12345"}, ".color = '#12345'", 'a name or "#rrggbb"'),
        ({**CUBE, "color": 0x123456}, ".color = 1193046", "unknown color"),
        ({**CUBE, "pose": {"position": [1]}}, ".pose.position = [1]", "3 finite numbers; it has 1"),
    ],
)
@pytest.mark.parametrize("body", ["base", "links.1", "target"])
def test_one_mistake_gives_one_sentence(
    data: dict[str, Any],
    change: Change,
    refusals: Refusals,
    body: str,
    shape: dict[str, Any],
    field: str,
    what: str,
) -> None:
    (sentence,) = refusals(change(data, f"{body}.geometry", [CUBE, shape]))
    assert sentence.startswith(f"{body.replace('.1', '[1]')}.geometry[1]{field}")
    assert what in sentence


def test_geometry_is_a_list(data: dict[str, Any], change: Change, refusals: Refusals) -> None:
    (sentence,) = refusals(change(data, "base.geometry", CUBE))
    assert sentence.startswith("base.geometry = {box: [1, 1, 1]}: must be a list (shapes that pictures draw")
