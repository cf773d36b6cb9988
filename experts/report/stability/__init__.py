"""Stiff and extreme cases, each handled with an error, or refused in a sentence.

rows         what a case is, and the row that says what became of it
cases        all groups, and `run_cases`, which tries them
references   accelerations with 50 digits, and how far others are from them
formulations, scenes   what the cases are applied to, and made of
mass_properties, motions, extreme_motions, stiff_joints, time_steps, paper_form   groups of cases, of the
             physics
far_away, odd_poses, bad_numbers, payloads, expert   groups of cases, of what is asked
tables       on the terminal
records      for the file

The picture is in `figures.stability`. References need mpmath, of the extra `test`.
"""

from experts.report.stability.cases import GROUPS, all_cases, run_cases
from experts.report.stability.rows import FULL, QUICK, Case, Effort, Row, Status, run_case

__all__ = [
    "FULL",
    "GROUPS",
    "QUICK",
    "Case",
    "Effort",
    "Row",
    "Status",
    "all_cases",
    "run_case",
    "run_cases",
]
