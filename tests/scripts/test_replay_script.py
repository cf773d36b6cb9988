"""The script that writes pages: what it takes for flights, and what it refuses."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from agents import ExportedPolicy
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene, compile_scene
from dq_space_arm_env.scene import StateLayout
from experts.replay import Flight, read_recording, save_flight

SCENE = """
name: short
base: {motion: planar, mass: 20, inertia: [1, 1, 1]}
links:
  - name: link
    mass: 2
    inertia: [0.01, 0.05, 0.05]
    center_of_mass: [0.3, 0, 0]
    joint: {position: [0.3, 0, 0]}
tip: {position: [0.6, 0, 0]}
actuators: {base_torque: {limit: 2}, joint_torque: {limit: 0.5}}
target: {pose: {position: [0.6, 0.5, 0], rotation: {axis: [0, 0, 1], angle: 60}}}
simulation: {dt: 0.05, steps: 60}
"""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).parents[2] / "scripts" / "replay.py"
    spec = importlib.util.spec_from_file_location("replay_script", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    from dq_space_arm_env import load_scene

    (tmp_path / "short.yaml").write_text(SCENE)
    return load_scene(tmp_path / "short.yaml")


@pytest.fixture
def rollout(scene: Scene, tmp_path: Path) -> Path:
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (9, 1))
    states[:, layout.state.joint_angles] += np.linspace(0, 1, 9)[:, None]
    flight = Flight("swing", states, np.ones((8, layout.n_u)), noise=np.zeros((8, layout.n_u)))
    save_flight(tmp_path / "swing.npz", flight, scene)
    return tmp_path / "swing.npz"


def save_policy(path: Path, n_obs: int) -> Path:
    """Half of each limit, whatever it observes."""
    weights, biases = (np.zeros((n_obs, 2), np.float32),), (np.full(2, 0.5, np.float32),)
    ExportedPolicy(weights, biases, "relu", np.zeros(n_obs), np.ones(n_obs)).save(path)
    return path


def test_a_rollout_comes_back_as_it_was(rollout: Path, scene: Scene) -> None:
    recording = read_recording(rollout)
    assert recording.scene == scene
    assert recording.flight.label == "swing"
    assert recording.flight.states.shape == (9, StateLayout.of(scene).n_x)
    assert recording.flight.noise is not None
    assert recording.flight.target is None
    assert read_recording(rollout, "other").flight.label == "other"


def test_policy_flies_from_where_the_first_flight_starts(
    script: ModuleType, rollout: Path, scene: Scene, tmp_path: Path
) -> None:
    from agents.replay import fly_recorded

    kernels = compile_scene(scene)
    n_obs = DQSpaceArmVectorEnv(1, scene).reset()[0].shape[1]
    policy = save_policy(tmp_path / "half.npz", n_obs)
    start = read_recording(rollout).flight.states[0]
    flight = fly_recorded(policy, scene, start=start)
    np.testing.assert_allclose(flight.states[0], start, atol=1e-12)
    assert flight.states.shape[0] == 61
    np.testing.assert_allclose(flight.controls, np.tile([1.0, 0.25], (60, 1)))
    step = kernels.step(flight.states[0], flight.controls[0])
    np.testing.assert_allclose(flight.states[1], step, atol=1e-12)
    with pytest.raises(ValueError, match="start and seed exclude each other"):
        fly_recorded(policy, scene, start=start, seed=1)

    out = tmp_path / "page.html"
    assert script.main([f"expert={rollout}", f"agent={policy}", "--out", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    assert '"label":"expert","steps":8' in page
    assert '"label":"agent","steps":60' in page


def test_the_folder_of_a_solution_stands_for_its_file(
    script: ModuleType, rollout: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "solved"
    folder.mkdir()
    rollout.rename(folder / "solution.npz")
    out = tmp_path / "page.html"
    assert script.main([str(folder), f"again={folder}", "--out", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    assert '"label":"swing","steps":8' in page
    assert '"label":"again","steps":8' in page


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.npz"], "there is no such file"),
        (["{folder}/short.yaml"], "cannot be read as a flight"),
        (["{folder}/numbers.npz"], "it lacks controls and states"),
        (["{folder}/half.npz"], "give --scene"),
        (["{folder}/bare.npz"], "name the scene"),
        (["{folder}/facts.npz"], "its facts are no mapping"),
        (["{folder}"], "holds no demonstrations"),
        (["{folder}/swing.npz", "--scene", "paper"], "show them on pages of their own"),
    ],
)
def test_unusable_input_is_one_sentence(
    arguments: list[str],
    sentence: str,
    script: ModuleType,
    rollout: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    np.savez(tmp_path / "numbers.npz", numbers=np.zeros(3))
    save_policy(tmp_path / "half.npz", 5)
    flight = read_recording(rollout).flight
    np.savez(tmp_path / "bare.npz", states=flight.states, controls=flight.controls)
    np.savez(tmp_path / "facts.npz", facts=np.array("[1]"), states=flight.states, controls=flight.controls)
    given = [argument.format(folder=tmp_path) for argument in arguments]
    assert script.main([*given, "--out", str(tmp_path / "page.html")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "page.html").exists()


def test_scenes_may_differ_in_masses_and_target(rollout: Path, scene: Scene) -> None:
    from experts.replay import common_scene

    one = read_recording(rollout)
    heavy = scene.replace(
        base=scene.base.model_dump() | {"mass": 30.0},
        target={"pose": {"position": (0.5, 0.5, 0.0)}},
    )
    flights, shown = common_scene([one, replace(one, scene=heavy)])
    assert shown == scene
    np.testing.assert_allclose(flights[1].target, heavy.target.pose.dual_quaternion)
    slower = scene.replace(simulation=scene.simulation.model_dump() | {"dt": 0.1})
    with pytest.raises(ValueError, match=r"time steps of 0.1 s, the scene 'short' has 0.05 s"):
        common_scene([one, replace(one, scene=slower)])
