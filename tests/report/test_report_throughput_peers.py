"""Other engines: the same robot, left out with a sentence where it cannot be had."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.dynamics.chain import Chain
from experts.report.integrators import COMPARED_INTEGRATORS
from experts.report.throughput import mujoco_peer
from experts.report.throughput.kernels import sample_states
from experts.report.throughput.mujoco_environment import mujoco_spec
from experts.report.throughput.mujoco_peer import MujocoPeer, robot_xml
from experts.report.throughput.peers import peers_of
from experts.report.throughput.timing import ENVIRONMENT, STEP


@pytest.mark.parametrize("package", ["pinocchio", "mujoco"])
@pytest.mark.parametrize("name", ["paper", "planar", "payload"])
def test_peer_has_the_same_accelerations(package: str, name: str) -> None:
    # Eq. (22); also of a planar base and of merged bodies.
    pytest.importorskip(package)
    kernels = compile_scene(load_scene(name))
    x, u = sample_states(kernels, 16)
    (peer,) = (peer for peer in peers_of(kernels)[0] if peer.name.lower() == package)
    ours, theirs = kernels.forward_dynamics(x, u), peer.accelerations(x, u)
    error = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert error.max() < 1e-11


@pytest.fixture
def mujoco_twin(short_scene: Scene) -> MujocoPeer:
    pytest.importorskip("mujoco")
    return MujocoPeer(compile_scene(short_scene), Chain.from_scene(short_scene))


@pytest.mark.parametrize("name", COMPARED_INTEGRATORS)
def test_mujoco_takes_the_same_steps(mujoco_twin: MujocoPeer, short_scene: Scene, name: str) -> None:
    kernels = compile_scene(short_scene)
    x, _ = sample_states(kernels, 8)
    theirs = mujoco_twin.end_angles(x, name, 20)
    for _ in range(20):
        x = kernels.step(x, np.zeros((8, kernels.n_u)), integrator=name)
    # Both integrate the joints with the same formulas; of the base's turn MuJoCo's RK4 makes a quaternion.
    assert theirs == pytest.approx(x[:, kernels.layout.state.joint_angles], rel=1e-9)


def test_mujoco_is_timed_in_batches_and_in_gymnasium(mujoco_twin: MujocoPeer, short_scene: Scene) -> None:
    cases = mujoco_twin.cases(*sample_states(compile_scene(short_scene), 4))
    for name in COMPARED_INTEGRATORS:
        rows = [case.subject for case in cases if case.subject.integrator == name]
        modules = {row.way.partition(",")[0] for row in rows if row.what == STEP}
        assert modules == {"rollout"} | ({"batch"} if not mujoco_twin.notes else set())
        assert {row.batch for row in rows if row.what == ENVIRONMENT} == {1, 64}
    for case in cases:
        case.run()


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


def test_mujoco_environment_ends_after_its_steps_and_gives_arrays_of_their_own(
    mujoco_twin: MujocoPeer,
) -> None:
    env = gymnasium.make(mujoco_spec(mujoco_twin.models["rk4"], np.zeros(4), np.ones(4), 3))
    seen = [env.reset(seed=0)[0]]
    ends = []
    for _ in range(3):
        observation, _, terminated, *_ = env.step(np.ones(4, dtype=np.float32))
        seen.append(observation)
        ends.append(terminated)
    assert ends == [False, False, True]
    assert len({row.tobytes() for row in seen}) == 4


def test_engines_that_are_not_installed_are_named(
    short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pinocchio", "mujoco"):
        monkeypatch.setitem(sys.modules, name, None)
    peers, notes = peers_of(compile_scene(short_scene))
    assert not peers
    assert ["pip install pin)" in notes[0], "pip install mujoco)" in notes[1]] == [True, True]


def test_a_mujoco_without_batches_says_so(short_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(__version__="3.0", MjModel=SimpleNamespace(from_xml_string=str))

    def import_module(name: str) -> Any:
        if name == "mujoco.batch":
            raise ModuleNotFoundError(name)
        return fake

    monkeypatch.setattr(mujoco_peer, "import_module", import_module)
    (note,) = MujocoPeer(compile_scene(short_scene), Chain.from_scene(short_scene)).notes
    assert note == "mujoco.batch is left out: MuJoCo 3.0 has no such module."


def test_a_pinocchio_without_batches_says_so(short_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    pinocchio: ModuleType = pytest.importorskip("pinocchio")
    monkeypatch.delattr(pinocchio, "abaInParallel", raising=False)
    kernels = compile_scene(short_scene)
    peers, notes = peers_of(kernels)
    assert notes[0] == "Pinocchio's batches are left out: this build of it has none."
    assert len(peers[0].cases(*sample_states(kernels, 2))) == 1


def test_mujoco_leaves_out_springs_and_dampers_only_where_there_are_none() -> None:
    scene = load_scene("paper")
    xml = robot_xml(Chain.from_scene(scene), 0.01, "RK4")
    assert 'spring="disable"' in xml
    assert 'damper="disable"' in xml
    first = scene.links[0].model_copy(update={"stiffness": 3.0, "rest_angle": 0.25})
    xml = robot_xml(Chain.from_scene(scene.replace(links=(first, *scene.links[1:]))), 0.01, "RK4")
    assert 'spring="disable"' not in xml
    assert 'damper="disable"' in xml
    assert 'stiffness="3.0" springref="0.25"' in xml


def test_peers_are_left_out_with_a_sentence_where_they_cannot_follow() -> None:
    peers, notes = peers_of(compile_scene("tip-load"))
    assert not peers
    assert len(notes) == 1
    assert "wrench" in notes[0]
