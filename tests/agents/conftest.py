"""A small scene whose problems are solved in hundredths of a second, and demonstrations of it."""

import errno
import io
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dq_space_arm_env import Scene, load_scene
from experts import generate_demonstrations
from experts.demonstrations import Demonstrations, SerialExecutor

N, SHARD_SIZE, SEED = 24, 8, 5
ROOT = Path(__file__).parents[2]
HIDE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


@pytest.fixture(scope="session")
def run_without():
    """Run code in a process that cannot import some packages."""

    def run(packages, code, *arguments):
        command = [sys.executable, "-c", HIDE.format(packages=packages) + code, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)

    return run


class FullDisk(io.StringIO):
    """Output to a disk without room."""

    def write(self, text: str) -> int:
        if text:
            raise OSError(errno.ENOSPC, "No space left on device")
        return 0


@pytest.fixture
def fill_output(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A function, to be called in the test itself, after which nothing can be printed."""
    return lambda: monkeypatch.setattr("sys.stdout", FullDisk())


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    return load_scene("planar").replace(name="small", simulation={"dt": 0.1, "steps": 150})


@pytest.fixture(scope="session")
def small_file(small_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.yaml"
    small_scene.to_yaml(path)
    return path


@pytest.fixture(scope="session")
def demonstrations(small_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """A complete data set, which nobody changes."""
    folder = tmp_path_factory.mktemp("demonstrations") / "small"
    made = generate_demonstrations(
        small_scene, N, folder, SEED, shard_size=SHARD_SIZE, executor=SerialExecutor()
    )
    assert made is not None
    return made


@pytest.fixture(scope="session")
def drawn(small_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """Demonstrations with a target and masses of their own, which nobody changes."""
    spread = {"target_rotation": 0.2, "target_position": 0.15, "base_mass": 0.1, "link_masses": 0.1}
    scene = small_scene.replace(name="drawing", spread=spread)
    folder = tmp_path_factory.mktemp("demonstrations") / "drawn"
    made = generate_demonstrations(scene, 6, folder, SEED, executor=SerialExecutor())
    assert made is not None
    return made


@pytest.fixture(scope="session", params=["target", "masses"])
def staged(
    request: pytest.FixtureRequest, small_scene: Scene, tmp_path_factory: pytest.TempPathFactory
) -> Demonstrations:
    """Demonstrations in which a target moves, or the base becomes lighter, from stage to stage."""
    changes = {
        "target": {
            "target.motion": {"kind": "screw", "angular_velocity": [0, 0, 0.02]},
            "spread": {"target_angular_velocity": 0.02, "target_linear_velocity": 0.02},
        },
        "masses": {
            "spread": {"base_position": 0.1},
            "phases": [
                {"name": "full", "steps": 70},
                {"name": "light", "steps": 80, "changes": {"base.mass": 60}},
            ],
        },
    }[request.param]
    folder = tmp_path_factory.mktemp("demonstrations") / "staged"
    scene = small_scene.replace({"name": "staged", **changes})
    made = generate_demonstrations(scene, 3, folder, SEED, executor=SerialExecutor())
    assert made is not None
    return made


@pytest.fixture(scope="module", autouse=True)
def results_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache of evaluations for each file of tests; compiled kernels stay in theirs."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.evaluation.kept_results.cache_directory", lambda: folder)
        yield folder
