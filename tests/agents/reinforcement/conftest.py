"""The paper's scene, short enough to learn in."""

import pytest

from dq_space_arm_env import load_scene


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "short.yaml"
    load_scene("paper").replace(name="short", simulation={"dt": 0.015, "steps": 40}).to_yaml(path)
    return path
