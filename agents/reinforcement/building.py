"""From a configuration to an environment and a learner."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import TQC
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from agents import configuration as c
from agents.reinforcement.held_actions import HeldActions, action_limits
from agents.reinforcement.networks import ACTIVATIONS, ScaledActionsPolicy, ScaledObservations
from agents.reinforcement.ppo import ProximalPolicyOptimization
from agents.reinforcement.sac import DemonstrationBuffer, LayerNormalizedPolicy, SoftActorCritic
from agents.reinforcement.starting import load_start, take_over
from agents.vec_env import DQSpaceArmVecEnv
from dq_space_arm_env import Scene, compile_scene

LEARNERS: Mapping[str, type[BaseAlgorithm]] = {
    "PPO": ProximalPolicyOptimization,
    "SAC": SoftActorCritic,
    "TQC": TQC,
    "TD3": TD3,
}
"""Classes of Stable-Baselines3, or made from them, by the names of the configuration."""
TRIAL_ACTIONS = 0.3
"""Standard deviation of the random actions whose observations give the units, in action scales."""


def hindsight_of(configuration: c.Configuration) -> c.Hindsight | None:
    """Tell whether an agent learns on the goal environment.

    Args:
        configuration: Of the agent.

    Returns:
        How it takes hindsight; None if it does not.
    """
    algorithm = configuration.algorithm
    return algorithm.hindsight if isinstance(algorithm, c.OffPolicy) else None


def make_environment(configuration: c.Configuration, scene: Scene) -> HeldActions:
    """Make the environment that an agent practices in.

    Args:
        configuration: Of the agent.
        scene: Its scene.

    Returns:
        The environment.

    Raises:
        ConfigurationError: If actions are held for longer than an episode, or hindsight begins before one
            has ended.
        ValueError: If the scene has no normalized actions.
    """
    _check_lengths(configuration, scene)
    practice, hindsight = configuration.environment, hindsight_of(configuration)
    environment: VecEnv
    if hindsight is None:
        environment = DQSpaceArmVecEnv(practice.copies, scene)
    else:
        reward_type = hindsight.reward_type

        def make() -> gymnasium.Env[Any, Any]:
            goal = gymnasium.make("DQSpaceArmGoal-v0", scene=scene, reward_type=reward_type)
            monitored: gymnasium.Env[Any, Any] = Monitor(goal)
            return monitored

        environment = DummyVecEnv([make] * practice.copies)
    return HeldActions(
        environment,
        repeat=practice.action_repeat,
        action_scale=action_scale(practice.action_scale, scene),
        reward_scale=practice.reward_scale,
        cost_power=practice.cost_power,
        success_reward=practice.success_reward,
        end_error_cost=practice.end_error_cost,
        tolerances=(scene.success.attitude_error_deg, scene.success.position_error),
        add_rewards=hindsight is None,
    )


def _check_lengths(configuration: c.Configuration, scene: Scene) -> None:
    practice, steps = configuration.environment, scene.simulation.steps
    if practice.action_repeat > steps:
        raise c.ConfigurationError(
            f"environment.action_repeat = {practice.action_repeat}: must be at most {steps}, the steps of an "
            f"episode of scene {scene.name!r}"
        )
    algorithm = configuration.algorithm
    if not isinstance(algorithm, c.OffPolicy) or algorithm.hindsight is None:
        return
    episodes = practice.copies * configuration.decisions(steps)
    if algorithm.learning_starts < episodes:
        raise c.ConfigurationError(
            f"algorithm.learning_starts = {algorithm.learning_starts}: must be at least {episodes}, an "
            "episode of each copy, for there is no hindsight before"
        )


def action_scale(scale: c.ActionScale, scene: Scene) -> NDArray[np.float32]:
    """Write the scale of each actuator as that of each input.

    Args:
        scale: Of the actuators.
        scene: The scene, whose inputs these are.

    Returns:
        Shape (n_u,), fractions of limits.
    """
    layout = compile_scene(scene).layout
    values = np.ones(layout.n_u, dtype=np.float32)
    for name, value in scale:
        values[getattr(layout.control, name)] = value
    return values


def make_learner(configuration: c.Configuration, environment: HeldActions) -> BaseAlgorithm:
    """Make an algorithm that has learned nothing yet, whatever it begins with.

    Args:
        configuration: Of the agent.
        environment: What it practices in. Episodes may be flown in it, to find units of observations.

    Returns:
        The algorithm.

    Raises:
        ConfigurationError: If it cannot begin with the policy that it is to begin with.
    """
    algorithm, network = configuration.algorithm, configuration.network
    options = algorithm.model_dump(
        exclude={"name", "final_learning_rate", "hindsight", "log_std_init", "layer_norm", "demonstrations"}
    )
    options["learning_rate"] = LinearSchedule(
        algorithm.learning_rate,
        algorithm.learning_rate if algorithm.final_learning_rate is None else algorithm.final_learning_rate,
        1.0,
    )
    start = load_start(configuration, *_sizes(environment))
    units = (
        _units(configuration, environment) if start is None else (start.mean.tolist(), start.scale.tolist())
    )
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
        _off_policy(algorithm, options, policy_options, environment)
        policy = "MlpPolicy" if algorithm.hindsight is None else "MultiInputPolicy"
        if isinstance(algorithm, c.SAC) and algorithm.layer_norm:
            policy = LayerNormalizedPolicy
    model = LEARNERS[algorithm.name](
        policy, environment, policy_kwargs=policy_options, seed=configuration.seed, device="cpu", **options
    )
    if start is not None:
        take_over(model, start)
    return model


def load_to_act(path: Path, policy_home: str) -> BaseAlgorithm:
    """Load a model that is to act, not to learn: without a replay buffer, and without an environment.

    Args:
        path: Model of Stable-Baselines3 or sb3-contrib. Only load files that you trust: it holds pickled
            objects.
        policy_home: Module of its policy's class, which tells the algorithm.

    Returns:
        The model.
    """
    # Policies of PPO have no module of their own.
    names = [name for name in LEARNERS if f".{name.lower()}." in f".{policy_home}."]
    learner = LEARNERS[names[0] if names else "PPO"]
    options: dict[str, Any] = {}
    if issubclass(learner, OffPolicyAlgorithm):
        options = {"buffer_size": 1, "replay_buffer_class": None, "replay_buffer_kwargs": {}}
    return learner.load(path, device="cpu", **options)


def _off_policy(
    algorithm: c.OffPolicy, options: dict[str, Any], policy_options: dict[str, Any], environment: VecEnv
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
        assert environment.action_space.shape is not None
        deviation = np.full(environment.action_space.shape, options.pop("action_noise"))
        options["action_noise"] = NormalActionNoise(np.zeros_like(deviation), deviation)
    if algorithm.hindsight is not None:
        options["replay_buffer_class"] = HerReplayBuffer
        options["replay_buffer_kwargs"] = algorithm.hindsight.model_dump(exclude={"reward_type"})


def _units(configuration: c.Configuration, environment: HeldActions) -> tuple[list[float], list[float]]:
    """Mean of observations and one over their standard deviation, in an episode of each copy.

    The actions are random, and gentle: full ones would tell how the arm whirls, not how it works. Goals are
    in units of what is achieved: a desired one may never vary, but in hindsight it does.
    """
    rng = np.random.default_rng(configuration.seed)
    environment.seed(int(rng.integers(2**31)))
    seen = [_joined(_as_achieved(environment.reset()))]
    high = action_limits(environment)
    done = np.zeros(environment.num_envs, dtype=np.bool_)
    while not done.any():
        actions = high * (TRIAL_ACTIONS * rng.standard_normal((environment.num_envs, len(high))))
        observations, _, done, _ = environment.step(actions.astype(np.float32))
        if not done.any():
            seen.append(_joined(_as_achieved(observations)))
    samples = np.concatenate(seen)
    if not configuration.environment.normalize_observations:
        return [0.0] * samples.shape[1], [1.0] * samples.shape[1]
    return units_of(samples)


def units_of(observations: NDArray[Any]) -> tuple[list[float], list[float]]:
    """Measure how much observations vary.

    Args:
        observations: Shape (N, n_obs), units of the observation.

    Returns:
        Mean and one over the standard deviation of each entry, 0 for one that does not vary.
    """
    samples = observations.astype(np.float64)
    deviation = samples.std(axis=0)
    # What does not vary tells nothing.
    varies = deviation > 1e-6
    scale = np.where(varies, 1.0 / np.where(varies, deviation, 1.0), 0.0)
    return samples.mean(axis=0).tolist(), scale.tolist()


def _as_achieved(observations: Any) -> Any:
    """Observations whose goals, if they have any, are achieved."""
    if isinstance(observations, dict):
        return observations | {"desired_goal": observations["achieved_goal"]}
    return observations


def _sizes(environment: VecEnv) -> tuple[int, int]:
    """Entries of an observation, its parts together, and of an action."""
    return spaces.flatdim(environment.observation_space), len(action_limits(environment))


def _joined(observations: Any) -> NDArray[Any]:
    """Observations as networks take them: parts joined in alphabetical order."""
    if isinstance(observations, dict):
        return np.concatenate([observations[key] for key in sorted(observations)], axis=1)
    return np.asarray(observations)
