"""Train an agent by reinforcement: configuration -> environment -> learner -> learn -> exported policy."""

import io
import os
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from traceback import walk_tb
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents import configuration as c
from agents.demonstrations import expert_seconds, prepare_demonstrations
from agents.policies import ExportedPolicy
from agents.policies.exported import units_of
from agents.reinforcement.callback import TimeIsUp, TrainingCallback
from agents.reinforcement.checkpoint import Progress, read_checkpoint
from agents.reinforcement.networks import ACTIVATIONS, ScaledActionsPolicy, ScaledObservations
from agents.reinforcement.off_policy import LAYER_NORMALIZED, TruncatedQuantileCritics, TwinDelayed
from agents.reinforcement.ppo import ProximalPolicyOptimization
from agents.reinforcement.sac import DemonstrationBuffer, SoftActorCritic
from agents.reinforcement.training_environment import action_limits, make_environment
from agents.reinforcement.warm_start import fly_again, set_actor
from agents.run_folder import DEMONSTRATIONS, MODEL, POLICY, TENSORBOARD, RunFolder
from agents.zoo.starting import load_start, spent_before
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.progress import Advance

LEARNERS: Mapping[str, type[BaseAlgorithm]] = {
    "PPO": ProximalPolicyOptimization,
    "SAC": SoftActorCritic,
    "TQC": TruncatedQuantileCritics,
    "TD3": TwinDelayed,
}
TRIAL_ACTIONS = 0.3
"""Standard deviation of the random actions that measure the spread of observations, in action scales."""
SEED_STRIDE = 2**24
"""Distance of the copies' seeds in trainings with consecutive seeds: more than there can be copies."""


class Trained(NamedTuple):
    """Result of a training run: its folder, the Stable-Baselines3 model, and the exported policy."""

    folder: Path
    model: BaseAlgorithm
    policy: ExportedPolicy


