"""Other engines: the same robot, left out with a sentence where it cannot be had."""

import dataclasses
import sys

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.common.host_machine import processors
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from experts.report.part_costs import moving_states
from scripts.benchmarks import devices
from scripts.benchmarks.basilisk import BENCHMARK
from scripts.benchmarks.effort import QUICK, Sampling
from scripts.benchmarks.harness import select
from scripts.benchmarks.peers import peers_of
from scripts.benchmarks.peers.mujoco_peer import MujocoPeer, mujoco_spec, robot_xml
from scripts.benchmarks.subjects import COMPARED_INTEGRATORS


@pytest.mark.parametrize("package", ["pinocchio", "mujoco"])
@pytest.mark.parametrize("name", ["paper", "planar", "payload"])
def test_peer_has_the_same_accelerations(package: str, name: str) -> None:
    # Eq. (22); also of a planar base and of merged bodies.
    pytest.importorskip(package)
    kernels = compile_scene(load_scene(name))
    x, u = moving_states(kernels, 16)
    (peer,) = (peer for peer in peers_of(kernels)[0] if peer.name.lower() == package)
    ours, theirs = kernels.forward_dynamics(x, u), peer.accelerations(x, u)
    error = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert error.max() < 1e-11


@pytest.fixture
def mujoco_twin(short_scene: Scene) -> MujocoPeer:
    pytest.importorskip("mujoco")
    return MujocoPeer(compile_scene(short_scene), KinematicTree.from_scene(short_scene))


@pytest.mark.parametrize("name", COMPARED_INTEGRATORS)
def test_mujoco_takes_the_same_steps(mujoco_twin: MujocoPeer, short_scene: Scene, name: str) -> None:
    kernels = compile_scene(short_scene)
    x, _ = moving_states(kernels, 8)
    theirs = mujoco_twin.end_angles(x, name, 20)
    for _ in range(20):
        x = kernels.step(x, np.zeros((8, kernels.n_u)), integrator=name)
    # Both integrate the joints with the same formulas; of the base's turn MuJoCo's RK4 makes a quaternion.
    assert theirs == pytest.approx(x[:, kernels.layout.state.joint_angles], rel=1e-9)


def test_mujoco_environment_takes_our_steps(mujoco_twin: MujocoPeer, short_scene: Scene) -> None:
    limits = np.array([0.0, 0.0, 2.0, 0.5])  # no thrusters; torques of base and joint
    spec = mujoco_spec(mujoco_twin.models["rk4"], np.zeros(4), limits, 60)
    env = gymnasium.make(spec)
    before, _ = env.reset(seed=0)
    action = np.array([0.7, -0.3, 0.5, -0.25], dtype=np.float32)
    after, reward, terminated, truncated, info = env.step(action)
    # qpos: x, y, turn, joint; qvel: their rates. At turn 0 base axes are inertial axes.
    kernels = compile_scene(short_scene)
    state = kernels.layout.state
    x = kernels.layout.initial_state.copy()
    x[state.base_velocity] = before[[6, 4, 5]]
    x[state.joint_rates] = before[7:]
    x = kernels.step(x, limits[2:] * action[2:], integrator="rk4")
    assert after[3:4] == pytest.approx(x[state.joint_angles], rel=1e-12)
    assert after[7:] == pytest.approx(x[state.joint_rates], rel=1e-12)
    assert reward == pytest.approx(-(after @ after + float(action @ action)))
    assert (terminated, truncated, info) == (False, False, {})
    assert env.observation_space.contains(after)
    kept = after.copy()
    assert [env.step(action)[2] for _ in range(59)] == [False] * 58 + [True]
    assert np.array_equal(after, kept)  # an array that later steps leave alone


def test_missing_engines_and_unsuitable_scenes_leave_a_note(
    short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    peers, notes = peers_of(compile_scene("tip-load"))
    assert not peers
    assert "wrench" in notes[0]
    for name in ("pinocchio", "mujoco"):
        monkeypatch.setitem(sys.modules, name, None)
    peers, notes = peers_of(compile_scene(short_scene))
    assert not peers
    assert ["pip install pin)" in notes[0], "pip install mujoco)" in notes[1]] == [True, True]


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("capture-and-detumble", "a payload that is caught"),
        ("heavy-wrist", "joints that slide or turn about several axes"),
        ("motors", "motors"),
        ("sliding", "joints that slide or turn about several axes"),
        ("thrusters", "thrusters"),
        ("wheels", "wheels"),
    ],
)
def test_engines_that_would_move_another_robot_are_left_out(name: str, more: str) -> None:
    sentence = f"Scene {name} has no peers: they are not given {more}."
    assert peers_of(compile_scene(name)) == ([], [sentence])


def test_without_basilisk_its_benchmark_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "Basilisk", None)
    (row,) = BENCHMARK.measure(QUICK)
    assert row["table"] == "notes"
    assert "Basilisk not installed (pip install bsk" in row["note"]


def test_without_jax_devices_are_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jax", None)
    (row,) = devices.BENCHMARK.measure(QUICK)
    assert "JAX is not installed (pip install jax" in row["note"]


@pytest.mark.endurance  # XLA compiles four functions
def test_a_device_is_compared_with_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("jax")
    monkeypatch.setitem(devices.BATCHES, "cpu", (8,))
    effort = dataclasses.replace(QUICK, scenes=("planar",), kernel_timing=Sampling(1, 1e-4))
    rows = list(devices.BENCHMARK.measure(effort))
    assert len(select(rows, table="devices", engine="XLA")) == len(select(rows, status="handled")) == 4
    assert all(row["way"] == "cpu" and row["error"] < 1e-12 for row in select(rows, engine="XLA"))
    assert {row["threads"] for row in select(rows, engine="XLA")} == {processors()}  # ours is on one core


def test_mujoco_leaves_out_springs_and_dampers_only_where_there_are_none() -> None:
    scene = load_scene("paper")
    xml = robot_xml(KinematicTree.from_scene(scene), 0.01, "RK4")
    assert 'spring="disable"' in xml
    first = scene.links[0].model_copy(update={"stiffness": 3.0, "rest_angle": 0.25})
    xml = robot_xml(KinematicTree.from_scene(scene.replace(links=(first, *scene.links[1:]))), 0.01, "RK4")
    assert 'spring="disable"' not in xml
    assert 'damper="disable"' in xml
    assert 'stiffness="3.0" springref="0.25"' in xml
