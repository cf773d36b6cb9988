"""What validated YAML files have in common, scenes and configurations of agents: models, numbers, text."""

from dq_space_arm_env.scene._fields import Count, Finite, Fraction, NonNegative, Positive, Vector3
from dq_space_arm_env.scene._problems import Model, Problem, did_you_mean, problem
from dq_space_arm_env.scene._yaml import dump_yaml, parse_yaml

__all__ = [
    "Count",
    "Finite",
    "Fraction",
    "Model",
    "NonNegative",
    "Positive",
    "Problem",
    "Vector3",
    "did_you_mean",
    "dump_yaml",
    "parse_yaml",
    "problem",
]
