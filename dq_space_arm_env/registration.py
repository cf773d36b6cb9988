"""Register the environments with Gymnasium; importing the package does it."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry


def register_environments() -> None:
    """Make `gymnasium.make` know `DQSpaceArm-v0` and `DQSpaceArmGoal-v0`; a second call changes nothing."""
    if "DQSpaceArm-v0" not in registry:
        register(
            id="DQSpaceArm-v0",
            entry_point="dq_space_arm_env.environment:DQSpaceArmEnv",
            vector_entry_point="dq_space_arm_env.environment:DQSpaceArmVectorEnv",
        )
    if "DQSpaceArmGoal-v0" not in registry:
        register(id="DQSpaceArmGoal-v0", entry_point="dq_space_arm_env.environment:DQSpaceArmGoalEnv")
