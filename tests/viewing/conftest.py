"""Made-up motions of any scene, which need neither solver nor simulation; and a browser."""

from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
import pytest

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.start import unit_quaternions
from dq_space_arm_env.viewing.replay import Trajectory

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def make_flight() -> Callable[..., Trajectory]:
    def make(scene: Scene, label: str = "expert", steps: int = 60, sway: float = 0.5) -> Trajectory:
        layout = StateLayout.of(scene)
        states = np.tile(layout.initial_state, (steps + 1, 1))
        share = np.linspace(0.0, 1.0, steps + 1)[:, None]
        joints = layout.state.joint_angles
        states[:, joints] += sway * np.sin(3.0 * share + np.arange(joints.stop - joints.start))
        for where in unit_quaternions(scene):
            states[:, where] /= np.linalg.norm(states[:, where], axis=1, keepdims=True)
        limit = np.minimum(layout.control_limit, 10.0)
        controls = limit * np.cos(5.0 * share[:-1] + np.arange(layout.n_u))
        return Trajectory(label, states, controls)

    return make


@pytest.fixture(scope="session")
def paper() -> Scene:
    return load_scene("paper")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A real browser without a window; the tests are skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next((found for name in BROWSERS if (found := which(name))), None)
    if path is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    with playwright.sync_playwright() as engine:
        instance = engine.chromium.launch(executable_path=Path(path))
        yield instance
        instance.close()
