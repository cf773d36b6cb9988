"""The Gymnasium environment and its pictures."""

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv

__all__ = ["DQSpaceArmEnv"]
