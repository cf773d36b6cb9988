"""A scene whose problems are solved in hundredths of a second, its cache, and counted executors."""

import math

import pytest

from dq_space_arm_env import Scene, load_scene
from experts.demonstrations import SerialExecutor


@pytest.fixture(scope="session")
def quick() -> Scene:
    return load_scene("planar").replace(name="quick", simulation={"dt": 0.1, "steps": 150})


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty cache of results."""
    monkeypatch.setattr("agents.evaluation.kept_results.cache_directory", lambda: tmp_path)
    return tmp_path


class CountingExecutor:
    """Counts its tasks; interrupted after `limit` of them."""

    def __init__(self, limit=math.inf):
        self.tasks, self.limit = 0, limit

    def run(self, tasks):
        for result in SerialExecutor().run(tasks):
            if self.tasks == self.limit:
                raise KeyboardInterrupt
            self.tasks += 1
            yield result


@pytest.fixture
def counting():
    return CountingExecutor
