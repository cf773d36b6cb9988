"""PPO with a Lagrangian: what violations cost, the price that follows them, and checkpoints of both."""

import json
import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from stable_baselines3.common.vec_env import DummyVecEnv

from agents.configuration import ConfigurationError, load_configuration
from agents.reinforcement.callback import TrainingCallback, _score
from agents.reinforcement.checkpoint import Progress
from agents.reinforcement.lagrangian import Lagrangian
from agents.run_folder import RunFolder, RunFolderError
from agents.training import train
from agents.vec_env import SB3VecEnv
from agents.wrappers.vector import RepeatAction
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmVectorEnv, load_scene

pytestmark = pytest.mark.agents

STEPS, REPEAT, COPIES = 20, 4, 6
LIMITS = {  # within which half of the flights stay
    "kind": "joint_limits",
    "name": "limits",
    "lower": [-0.7, -np.inf, -np.inf],
    "tolerance": 0.15,
}
SCENE = load_scene("paper").replace(
    name="limited", constraints=[LIMITS], simulation={"dt": 0.05, "steps": STEPS}
)


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "limited.yaml"
    SCENE.to_yaml(path)
    return path


def configuration(scene, **algorithm):
    return load_configuration(
        {
            "name": "charged",
            "scene": str(scene),
            "environment": {"copies": COPIES, "action_repeat": REPEAT, "reward_scale": 0.01},
            "network": {"hidden": [8], "activation": "tanh"},
            # Updates in the middle of episodes, which have five decisions.
            "algorithm": {"name": "PPO", "n_steps": 3, "batch_size": 18, "n_epochs": 2, **algorithm},
            "schedule": {
                "total_steps": 8 * COPIES * STEPS,
                "evaluate_every": 2 * COPIES * STEPS,
                "evaluation_episodes": 4,
                "checkpoint_every": 400,
            },
        }
    )


def test_rewards_are_charged_for_the_largest_violation_of_a_decision():
    native = DQSpaceArmVectorEnv(COPIES, SCENE, autoreset_mode=AutoresetMode.SAME_STEP)
    charged = Lagrangian(SB3VecEnv(RepeatAction(native, REPEAT)), limit=0.0, initial=0.7, learning_rate=1.0)
    singles = [DQSpaceArmEnv(SCENE) for _ in range(COPIES)]
    charged.seed(3)
    charged.reset()
    for i, env in enumerate(singles):
        env.reset(seed=3 + i)
    rng, costs, ends = np.random.default_rng(0), [], 0
    violated, violating = np.zeros(COPIES, np.bool_), 0
    for _ in range(3 * STEPS // REPEAT):
        actions = rng.uniform(-1.0, 1.0, (COPIES, 12)).astype(np.float32)
        _, rewards, dones, _ = charged.step(actions)
        for i, env in enumerate(singles):
            flown = [env.step(actions[i]) for _ in range(REPEAT)]
            largest = max(result[4]["cost"] for result in flown)
            expected = (sum(result[1] for result in flown) - 0.7 * math.log(1.0 + largest)) / 1.7
            assert rewards[i] == pytest.approx(expected, rel=1e-6)
            assert dones[i] == flown[-1][2]
            violated[i] |= largest > 1.0
            if dones[i]:
                ends, violating, violated[i] = ends + 1, violating + int(violated[i]), False
                env.reset()
            costs.append(largest)
    assert min(costs) == 0.0
    assert max(costs) > 1.0
    assert any(0.0 < cost < 1.0 for cost in costs)
    charged.ascend()
    assert ends == 3 * COPIES
    assert charged.violating_episodes == violating / ends
    assert 0 < violating < ends


class Scripted(gymnasium.Env):
    """One copy whose decisions have given costs; an episode has two."""

    observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, costs):
        self.costs, self.taken = costs, 0

    @property
    def largest_cost(self):
        return np.array([self.costs[self.taken - 1]])

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.taken += 1
        return np.zeros(1, np.float32), 1.0, self.taken % 2 == 0, False, {}


