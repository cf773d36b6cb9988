"""A small scene whose problems are solved in hundredths of a second, and demonstrations of it."""

import shutil
from pathlib import Path

import pytest

from dq_space_arm_env import Scene, load_scene
from experts import generate_demonstrations
from experts.demonstrations import Demonstrations, SerialExecutor

N, SHARD_SIZE, SEED = 18, 4, 3
"""Five shards, the last of them smaller."""


@pytest.fixture(scope="session")
def quick_scene() -> Scene:
    return load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})


@pytest.fixture(scope="session")
def whole(quick_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """A complete data set, which nobody changes."""
    folder = tmp_path_factory.mktemp("demonstrations") / "whole"
    made = generate_demonstrations(
        quick_scene, N, folder, SEED, shard_size=SHARD_SIZE, executor=SerialExecutor()
    )
    assert made is not None
    return made


@pytest.fixture
def folder(whole: Demonstrations, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(whole.path, tmp_path / "copy"))
