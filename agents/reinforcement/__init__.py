"""Reinforcement learning with Stable-Baselines3 and sb3-contrib; needs the extra `agents`."""
