"""Validated YAML files, scenes and configurations of agents: models, kinds of numbers, text."""

from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.validation.fields import (
    Count,
    Finite,
    FiniteOrAuto,
    Flag,
    Fraction,
    NonNegative,
    Positive,
    PositiveOrAuto,
    Share,
    Vector3,
    count_up_to,
)
from dq_space_arm_env.validation.problems import Model, Problem, problem, problem_list
from dq_space_arm_env.validation.yaml_text import (
    YAMLError,
    dump_yaml,
    line_of,
    mapping_at_top,
    parse_yaml,
    read_yaml,
    yaml_problem,
)

__all__ = [
    "Count",
    "Finite",
    "FiniteOrAuto",
    "Flag",
    "Fraction",
    "Model",
    "NonNegative",
    "Positive",
    "PositiveOrAuto",
    "Problem",
    "Share",
    "Vector3",
    "YAMLError",
    "count_up_to",
    "did_you_mean",
    "dump_yaml",
    "line_of",
    "mapping_at_top",
    "parse_yaml",
    "problem",
    "problem_list",
    "read_yaml",
    "yaml_problem",
]
