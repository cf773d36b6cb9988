"""The Gymnasium environment, one copy or many, and its pictures."""

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv

__all__ = ["DQSpaceArmEnv", "DQSpaceArmVectorEnv"]
