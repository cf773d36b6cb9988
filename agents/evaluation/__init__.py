"""Evaluation: how far agents are from the optimal controller, measured the same way for all of them.

Every scene has 500 fixed evaluation seeds, which nothing is tuned on, and the expert's cost for each of their
starts, computed once and kept. An agent flies them all, and is judged by how often it reaches the target, and
by how much more than the optimum it pays.
"""

from agents.evaluation.conditions import CONDITIONS, scene_under
from agents.evaluation.evaluating import Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS, OptimalCosts, evaluation_seeds, optimal_costs
from agents.evaluation.flights import Flights, Recording, fly
from agents.evaluation.statistics import (
    Interval,
    Runs,
    bootstrap_interval,
    compare_runs,
    interquartile_mean,
    wilson_interval,
)

__all__ = [
    "CONDITIONS",
    "EVALUATION_SEEDS",
    "Evaluation",
    "Flights",
    "Interval",
    "OptimalCosts",
    "Recording",
    "Runs",
    "bootstrap_interval",
    "compare_runs",
    "evaluate",
    "evaluation_seeds",
    "fly",
    "interquartile_mean",
    "optimal_costs",
    "scene_under",
    "wilson_interval",
]
