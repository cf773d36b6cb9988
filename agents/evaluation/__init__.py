"""Evaluation: how far agents are from the optimal controller, measured the same way for all of them.

Every scene has 500 fixed evaluation seeds, which nothing is tuned on, and the expert's cost from each of
their starts, computed once and cached. An agent flies from all of them, and is judged by how often it reaches
the target, and by its cost relative to the optimum.
"""

from agents.evaluation.comparing import Comparison, Row, compare
from agents.evaluation.conditions import CONDITIONS, scene_under
from agents.evaluation.evaluating import Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS, OptimalCosts, evaluation_seeds, optimal_costs
from agents.evaluation.plan_followers import CONTROLLERS
from agents.evaluation.statistics import (
    Interval,
    Runs,
    bootstrap_interval,
    compare_runs,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    rate_over_runs,
    wilson_interval,
)
from agents.policies.flying import Flights, fly

__all__ = [
    "CONDITIONS",
    "CONTROLLERS",
    "EVALUATION_SEEDS",
    "Comparison",
    "Evaluation",
    "Flights",
    "Interval",
    "OptimalCosts",
    "Row",
    "Runs",
    "bootstrap_interval",
    "compare",
    "compare_runs",
    "evaluate",
    "evaluation_seeds",
    "fly",
    "interquartile_mean",
    "optimal_costs",
    "performance_profile",
    "probability_of_improvement",
    "rate_over_runs",
    "scene_under",
    "wilson_interval",
]
