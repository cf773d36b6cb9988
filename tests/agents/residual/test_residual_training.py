"""A correction trains for some thousand steps, begins as the plan, and resumes and exports what it is."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")


from agents.configuration import ConfigurationError, load_configuration
from agents.evaluation.plan_followers import follower
from agents.evaluation.plans import Plans
from agents.policies import ExportedPolicy
from agents.reinforcement.checkpoint import read_checkpoint
from agents.reinforcement.networks import export_policy
from agents.reinforcement.reinforcement_training import make_learner
from agents.residual.corrections import CorrectionObserver, correcting, correction
from agents.residual.mismatch import Worlds, fly_mismatched
from agents.residual.residual_training import make_residual_environment, silence, split, train_residual
from agents.run_folder import RunFolder, RunFolderError
from dq_space_arm_env import compile_scene
from experts.demonstrations import DemonstrationsError

pytestmark = pytest.mark.agents

COPIES, REPEAT, TOTAL = 8, 10, 4800
SEEN = {"repeat": REPEAT, "memory": 0.5, "full_authority": 0.1}
HEAVY = 1.3
EVERY = {"evaluate_every": 2400, "checkpoint_every": 2400}
ALGORITHMS = {
    "residual-PPO": {"n_steps": 15, "batch_size": 60, "n_epochs": 2, "log_std_init": -2.0},
    "residual-SAC": {"batch_size": 32, "learning_starts": 100, "buffer_size": 1000, "ent_coef": 0.001},
}


@pytest.fixture
def configuration(small_file, demonstrations):
    def make(algorithm="residual-PPO", total_steps=TOTAL, **changes):
        content = {
            "name": "small",
            "scene": str(small_file),
            "demonstrations": {"folder": str(demonstrations.path)},
            "mismatch": {"mass_factors": [1.0], "noise": 0.01, "push": 0.02},
            "environment": {"copies": COPIES, "action_repeat": REPEAT, "memory": 0.5, "full_authority": 0.1},
            "network": {"hidden": [16, 16], "activation": "tanh" if algorithm.endswith("PPO") else "relu"},
            "algorithm": {"name": algorithm, **ALGORITHMS[algorithm]},
            "schedule": {"total_steps": total_steps, "evaluation_episodes": 6, **EVERY},
        }
        return load_configuration(content | changes)

    return make


def trained_parameters(run):
    return {name: array.numpy().copy() for name, array in run.model.policy.state_dict().items()}


def test_plans_without_gains_are_refused(configuration, demonstrations, tmp_path, monkeypatch):
    bare = [replace(each, feedback_gains=np.zeros_like(each.feedback_gains)) for each in demonstrations[:2]]
    monkeypatch.setattr(type(demonstrations), "__getitem__", lambda self, index: bare[index])
    with pytest.raises(ValueError, match="have no feedback gains, which corrected plans fly with"):
        train_residual(configuration(), tmp_path)


def test_demonstrations_report_their_progress(configuration, tmp_path, monkeypatch):
    def prepare(*given, progress):
        progress("they are made")
        raise DemonstrationsError("enough")

    monkeypatch.setattr("agents.residual.residual_training.prepare_demonstrations", prepare)
    reports = []
    with pytest.raises(DemonstrationsError, match="enough"):
        train_residual(configuration(), tmp_path, reports.append)
    assert reports == ["they are made"]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_before_training_the_agent_is_the_plan_with_its_gains(
    algorithm, configuration, small_scene, demonstrations
):
    settings = configuration(algorithm)
    environment = make_residual_environment(settings, small_scene, demonstrations)
    model = make_learner(settings.learner(), environment)
    silence(model)
    observations = environment.reset()
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(actions, 0.0)
    rewards = []
    for _ in range(small_scene.simulation.steps // REPEAT):
        observations, reward, done, infos = environment.step(actions)
        rewards.append(reward)
    assert not np.any(rewards)  # a copy that corrects nothing costs what its twin costs
    assert done.all()
    assert all(info["cost"] == info["twin_cost"] for info in infos)
    plans, worlds = Plans.of(demonstrations), Worlds(1.0, 0.01, 0.02, 6.0, seed=1)
    scale = environment.action_space.high
    silent = correcting(small_scene, plans, export_policy(model, {}), action_scale=scale, **SEEN)
    planned = follower(small_scene, plans, feedback=True)
    costs = [fly_mismatched(each, small_scene, plans, worlds).cost for each in (silent, planned)]
    np.testing.assert_array_equal(*costs)


@pytest.fixture
def unscaled(configuration, small_scene, demonstrations):
    """An environment that rewards with savings as they are, begun."""
    settings = configuration()
    practice = settings.environment.model_copy(update={"cost_power": 1.0, "reward_scale": 1.0})
    settings = settings.model_copy(update={"environment": practice})
    environment = make_residual_environment(settings, small_scene, demonstrations)
    environment.reset()
    return environment


def test_rewards_are_what_corrections_save(unscaled, small_scene):
    total = np.zeros(COPIES)
    for _ in range(small_scene.simulation.steps // REPEAT):
        beyond = np.tile(3.0 * unscaled.action_space.high, (COPIES, 1))
        _, reward, done, infos = unscaled.step(beyond)
        total += reward
    assert done.all()
    saved = [info["twin_cost"] - info["cost"] for info in infos]
    np.testing.assert_allclose(total, saved, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], saved, rtol=1e-5)
    assert min(np.abs(saved)) > 0.0


def test_a_flight_that_diverges_is_charged_for_the_rest(unscaled, small_scene):
    worlds = unscaled.vector_env.unwrapped._worlds
    push = np.zeros((2 * COPIES, worlds.kernels.n_t))
    push[0, worlds.kernels.layout.tangent.base_velocity] = 2e5
    worlds.perturb(push)
    total, idle = np.zeros(COPIES), np.zeros((COPIES, worlds.kernels.n_u))
    for _ in range(small_scene.simulation.steps // REPEAT):
        _, reward, _, infos = unscaled.step(idle)
        total += reward
    lost = infos[0]["cost"] - infos[0]["twin_cost"]
    assert 0.0 < lost < np.inf
    assert total[0] == pytest.approx(-lost, rel=1e-5)
    assert not infos[0]["is_success"]
    assert not total[1:].any()


def test_what_follows_a_divergence_depends_on_the_seed_alone(configuration, small_scene, demonstrations):
    """Learners see it, and a training would not repeat."""

    def seen(asked):
        environment = make_residual_environment(configuration(), small_scene, demonstrations)
        if asked is not None:
            environment.seed(asked)
        environment.reset()
        worlds = environment.vector_env.unwrapped._worlds
        push = np.zeros((2 * COPIES, worlds.kernels.n_t))
        push[0, worlds.kernels.layout.tangent.base_velocity] = 2e5
        worlds.perturb(push)
        idle = np.zeros((COPIES, worlds.kernels.n_u))
        return [environment.step(idle)[0][0] for _ in range(2)]

    for asked in (None, 7):  # by the constructor, and by the reset
        np.testing.assert_array_equal(seen(asked), seen(asked))


def test_a_divergence_after_resuming_is_followed_as_without(configuration, small_scene, demonstrations):
    whole, resumed = (
        make_residual_environment(configuration(), small_scene, demonstrations) for _ in range(2)
    )
    whole.reset()
    idle, steps = np.zeros((COPIES, *whole.action_space.shape)), small_scene.simulation.steps // REPEAT

    def lose_one(environment):
        worlds = environment.vector_env.unwrapped._worlds
        push = np.zeros((2 * COPIES, worlds.kernels.n_t))
        push[0, worlds.kernels.layout.tangent.base_velocity] = 2e5
        worlds.perturb(push)

    lose_one(whole)
    whole.step(idle)
    resumed.vector_env.unwrapped.set_state(whole.vector_env.unwrapped.get_state())
    for stage in range(1, steps + 2):
        if stage == steps:
            lose_one(whole)
            lose_one(resumed)
        seen, expected = (each.step(idle)[0] for each in (resumed, whole))
        np.testing.assert_array_equal(seen, expected)


def test_episodes_go_on_with_their_plans_alone(configuration, small_scene, demonstrations):
    """Others have the same shapes and numbers."""
    own, others = (
        make_residual_environment(configuration(), small_scene, each)
        for each in (demonstrations[:3], demonstrations[3:6])
    )
    own.reset()
    others.reset()
    state = own.get_state()
    with pytest.raises(ValueError, match=r"plans: of demonstrations .*, should be of those given"):
        others.set_state(state)
    del state["plans"]  # as in earlier checkpoints
    own.set_state(state)


@pytest.mark.parametrize("name", ["demonstrations", "drawn"])
def test_the_environment_and_the_controller_see_and_do_the_same(name, configuration, request):
    """A policy that corrects by what it sees costs the same in both, also where targets are drawn."""
    demonstrations = request.getfixturevalue(name)
    scene = demonstrations.scene
    kernels = compile_scene(scene)
    weights = 0.05 * np.random.default_rng(0).standard_normal((CorrectionObserver.size(kernels), 6))

    def policy(seen):
        return np.tanh(seen @ weights)[:, : kernels.n_u]

    heavy = {"mass_factors": [HEAVY], "noise": 0.0, "push": 0.0}
    settings = configuration(mismatch=heavy)
    environment = make_residual_environment(settings, scene, demonstrations[:1])
    observations = environment.reset()
    for _ in range(scene.simulation.steps // REPEAT):
        observations, _, _, infos = environment.step(policy(observations))
    plans = Plans.of(demonstrations[:1])
    controller = correcting(scene, plans, policy, action_scale=environment.action_space.high, **SEEN)
    flown = fly_mismatched(controller, scene, plans, Worlds(HEAVY, 0.0, 0.0, 6.0, seed=0))
    np.testing.assert_allclose([info["cost"] for info in infos], flown.cost[0], rtol=1e-6)
    assert abs(flown.cost[0] / infos[0]["twin_cost"] - 1.0) > 1e-4


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_it_trains_exports_and_resumes(algorithm, configuration, small_scene, demonstrations, tmp_path):
    settings = configuration(algorithm)

    def kill(advance):
        if advance.environment_steps > 2400:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_residual(settings, tmp_path, report=kill)
    checkpoint = RunFolder(tmp_path, settings).checkpoint()
    practiced, _ = split(demonstrations, settings.schedule.evaluation_episodes)
    environment = make_residual_environment(settings, small_scene, practiced)
    model = make_learner(settings.learner(), environment, blank=True)
    progress = read_checkpoint(checkpoint, model)
    assert progress.environment_steps == model.num_timesteps * REPEAT == 2400
    run = train_residual(settings, tmp_path)
    assert run.model.num_timesteps * REPEAT == TOTAL
    whole = train_residual(settings, tmp_path / "whole")  # as a run that was not killed
    for actual, expected in zip(run.policy.weights, whole.policy.weights, strict=True):
        np.testing.assert_array_equal(actual, expected)
    exported = ExportedPolicy.load(tmp_path / "policy.npz")
    seen = np.random.default_rng(0).normal(size=(50, exported.n_observation)) + exported.mean
    seen = seen.astype(np.float32)
    expected, _ = run.model.predict(seen, deterministic=True)
    np.testing.assert_allclose(exported(seen), np.clip(expected, -1.0, 1.0), rtol=0.0, atol=1e-6)
    assert np.ptp(expected, axis=0).min() > 0.0  # it has learned something
    again = train_residual(settings, tmp_path)  # nothing is left to do
    for name, array in trained_parameters(run).items():
        np.testing.assert_array_equal(trained_parameters(again)[name], array)
    curve = [json.loads(line) for line in (tmp_path / "evaluations.jsonl").read_text().splitlines()]
    assert [line["environment_steps"] for line in curve] == [2400, TOTAL]
    assert exported.metadata["training"]["environment_steps"] == TOTAL
    assert exported.metadata["observation"] == "residual"
    plans = Plans.of(demonstrations[:2])
    corrected = correction(exported, small_scene, plans)
    flown = fly_mismatched(corrected, small_scene, plans, Worlds(1.0, 0.0, 0.0, 6.0, seed=0))
    assert np.isfinite(flown.cost).all()


def test_a_folder_or_a_scene_that_does_not_fit_is_refused(configuration, tmp_path):
    RunFolder(tmp_path / "run", configuration()).write_evaluations([])
    with pytest.raises(RunFolderError, match="seed is 0 there and 1 here"):
        train_residual(configuration(seed=1), tmp_path / "run")
    with pytest.raises(DemonstrationsError, match="demonstrations of another scene than 'paper'"):
        train_residual(configuration(scene="paper"), tmp_path / "other")


def test_what_is_wrong_is_said_before_any_problem_is_solved(configuration, monkeypatch, tmp_path):
    monkeypatch.setattr("agents.residual.residual_training.prepare_demonstrations", None)
    with pytest.raises(ValueError, match="wheel_torque"):
        train_residual(configuration(environment={"action_scale": {"wheel_torque": 0.1}}), tmp_path)
    monkeypatch.setitem(ALGORITHMS["residual-SAC"], "layer_norm", True)
    flat = {"hidden": [], "activation": "relu"}
    with pytest.raises(ConfigurationError, match=r"network\.hidden = \[\]: must have a layer"):
        train_residual(configuration("residual-SAC", network=flat), tmp_path)