def test_the_multiplier_follows_the_share_of_violating_episodes():
    costs = [0, 0, 1, 0, 5, 0, 0, 2, *[0] * 6]  # two of the first four episodes violate
    copies = DummyVecEnv([lambda: Scripted(costs)])
    charged = Lagrangian(copies, limit=0.05, initial=0.25, learning_rate=2.0)
    charged.reset()

    def fly(decisions):
        rewards = [charged.step(np.zeros((1, 1)))[1].item() for _ in range(decisions)]
        charged.ascend()
        return rewards

    assert fly(8) == pytest.approx([(1.0 - 0.25 * math.log(1.0 + cost)) / 1.25 for cost in costs[:8]])
    assert charged.violating_episodes == 0.5
    risen = 0.25 * math.exp(2.0 * 0.1)  # the excess of 0.45 counts up to 0.1
    assert charged.multiplier == pytest.approx(risen)
    assert fly(1) == pytest.approx([1.0 / (1.0 + risen)])
    assert charged.multiplier == pytest.approx(risen)  # no episode has ended
    fly(1)
    assert charged.violating_episodes == 0.0
    assert charged.multiplier == pytest.approx(risen * math.exp(-2.0 * 0.05))
    for _ in range(2):
        fly(2)
    assert charged.multiplier == 0.25  # at least the initial one


def kept(path):
    """What the last checkpoint and the learning curve hold, without the times."""
    checkpoint = RunFolder(path, load_configuration(path / "config.yaml")).checkpoint()
    state = json.loads((checkpoint / "state.json").read_text())
    del state["progress"]["seconds"]
    curve = [json.loads(line) for line in (path / "evaluations.jsonl").read_text().splitlines()]
    for line in curve:
        del line["seconds"]
    with np.load(checkpoint / "arrays.npz") as arrays:
        return dict(arrays), (checkpoint / "learner.pth").read_bytes(), state, curve


def test_a_learning_curve_without_what_the_best_policy_is_chosen_by_is_refused(limited, tmp_path):
    settings = configuration(limited, lagrangian={"limit": 0.1})
    folder = RunFolder(tmp_path, settings)
    line = {"environment_steps": 0, "seconds": 1.0, "success_rate": 0.0, "median_cost": 2.0}
    folder.write_evaluations([{**line, "multiplier": 0.1}])
    with pytest.raises(RunFolderError, match=r"lacks a number of .*, multiplier, violating_episodes"):
        TrainingCallback(settings, load_scene(settings.scene), folder, Progress(), print)


def test_a_run_resumes_with_its_multiplier_in_the_middle_of_episodes(limited, tmp_path):
    settings = configuration(limited, lagrangian={"limit": 0.1, "initial": 0.1, "learning_rate": 3.0})

    def kill(advance):
        if advance.environment_steps > 450:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(settings, tmp_path / "run", report=kill)
    arrays, *_ = kept(tmp_path / "run")
    assert arrays["environment.multiplier"][0] > 0.1
    assert 0 < arrays["environment.memory"][0, 0] < STEPS  # steps taken of the episode
    assert arrays["environment.violated"].any()
    for name in ("run", "whole"):
        train(settings, tmp_path / name)
    resumed, whole = kept(tmp_path / "run"), kept(tmp_path / "whole")
    np.testing.assert_equal(resumed[0], whole[0])
    assert resumed[1:] == whole[1:]
    curve = [line["multiplier"] for line in whole[3]]
    assert len(curve) == 4
    assert len(set(curve)) > 2
    assert {line["violating_episodes"] for line in whole[3]} <= {0.0, 0.25, 0.5, 0.75, 1.0}


def test_violations_count_against_a_policy_where_they_are_charged():
    line = {"success_rate": 0.9, "median_cost": 2.0, "violating_episodes": 0.5}
    assert _score(line) == (0.9, -2.0)
    assert _score(line | {"multiplier": 0.0}) == (0.9 - 0.5, -2.0)


def test_a_scene_without_constraints_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="scene 'paper' has no constraints that could be violated"):
        train(configuration("paper", lagrangian={}), tmp_path)
