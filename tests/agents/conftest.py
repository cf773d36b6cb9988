"""A small scene whose problems are solved in hundredths of a second, and demonstrations of it."""

import pytest

from dq_space_arm_env import Scene, load_scene
from experts import generate_demonstrations
from experts.demonstrations import Demonstrations, SerialExecutor

N, SHARD_SIZE, SEED = 24, 8, 5


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    return load_scene("planar").replace(name="small", simulation={"dt": 0.1, "steps": 150})


@pytest.fixture(scope="session")
def demonstrations(small_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """A complete data set, which nobody changes."""
    folder = tmp_path_factory.mktemp("demonstrations") / "small"
    made = generate_demonstrations(
        small_scene, N, folder, SEED, shard_size=SHARD_SIZE, executor=SerialExecutor()
    )
    assert made is not None
    return made
