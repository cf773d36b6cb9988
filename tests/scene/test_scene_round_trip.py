"""A scene survives its own YAML exactly: shipped scenes, and random valid ones."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dq_space_arm_env.scene import INTEGRATORS, Scene, StateLayout, list_scenes, load_scene
from dq_space_arm_env.validation import dump_yaml, parse_yaml

numbers = st.floats(-1e3, 1e3)
positive = st.floats(1e-6, 1e6)
non_negative = st.floats(0, 1e6)
limits = positive | st.just(math.inf)


def vector(elements: st.SearchStrategy[float], size: int) -> st.SearchStrategy[list[float]]:
    return st.lists(elements, min_size=size, max_size=size)


def one_or(elements: st.SearchStrategy[float], size: int) -> st.SearchStrategy[Any]:
    return elements | vector(elements, size)


@st.composite
def quaternions(draw: st.DrawFn) -> list[float]:
    numbers = draw(vector(st.floats(-1, 1), 4).filter(lambda q: math.hypot(*q) > 1e-3))
    return [number / math.hypot(*numbers) for number in numbers]


@st.composite
def inertias(draw: st.DrawFn) -> Any:
    """Point masses a, b, c on the axes give moments b + c, a + c, a + b: exactly those of rigid bodies."""
    a, b, c = draw(vector(st.floats(1e-3, 1e3), 3))
    if draw(st.booleans()):
        return [b + c, a + c, a + b]
    coupling = 0.5 * draw(st.floats(-1, 1)) * min(a, b)  # point masses at angles in the x-y plane
    return [[b + c, coupling, 0], [coupling, a + c, 0], [0, 0, a + b]]


turns = st.fixed_dictionaries({"axis": vector(st.floats(1, 2), 3), "angle": st.floats(-720, 720)})
poses: st.SearchStrategy[dict[str, Any]] = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"position": vector(numbers, 3), "rotation": quaternions()}),
    st.fixed_dictionaries({"rotation": turns}),
)
sizes = st.floats(1e-6, 1e6)
colors = st.sampled_from([None, "foil", "teal", "#0a1B2c"])
solids = st.fixed_dictionaries({"box": vector(sizes, 3)}) | st.fixed_dictionaries(
    {"cylinder": st.fixed_dictionaries({"radius": sizes, "length": sizes})}
)
shapes = st.lists(
    st.builds(lambda solid, pose, color: {**solid, "pose": pose, "color": color}, solids, poses, colors),
    max_size=2,
)
bodies = {"mass": positive, "inertia": inertias(), "center_of_mass": vector(numbers, 3), "geometry": shapes}


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    n = draw(st.integers(0, 4))
    wrist, motors = draw(st.booleans()), n > 0 and draw(st.booleans())
    link = bodies | {
        "joint": poses,
        "stiffness": non_negative,
        "rest_angle": numbers,
        "damping": non_negative,
    }
    if motors:
        link["torque_limit"] = limits
        link["torque_weight"] = positive
    actuators: dict[str, st.SearchStrategy[Any]] = {}
    for kind in ("base_force", "base_torque"):
        if draw(st.booleans()):
            actuators[kind] = st.fixed_dictionaries({"limit": one_or(limits, 3)})
    if motors:
        actuators["joint_torque"] = st.fixed_dictionaries({"limit": limits})
    if wrist:
        actuators["wrist_rate"] = st.fixed_dictionaries({"limit": one_or(limits, 3)})
    scene: dict[str, st.SearchStrategy[Any]] = {
        "name": st.text(st.characters(exclude_categories=("C", "Zl", "Zp")), min_size=1, max_size=8),
        "description": st.text(max_size=20),
        "base": st.fixed_dictionaries({"mass": positive, "inertia": inertias(), "geometry": shapes}),
        "links": st.tuples(*[st.fixed_dictionaries(link | {"name": st.just(f"link {i}")}) for i in range(n)]),
        "tip": poses,
        "actuators": st.fixed_dictionaries(actuators),
        "target": st.fixed_dictionaries(
            {"pose": poses, "base_velocity": vector(numbers, 6), "geometry": shapes}
        ),
        "cost": st.fixed_dictionaries({"pose": one_or(non_negative, 8), "base_torque": one_or(positive, 3)}),
        "initial_state": st.fixed_dictionaries(
            {
                "base_pose": poses,
                "joint_angles": vector(numbers, n),
                "wrist_angles": vector(numbers, 3 if wrist else 0),
                "base_velocity": vector(numbers, 6),
                "joint_rates": vector(numbers, n),
            }
        ),
        "spread": st.fixed_dictionaries({"base_rotation": non_negative, "base_position": non_negative}),
        "success": st.fixed_dictionaries({"position_error": positive}),
        "simulation": st.fixed_dictionaries(
            {"dt": positive, "steps": st.integers(1, 10**6), "integrator": st.sampled_from([*INTEGRATORS])}
        ),
        "tip_wrench": st.none() | st.fixed_dictionaries({"force": vector(numbers, 3)}),
    }
    if wrist:
        scene["wrist"] = st.fixed_dictionaries({"frame": poses})
    else:
        scene["payload"] = st.none() | st.fixed_dictionaries(bodies)
    return draw(st.fixed_dictionaries(scene))


@pytest.mark.parametrize("name", list_scenes())
def test_shipped_scenes(name: str, tmp_path: Path) -> None:
    scene = load_scene(name)
    path = tmp_path / "copy.yaml"
    scene.to_yaml(path)
    again = load_scene(path)
    assert again == scene
    assert hash(again) == hash(scene)
    assert again.content_hash() == scene.content_hash()
    assert load_scene(json.loads(json.dumps(scene.model_dump(mode="json", exclude_none=True)))) == scene


@pytest.mark.parametrize("gap", ["  ", "\t", "\n\t", "\x85", "\u2028", " \ufeff", "\r"])
def test_descriptions_keep_what_stands_where_lines_end(gap: str) -> None:
    for text in (gap, *(f"{'x' * size}{gap}one two three" for size in range(60, 130))):
        assert parse_yaml(dump_yaml({"description": text})) == {"description": text}


@pytest.mark.slow
@settings(derandomize=True, max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=scenes())
def test_random_scenes(data: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> None:
    scene = Scene.model_validate(data)
    path = tmp_path_factory.mktemp("random") / "scene.yaml"
    scene.to_yaml(path)
    again = load_scene(path)
    assert again == scene
    assert again.content_hash() == scene.content_hash()
    assert Scene.model_validate(scene.model_dump()) == scene
    layout = StateLayout.of(scene)
    assert layout.n_x == layout.n_t + 2 == layout.initial_state.size
    assert layout.n_u == layout.control_limit.size == layout.control_weight.size
