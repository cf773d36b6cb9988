"""Showing: one flight of an agent, second by second, beside the expert's solution from the same start."""

from agents.showing.beside_expert import Side, SideBySide, fly_beside_expert

__all__ = ["Side", "SideBySide", "fly_beside_expert"]
