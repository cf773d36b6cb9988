"""The Gymnasium environments: one copy, many, one with goals; and their pictures."""

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.goal import DQSpaceArmGoalEnv
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv

__all__ = ["DQSpaceArmEnv", "DQSpaceArmGoalEnv", "DQSpaceArmVectorEnv"]
