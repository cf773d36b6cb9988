"""Comparison: agents and the expert's controllers side by side, error against run time.

The controllers fly plans of the expert: open loop, with its feedback gains, or planned anew at every step.
All fly from the evaluation starts, and are compared with the optimum of the scene that they fly in.
"""

from agents.comparison.comparing import RECEDING_STARTS, Comparison, Row, compare
from agents.comparison.controllers import CONTROLLERS

__all__ = ["CONTROLLERS", "RECEDING_STARTS", "Comparison", "Row", "compare"]
