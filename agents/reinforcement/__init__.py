"""Reinforcement learning on the environment, with the algorithms of Stable-Baselines3 and sb3-contrib.

Everything in here needs the extra `agents`.
"""
