"""The environment of a configuration: wrapped native copies, those of goals for hindsight."""

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import TransformReward
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents import configuration as c
from agents.reinforcement.lagrangian import Lagrangian
from agents.vec_env import SB3VecEnv
from agents.wrappers import vector
from agents.wrappers.shaping import actuators
from dq_space_arm_env import DQSpaceArmGoalVectorEnv, DQSpaceArmVectorEnv, Scene


def make_environment(configuration: c.Configuration, scene: Scene) -> SB3VecEnv | Lagrangian:
    """Make the training environment, with held actions, shaped rewards, and violations charged if asked."""
    _check_lengths(configuration, scene)
    practice, hindsight = configuration.environment, configuration.hindsight
    if hindsight is None:
        environment = native_environment(configuration, scene, practice.copies)
        return _charged(configuration.algorithm, environment, scene)
    native = DQSpaceArmGoalVectorEnv(practice.copies, scene, hindsight.reward_type, AutoresetMode.SAME_STEP)
    held = vector.RepeatAction(native, practice.action_repeat, reward="last")
    return SB3VecEnv(vector.ShrinkActionSpace(held, largest_actions(practice.action_scale, scene)))


def native_environment(configuration: c.Configuration, scene: Scene, copies: int) -> SB3VecEnv:
    """Make native copies that practice what the configuration says."""
    practice = configuration.environment
    native = DQSpaceArmVectorEnv(copies, scene, autoreset_mode=AutoresetMode.SAME_STEP)
    held = held_environment(native, practice.action_repeat)
    shaped = vector.ShapeReward(
        vector.ShrinkActionSpace(held, largest_actions(practice.action_scale, scene)),
        practice.reward_scale,
        practice.cost_power,
        success_reward=practice.success_reward,
        end_error_cost=practice.end_error_cost,
    )
    return SB3VecEnv(shaped)


def largest_actions(given: c.ActionScale, scene: Scene) -> dict[str, float]:
    """Scales of the scene's actuators.

    Wheels and thrusters that it lacks are refused. The others are for any scene: those that ship leave the
    base little, and fly in scenes that cannot push it.
    """
    scales, own = given.model_dump(exclude_none=True), actuators(scene)
    for name in ("wheel_torque", "thruster_force"):
        if name in scales and name not in own:
            raise c.ConfigurationError(
                f"environment.action_scale.{name} = {scales[name]:g}: must be left out: scene {scene.name!r} "
                f"has {', '.join(own)}"
            )
    return {name: scale for name, scale in scales.items() if name in own}


def _charged(algorithm: c.Algorithm, environment: SB3VecEnv, scene: Scene) -> SB3VecEnv | Lagrangian:
    """Charge violations of the scene's constraints where the algorithm has a Lagrangian."""
    asked = algorithm.lagrangian if isinstance(algorithm, c.PPO) else None
    if asked is None:
        return environment
    if not scene.constraints:
        raise c.ConfigurationError(
            f"algorithm.lagrangian: given, must be left out: scene {scene.name!r} has no constraints that "
            "could be violated"
        )
    return Lagrangian(environment, asked.limit, asked.initial, asked.learning_rate)


def held_environment(env: VectorEnv[Any, Any, Any], repeat: int) -> vector.RepeatAction:
    """Hold the actions of an environment, and round its rewards to single precision.

    Policies of the zoo were trained with such rewards: their weights can be reproduced.
    """
    return vector.RepeatAction(TransformReward(env, np.float32), repeat)


def action_limits(venv: VecEnv) -> NDArray[np.float32]:
    """Upper bounds of the actions, shape (n_u,)."""
    return np.asarray(cast(spaces.Box, venv.action_space).high, dtype=np.float32)


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
    for name, least, why in (
        ("learning_starts", episodes, "one episode of each copy; there is no hindsight before that"),
        ("buffer_size", 2 * episodes, "two episodes of each copy; the running one has no hindsight yet"),
    ):
        if (value := getattr(algorithm, name)) < least:
            raise c.ConfigurationError(f"algorithm.{name} = {value}: must be at least {least}, {why}")
