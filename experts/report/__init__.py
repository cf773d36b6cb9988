"""Reports: the maneuver of the paper reproduced, a user's scene measured, a data set summarized.

maneuver, maneuver_run, maneuver_summary   a solved maneuver: quantities, replay, tables and JSON
paper_numbers, reproduction   the paper's section V beside a scene; `make paper`
scene_report   `dq-space-arm report`; its parts: integrator_precision, stability_envelope, part_costs,
expert_trials
data_set_summary   card and page of a folder of demonstrations
"""

from experts.maneuver import (
    ActuatorHistory,
    Maneuver,
)
from experts.report.maneuver_run import ManeuverRun, replay, run_maneuver
from experts.report.maneuver_summary import print_tables, summarize
from experts.report.solve_progress import SolveProgress

__all__ = [
    "ActuatorHistory",
    "Maneuver",
    "ManeuverRun",
    "SolveProgress",
    "print_tables",
    "replay",
    "run_maneuver",
    "summarize",
]