def train_by_reinforcement(
    configuration: c.Configuration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Trained:
    """Train an agent in a run folder, resuming from its last checkpoint."""
    scene = load_scene(configuration.scene)
    folder = RunFolder(Path(out), configuration)
    environment = make_environment(configuration, scene)
    return train_learner(
        configuration,
        folder,
        environment,
        lambda: _begin(configuration, scene, folder, environment, report),
        lambda before: TrainingCallback(configuration, scene, folder, before, report),
    )


def train_learner(
    configuration: c.Configuration,
    folder: RunFolder,
    environment: VecEnv,
    begin: Callable[[], tuple[BaseAlgorithm, Progress]],
    watch: Callable[[Progress], TrainingCallback],
) -> Trained:
    """Train a new or resumed learner to the end of its schedule; closes the environment.

    Raises `DivergedError` where the network yields NaN; the last checkpoint remains.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(configuration.threads)
    try:
        checkpoint = folder.checkpoint()
        if checkpoint is None:
            model, before = begin()
        else:
            model = make_learner(configuration, environment, blank=True)
            before = read_checkpoint(checkpoint, model)
        with closing(configure(str(folder.path / TENSORBOARD), ["tensorboard"])) as logger:  # and its thread
            model.set_logger(logger)
            callback = watch(before)
            _learn(model, callback, configuration)
            policy = callback.export()
    finally:
        torch.set_num_threads(threads)
        environment.close()
    content = io.BytesIO()
    model.save(content)
    write_atomically(folder.path / MODEL, content.getvalue())
    policy.save(folder.path / POLICY)  # last: a folder with it is a finished run
    return Trained(folder.path, model, policy)


# --- learner ---


def _begin(
    configuration: c.Configuration,
    scene: Scene,
    folder: RunFolder,
    environment: VecEnv,
    report: Callable[[Advance], None],
) -> tuple[BaseAlgorithm, Progress]:
    """Make a learner, with demonstrations in its replay buffer where the configuration asks for them."""
    model, algorithm = make_learner(configuration, environment), configuration.algorithm
    # Stable-Baselines3 seeds copy i with seed + i: trainings with consecutive seeds would share their starts.
    environment.seed(SEED_STRIDE * configuration.seed)
    solves, seconds = spent_before(configuration.start_from)
    spent = Progress(expert_solves=solves, seconds_before=seconds)
    if not isinstance(algorithm, c.SAC) or algorithm.demonstrations is None:
        return model, spent
    given = algorithm.demonstrations
    place = folder.path / DEMONSTRATIONS
    demonstrations = prepare_demonstrations(given.source, scene, place, progress=report)
    flown = fly_again(demonstrations, configuration, scene)
    assert isinstance(model, SoftActorCritic)
    assert isinstance(model.replay_buffer, DemonstrationBuffer)
    model.replay_buffer.demonstrate(flown, action_limits(environment), given.share)
    if configuration.environment.normalize_observations:
        # Good flights cover a narrower range of observations than random ones.
        for module in model.policy.modules():
            if isinstance(module, ScaledObservations):
                module.set_units(*(each.tolist() for each in units_of(flown.observations)))
    return model, spent._replace(
        expert_solves=spent.expert_solves + demonstrations.settings["problems"],
        seconds_before=spent.seconds_before + expert_seconds(demonstrations),
    )


def make_learner(
    configuration: c.Configuration, environment: VecEnv, *, blank: bool = False
) -> BaseAlgorithm:
    """Make an untrained algorithm; PPO's actor starts from `start_from` if given.

    Flies one random episode in the environment to measure the spread of observations. A blank one, whose
    weights and units are to be replaced, needs neither.
    """
    algorithm, network = configuration.algorithm, configuration.network
    options = algorithm.model_dump(
        exclude={
            "name",
            "final_learning_rate",
            "hindsight",
            "lagrangian",
            "log_std_init",
            "layer_norm",
            "demonstrations",
        }
    )
    first, last = algorithm.learning_rate, algorithm.final_learning_rate
    options["learning_rate"] = LinearSchedule(first, first if last is None else last, 1.0)
    sizes = spaces.flatdim(environment.observation_space), len(action_limits(environment))
    start = None if blank else load_start(configuration.start_from, network, *sizes)
    if blank:
        units = [0.0] * sizes[0], [1.0] * sizes[0]
    elif start is None:
        units = _units(configuration, environment)
    else:
        units = start.mean.tolist(), start.scale.tolist()
    policy_options: dict[str, Any] = {
        "net_arch": list(network.hidden),
        "activation_fn": ACTIVATIONS[network.activation],
        "features_extractor_class": ScaledObservations,
        "features_extractor_kwargs": dict(zip(("mean", "scale"), units, strict=True)),
    }
    policy: Any = "MlpPolicy"
    if isinstance(algorithm, c.PPO):
        policy = ScaledActionsPolicy
        policy_options["log_std_init"] = algorithm.log_std_init
    else:
        _set_off_policy_options(algorithm, options, policy_options)
        policy = "MlpPolicy" if algorithm.hindsight is None else "MultiInputPolicy"
        if algorithm.layer_norm:
            policy = LAYER_NORMALIZED[algorithm.name]
    model = LEARNERS[algorithm.name](
        policy, environment, policy_kwargs=policy_options, seed=configuration.seed, device="cpu", **options
    )
    if start is not None:
        set_actor(model, start)
    return model


def _set_off_policy_options(
    algorithm: c.OffPolicy, options: dict[str, Any], policy_options: dict[str, Any]
) -> None:
    """Put the options of algorithms with a replay buffer where Stable-Baselines3 expects them."""
    policy_options["n_critics"] = options.pop("n_critics")
    if isinstance(algorithm, c.TQC):
        policy_options["n_quantiles"] = options.pop("n_quantiles")
    if isinstance(algorithm, c.SAC | c.TQC):
        first = options.pop("ent_coef_init")
        if algorithm.ent_coef == "auto":
            options["ent_coef"] = f"auto_{first}"
    if isinstance(algorithm, c.SAC) and algorithm.demonstrations is not None:
        options["replay_buffer_class"] = DemonstrationBuffer
        options["cloning_weight"] = algorithm.demonstrations.cloning_weight
    if isinstance(algorithm, c.TD3):
        first, last = options.pop("action_noise"), options.pop("final_action_noise")
        options["deviations"] = first, first if last is None else last
    if algorithm.hindsight is not None:
        options["replay_buffer_class"] = HerReplayBuffer
        options["replay_buffer_kwargs"] = algorithm.hindsight.model_dump(exclude={"reward_type"})


def _units(configuration: c.Configuration, environment: VecEnv) -> tuple[list[float], list[float]]:
    """Mean and inverse standard deviation of observations over one episode of each copy.

    The random actions are gentle: full ones would show how the arm whirls, not how it works. A goal takes
    the units of what is achieved, since hindsight varies it even where the scene does not.
    """
    rng = np.random.default_rng(configuration.seed)
    environment.seed(int(rng.integers(2**31)))
    seen = [_joined(environment.reset())]
    high = action_limits(environment)
    done = np.zeros(environment.num_envs, dtype=np.bool_)
    while not done.any():
        actions = high * (TRIAL_ACTIONS * rng.standard_normal((environment.num_envs, len(high))))
        observations, _, done, _ = environment.step(actions.astype(np.float32))
        if not done.any():
            seen.append(_joined(observations))
    samples = np.concatenate(seen)
    if not configuration.environment.normalize_observations:
        return [0.0] * samples.shape[1], [1.0] * samples.shape[1]
    mean, scale = units_of(samples)
    return mean.tolist(), scale.tolist()


def _joined(observations: Any) -> NDArray[Any]:
    """Observations as networks take them, parts in alphabetical order, with the achieved goal desired."""
    if isinstance(observations, dict):
        observations = observations | {"desired_goal": observations["achieved_goal"]}
        return np.concatenate([observations[key] for key in sorted(observations)], axis=1)
    return np.asarray(observations)


# --- learning ---


def _learn(model: BaseAlgorithm, callback: TrainingCallback, configuration: c.Configuration) -> None:
    """Run the rest of the schedule."""
    left = configuration.decisions(configuration.schedule.total_steps) - model.num_timesteps
    callback.init_callback(model)
    if left <= 0 or callback.is_time_up:
        return
    # Stable-Baselines3 adds the requested steps to those done, and runs schedules over the sum.
    try:
        model.learn(left, callback=callback, reset_num_timesteps=model.num_timesteps == 0)
    except TimeIsUp:
        pass
    except (ValueError, RuntimeError) as error:
        if _is_rejected_by_torch(error):
            raise callback.diverged() from error
        raise
    callback.check_network()
    callback.evaluate()
    callback.write_checkpoint()


def _is_rejected_by_torch(error: BaseException) -> bool:
    """Whether PyTorch's distributions reject the network's output, or its optimizers the step size."""
    origin = [frame for frame, _ in walk_tb(error.__traceback__)][-1].f_globals.get("__name__", "")
    return str(origin).startswith(("torch.distributions.", "torch.optim."))
