"""What a demonstration is: an episode of the environment, optimal, with the feedback around it."""

import math
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from demonstration_files import ends_inside

from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.scene import Spread, StateLayout
from experts import BoxDDP, generate_demonstrations
from experts.demonstrations import Demonstration, Demonstrations, SerialExecutor
from experts.demonstrations.settings import Settings
from experts.problems.arm_problem import ArmProblem


@pytest.mark.slow
def test_each_is_an_episode_of_the_environment_bit_for_bit(whole: Demonstrations):
    env = gymnasium.make("DQSpaceArm-v0", scene=whole.scene)
    for demonstration in (whole[0], whole[7], whole[-1]):
        observation, _ = env.reset(seed=demonstration.seed)
        np.testing.assert_array_equal(env.unwrapped.state, demonstration.states[0])
        np.testing.assert_array_equal(observation, demonstration.observations[0])
        for k, action in enumerate(demonstration.actions):
            observation, reward, terminated, _, info = env.step(action)
            assert reward == demonstration.rewards[k]
            np.testing.assert_array_equal(observation, demonstration.observations[k + 1])
            np.testing.assert_array_equal(env.unwrapped.state, demonstration.states[k + 1])
        assert terminated
        assert info["is_success"]
        assert demonstration.facts["final_errors"] == [info["attitude_error"], info["position_error"]]


def test_no_neighboring_solve_finds_anything_cheaper(whole: Demonstrations):
    """Started from its own controls, the solver has nothing to improve."""
    problem = ArmProblem(whole.scene)
    demonstration = next(d for d in whole if ends_inside(d))
    controls = np.clip(
        demonstration.actions * problem.control_upper, problem.control_lower, problem.control_upper
    )
    solution = BoxDDP(problem).solve(demonstration.states[0], controls)
    assert solution.iterations == 0
    assert solution.converged
    assert solution.cost == pytest.approx(demonstration.cost, rel=1e-9)


def test_gains_are_those_of_the_actions_and_zero_where_an_input_is_at_its_limit(whole: Demonstrations):
    problem = ArmProblem(whole.scene)
    demonstration = max(whole, key=lambda d: d.facts["clamped_share"])
    assert demonstration.feedback_gains.dtype == np.float32
    clamped = np.abs(demonstration.actions) == 1.0
    assert clamped.mean() == demonstration.facts["clamped_share"] > 0.0
    assert not demonstration.feedback_gains[clamped].any()
    assert demonstration.feedback_gains[~clamped].any(axis=1).all()
    controls = demonstration.actions * problem.control_upper
    solution = BoxDDP(problem).solve(demonstration.states[0], controls.clip(-problem.control_upper))
    expected = solution.feedback_gains / problem.control_upper[:, None]
    np.testing.assert_allclose(demonstration.feedback_gains, expected, rtol=1e-3, atol=1e-4)


def test_gains_lead_back_to_the_target(whole: Demonstrations):
    """From a disturbed start the actions alone cost more than with feedback."""
    env = gymnasium.make("DQSpaceArm-v0", scene=whole.scene)
    demonstration = whole[2]
    disturbed = demonstration.states[0].copy()
    disturbed[whole.kernels.layout.state.joint_angles] += 0.05

    def play(feedback: bool) -> float:
        env.reset(options={"initial_state": disturbed})
        rewards = []
        for reference, action, gains in zip(
            demonstration.states[:-1], demonstration.actions, demonstration.feedback_gains, strict=True
        ):
            deviation = whole.tangent(reference, env.unwrapped.state)
            rewards.append(env.step(np.clip(action + feedback * gains @ deviation, -1.0, 1.0))[1])
        return math.fsum(rewards)

    assert play(feedback=True) > play(feedback=False)


def test_problems_have_seeds_of_their_own(quick_scene: Scene):
    settings = Settings.of(quick_scene, 10_000, 0, 32)
    seeds = {settings.problem_seed(problem) for problem in range(10_000)}
    assert len(seeds) == 10_000
    assert all(0 <= seed < 2**63 for seed in seeds)
    other = Settings.of(quick_scene, 1, 1, 32)
    assert other.problem_seed(0) not in seeds
    assert Settings.of(quick_scene, 5, 0, 2).problem_seed(4) == settings.problem_seed(4)


@pytest.mark.slow
def test_another_process_makes_the_same_bytes(whole: Demonstrations, tmp_path: Path):
    scene_file = tmp_path / "scene.yaml"
    whole.scene.to_yaml(scene_file)
    code = (
        "import sys; from experts.demonstrations.settings import Settings\n"
        "from experts.demonstrations.shard import Task, make_shard\n"
        f"print(make_shard(Task(Settings.of({str(scene_file)!r}, 18, 3, 4), 2)).sha256)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == whole.manifest["shards"][2]["sha256"]


def test_single_precision_is_taken_in_double(quick_scene: Scene, tmp_path: Path):
    simulation = {**quick_scene.simulation.model_dump(), "precision": "float32"}
    made = generate_demonstrations(
        quick_scene.replace(simulation=simulation), 1, tmp_path, executor=SerialExecutor()
    )
    assert isinstance(made, Demonstrations)
    assert made.scene.simulation.precision == "float64"
    assert isinstance(made[0], Demonstration)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"n": 0}, "n: 0, should be at least 1"),
        ({"workers": True}, "workers: True, should be a whole number of at least 1"),
        ({"n": True}, "n: True, should be a whole number of at least 1"),
        ({"n": 2.0}, "n: 2.0, should be a whole number of at least 1"),
        ({"seed": -1}, "seed: -1, should be at least 0"),
        ({"seed": 2**63}, r"seed: 9223372036854775808, should be less than 2\*\*63"),
        ({"shard_size": 0}, "shard_size: 0, should be at least 1"),
        ({"shard_size": 2**63}, r"shard_size: 9223372036854775808, should be less than 2\*\*63"),
        ({"part": (3, 2)}, "1 <= i <= k"),
        ({"part": (1.5, 2)}, r"part: \(1.5, 2\), should be \(i, k\), whole numbers"),
        ({"part": 1}, r"part: 1, should be \(i, k\)"),
        ({"part": (1, 2, 3)}, r"part: \(1, 2, 3\), should be \(i, k\)"),
        ({"workers": 0}, "workers: 0, should be at least 1"),
        ({"workers": 2.5}, "workers: 2.5, should be a whole number"),
        ({"scene": load_scene("planar").replace(spread=Spread())}, "would be the same"),
    ],
)
def test_unusable_input_is_refused(changes, sentence: str, quick_scene: Scene, tmp_path: Path):
    arguments = {"scene": quick_scene, "n": 2, "out": tmp_path / "new", **changes}
    with pytest.raises(ValueError, match=sentence):
        generate_demonstrations(**arguments)
    assert not (tmp_path / "new").exists()


@pytest.mark.endurance
def test_idle_thrusters_are_at_a_limit(tmp_path: Path):
    scene = load_scene("thrusters").replace(simulation={"dt": 0.15, "steps": 100})
    (made,) = generate_demonstrations(scene, 1, tmp_path / "jets", executor=SerialExecutor())
    jets = StateLayout.of(scene).control.thruster_force
    clamped = np.abs(made.actions) == 1.0
    clamped[:, jets] |= made.actions[:, jets] == 0.0
    assert clamped[:, jets].mean() > 0.4
    assert made.facts["clamped_share"] == clamped.mean()
