"""The Gymnasium environments; `rollouts` flies episodes in them, `disturbances` disturbs these."""

from dq_space_arm_env.environment.dq_space_arm import DQSpaceArmEnv
from dq_space_arm_env.environment.goal import DQSpaceArmGoalEnv
from dq_space_arm_env.environment.goal_vector import DQSpaceArmGoalVectorEnv
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv

__all__ = ["DQSpaceArmEnv", "DQSpaceArmGoalEnv", "DQSpaceArmGoalVectorEnv", "DQSpaceArmVectorEnv"]
