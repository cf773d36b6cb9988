"""A maneuver solved, carried out and reported: the numbers and figures of the paper's section V.

run          solve from zero controls, replay, take the time
maneuver     the trajectory in the quantities that the paper plots
replay       the plan in the environment, and in a finer integration
comparison   the paper's numbers beside a scene's, and what is our own choice
progress, tables   on the terminal
summary, provenance   for `summary.json`
figures      Figures 2 to 6 (not imported here: needs the extra `plots`)
throughput, peak, start_up   the benchmark of the environment (not imported here)
solvers      the benchmark of the expert (not imported here)
scene_cost   what a scene leaves out (not imported here)
work_precision   error against run time of integrators and formulations (not imported here)
page         all of these on one page (not imported here)
"""

from experts.files import write_atomically
from experts.report.maneuver import ActuatorHistory, Maneuver
from experts.report.progress import SolveProgress
from experts.report.replay import Replay, replay
from experts.report.run import ManeuverRun, run_maneuver
from experts.report.summary import summarize, to_json
from experts.report.tables import print_tables

__all__ = [
    "ActuatorHistory",
    "Maneuver",
    "ManeuverRun",
    "Replay",
    "SolveProgress",
    "print_tables",
    "replay",
    "run_maneuver",
    "summarize",
    "to_json",
    "write_atomically",
]
