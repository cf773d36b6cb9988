"""Gymnasium wrappers with which agents learn here; those of vector environments are in `vector`.

As in Gymnasium, `agents.wrappers.RepeatAction` wraps a single environment and
`agents.wrappers.vector.RepeatAction` a vector environment; both do the same, bit for bit. They need neither
PyTorch nor Stable-Baselines3.
"""

from agents.wrappers.single import RepeatAction, ShapeReward, ShrinkActionSpace

__all__ = ["RepeatAction", "ShapeReward", "ShrinkActionSpace"]
