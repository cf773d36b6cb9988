"""Mutated files are accepted and work, or are refused in a sentence, within 2 s and 500 MB."""

import contextlib
import os
import random
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

pytest.importorskip("resource")

from dq_space_arm_env.scene import Scene, SceneError, load_scene
from tests.reliability.fuzzed_agents import AGENTS
from tests.reliability.fuzzed_files import Outcome, in_yaml, judge
from tests.reliability.fuzzed_subjects import SUBJECTS

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="readers are judged in a fork")

ALL = {**SUBJECTS, **AGENTS}
FEW, MANY = 60, 10_000


def report(name: str, outcome: Outcome) -> None:
    """Print a line of the table of this suite, below the names of the tests."""
    numbers = f"{outcome.tried:6,} tried {outcome.accepted:6,} accepted {outcome.refused:6,} refused"
    costs = f"slowest {outcome.slowest:.2f} s, {outcome.memory:.0f} MB"
    sys.__stdout__.write(f"\n{name:24} {numbers} {len(outcome.failures):4} failed; {costs}\n")


def check(name: str, seeds: range, folder: Path) -> None:
    outcome = judge(ALL[name](folder), list(seeds), folder)
    if len(seeds) > FEW:
        report(name, outcome)
    assert not outcome.failures, f"{len(outcome.failures)} failures\n" + "\n".join(outcome.failures[:30])
    assert outcome.accepted + outcome.refused == outcome.tried
    assert outcome.refused


@pytest.mark.sampled
@pytest.mark.agents
@pytest.mark.parametrize("name", ALL)
def test_a_few_mutations(name: str, tmp_path: Path) -> None:
    check(name, range(FEW), tmp_path)


@pytest.mark.endurance
@pytest.mark.parametrize("name", ALL)
def test_many_mutations(name: str, tmp_path: Path) -> None:
    check(name, range(1_000, 1_000 + int(os.environ.get("MUTATIONS", MANY))), tmp_path)


def accepted_scenes(count: int, file: Path) -> list[Scene]:
    """Mutations of a scene that its reader takes."""
    good, found, seed = load_scene("planar").to_yaml().encode(), [], 0
    while len(found) < count:
        seed += 1
        file.write_bytes(in_yaml(good, random.Random(seed)))
        with contextlib.suppress(SceneError):
            found.append(load_scene(file))
    return found


def fly(scene: Scene) -> bool:
    """Fly some steps; False if the environment refuses the scene in a sentence."""
    try:
        env = gymnasium.make("DQSpaceArm-v0", scene=scene)
    except ValueError:
        return False
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        assert np.isfinite(observation).all(), scene.model_dump()
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    assert np.isfinite(observation).all(), scene.model_dump()
    assert np.isfinite(reward) or info["diverged"], scene.model_dump()
    env.close()
    return True


@pytest.mark.endurance
def test_accepted_scenes_fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path))
    count = int(os.environ.get("MUTATIONS", MANY)) // 20
    scenes = accepted_scenes(count, tmp_path / "scene.yaml")
    flown = sum(map(fly, scenes))
    sys.__stdout__.write(f"\n{len(scenes)} accepted scenes, {flown} flown\n")
    assert flown > 0.9 * len(scenes)
