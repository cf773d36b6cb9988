"""Experts: optimal control of a scene, by control-limited differential dynamic programming."""

from experts.box_ddp import BoxDDP
from experts.demonstrations import generate_demonstrations, load_demonstrations
from experts.guesses import GuidedDDP
from experts.problem import ShootingProblem
from experts.receding_horizon import RecedingHorizonExpert
from experts.solution import Solution, StopReason

__all__ = [
    "BoxDDP",
    "GuidedDDP",
    "RecedingHorizonExpert",
    "ShootingProblem",
    "Solution",
    "StopReason",
    "generate_demonstrations",
    "load_demonstrations",
]
