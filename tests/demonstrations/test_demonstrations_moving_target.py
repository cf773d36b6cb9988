"""Demonstrations of a target that moves: recorded with its path, verified, and read back from Minari."""

from pathlib import Path

import numpy as np
import pytest

from dq_space_arm_env import Scene
from dq_space_arm_env.viewing.replay.flight_files import read_flight
from experts import generate_demonstrations
from experts.demonstrations import (
    Demonstrations,
    SerialExecutor,
    export_to_lerobot,
    export_to_minari,
    load_demonstrations,
)

pytestmark = pytest.mark.slow

COUNT = 5


@pytest.fixture(scope="module")
def scene(quick_scene: Scene) -> Scene:
    motion = {"kind": "screw", "angular_velocity": [0, 0, 0.03], "linear_velocity": [0.02, -0.01, 0]}
    return quick_scene.replace(
        {
            "name": "quick-tracking",
            "target.motion": motion,
            "target.grasp": {"position": [0.1, 0.2, 0.0], "rotation": {"axis": [0, 0, 1], "angle": 20}},
            "cost.terminal_tip_twist": 100.0,
            "spread.target_angular_velocity": 0.01,
            "spread.target_linear_velocity": 0.01,
            "success.velocity_error": 0.1,
        }
    )


@pytest.fixture(scope="module")
def made(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    folder = tmp_path_factory.mktemp("demonstrations") / "moving"
    generate_demonstrations(scene, COUNT, folder, 3, shard_size=2, executor=SerialExecutor())
    return load_demonstrations(folder, verify=True)


def test_observations_are_those_of_states_and_stages(made: Demonstrations) -> None:
    kernels, steps = made.kernels, made.scene.simulation.steps
    assert len(made) == COUNT
    drawn = np.array([demonstration.parameters for demonstration in made])
    assert np.ptp(drawn[:, -3:], axis=0).min() > 1e-3
    left = made.scene.simulation.dt * (steps - np.arange(steps + 1.0))[:, None]
    for demonstration in made:
        rows = kernels.stage_parameters(demonstration.parameters)
        seen = kernels.observation(np.array(demonstration.states), left, p=rows)[0]
        np.testing.assert_allclose(demonstration.observations, seen, rtol=0, atol=1e-12)


def test_batches_hold_the_parameters_of_their_stages(made: Demonstrations) -> None:
    names = ("states", "observations", "parameters")
    (batch,) = made.batches(COUNT * made.scene.simulation.steps, names)
    rows = [made.kernels.stage_parameters(each.parameters)[:-1] for each in made]
    np.testing.assert_array_equal(batch.arrays["parameters"], np.concatenate(rows))
    for mixed in made.batches(64, names, seed=1):
        found = mixed.arrays
        again = made.kernels.state_from_observation(found["observations"], p=found["parameters"])
        np.testing.assert_allclose(again, found["states"], rtol=0, atol=1e-12)


def test_a_demonstration_is_shown_with_the_path_of_its_target(made: Demonstrations) -> None:
    flight, layout = read_flight(f"{made.path}#2"), made.kernels.layout
    rows = made.kernels.stage_parameters(made[2].parameters)
    np.testing.assert_array_equal(flight.target, layout.target_with(rows))
    np.testing.assert_array_equal(flight.target_body, layout.target_body_with(rows))


def test_minari_holds_the_stages_and_gives_the_demonstrations_back(
    made: Demonstrations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    reading = pytest.importorskip("agents.minari_reading")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    name = "space-arm/moving/expert-v0"
    export_to_minari(made, name)
    dataset = minari.load_dataset(name)
    for episode, demonstration in zip(dataset.iterate_episodes(), made, strict=True):
        rows = made.kernels.stage_parameters(demonstration.parameters)
        np.testing.assert_array_equal(episode.infos["parameters"], rows)
        assert episode.infos["is_success"][-1]
        assert dataset.observation_space.contains(episode.observations[-1])
    read = reading.read_from_minari(name, tmp_path / "read")
    assert read.scene == made.scene
    for found, expected in zip(read, made, strict=True):
        np.testing.assert_array_equal(found.parameters, expected.parameters)
        np.testing.assert_array_equal(found.states, expected.states)
        np.testing.assert_array_equal(found.observations, expected.observations)
        np.testing.assert_array_equal(found.feedback_gains, expected.feedback_gains)


def test_lerobot_holds_the_parameters_of_the_stages(made: Demonstrations, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(export_to_lerobot(made, tmp_path / "moving") / "data")
    rows = [made.kernels.stage_parameters(each.parameters)[:-1] for each in made]
    np.testing.assert_array_equal(np.array(table["parameters"].to_pylist()), np.concatenate(rows))
