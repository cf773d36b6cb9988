"""Register the environments with Gymnasium; importing the package does it."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry


def register_environments() -> None:
    """Make `gymnasium.make("DQSpaceArm-v0")` work; a second call changes nothing."""
    if "DQSpaceArm-v0" not in registry:
        register(
            id="DQSpaceArm-v0",
            entry_point="dq_space_arm_env.environment:DQSpaceArmEnv",
            vector_entry_point="dq_space_arm_env.environment:DQSpaceArmVectorEnv",
        )
