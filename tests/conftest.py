"""Shared by all tests: paths of helper modules, signals as a terminal sends them, and a short scene."""

import signal
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from dq_space_arm_env import Scene, list_scenes

sys.path.append(str(Path(__file__).parent / "compiler"))

# A shell that runs the tests in the background lets all its processes ignore Ctrl-C, which some tests press.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Shipped scenes that have nearly all parts between them; other joints, and jets, have tests of their own.
IN_CI = (
    "capture-and-detumble",
    "dual-arm",
    "elastic-joints",
    "paper",
    "planar",
    "random-masses",
    "servicing",
    "wheels",
)


@pytest.hookimpl(tryfirst=True)  # before slow ones are left out
def pytest_collection_modifyitems(items: list[pytest.Function]) -> None:
    """Of the cases of tests with the mark `sampled`, leave out scenes not `IN_CI`; all but one are slow.

    With `sampled(scenes="all")` no scene is left out.
    """
    families: dict[str, list[pytest.Function]] = defaultdict(list)
    left_out = {*list_scenes()}.difference(IN_CI)
    for item in items:
        if not (mark := item.get_closest_marker("sampled")):
            continue
        cases = item.callspec.params.values() if hasattr(item, "callspec") else ()
        scenes = {str(getattr(each, "scene", getattr(each, "name", each))) for each in cases}
        if scenes & left_out and mark.kwargs.get("scenes") != "all":
            item.add_marker(pytest.mark.endurance)
        elif not item.get_closest_marker("slow"):
            families[item.nodeid.partition("[")[0]].append(item)
    for cases in families.values():
        sample = next((case for case in cases if "paper" in case.name.partition("[")[2]), cases[0])
        for case in cases:
            if case is not sample:
                case.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def short_scene() -> Scene:
    """A scene that compiles and solves in seconds: planar, wheels and one joint, no thrusters, no wrist."""
    return Scene.model_validate(
        {
            "name": "short",
            "base": {"motion": "planar", "mass": 20, "inertia": [1, 1, 1]},
            "links": [
                {
                    "name": "link",
                    "mass": 2,
                    "inertia": [0.01, 0.05, 0.05],
                    "center_of_mass": [0.3, 0, 0],
                    "joint": {"position": [0.3, 0, 0]},
                }
            ],
            "tip": {"position": [0.6, 0, 0]},
            "actuators": {"base_torque": {"limit": 2}, "joint_torque": {"limit": 0.5}},
            "target": {"pose": {"position": [0.6, 0.5, 0], "rotation": {"axis": [0, 0, 1], "angle": 60}}},
            "simulation": {"dt": 0.05, "steps": 60},
        }
    )


@pytest.fixture(scope="session")
def spread_scene(short_scene: Scene) -> Scene:
    """With random starts; its kernels are the same."""
    return short_scene.replace(spread={"joint_angles": 0.5, "base_position": 0.1, "base_rotation": 0.1})
