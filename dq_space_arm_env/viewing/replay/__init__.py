"""Flights as a page for the browser: the arm in 3-D and the paper's plots, in one file.

    flights       the part of a flight that can be shown
    flight_files  flights from files and packages
    thinning      fewer instants of long flights
    curves        the errors and controls that are plotted
    geometry      the solids and the point of view
    page          the page, assembled from the files in `browser`

Everything about the robot is computed here: the page gets solids, poses as dual quaternions, and curves, and
knows neither dynamics nor kinematics. It makes no request and works offline.
"""

from dq_space_arm_env.task.trajectory import Trajectory
from dq_space_arm_env.viewing.replay.flight_files import by_scene, common_scene, read_flight
from dq_space_arm_env.viewing.replay.page import replay_page, write_replay

__all__ = ["Trajectory", "by_scene", "common_scene", "read_flight", "replay_page", "write_replay"]
