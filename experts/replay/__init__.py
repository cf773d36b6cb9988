"""Flights as a page for the browser: the arm in 3-D and the paper's plots, in one file that needs no other.

flights     what a flight is: a label, states, controls; what of it can be shown
files       flights from solutions, demonstrations and files of rollouts
curves      the errors and controls that are plotted
geometry    the solids that are drawn, and from where they are looked at
page        the page, put together from the files in `browser`

All that has to do with the robot is computed here: the page gets solids, poses as dual quaternions, and
curves, and knows nothing of dynamics or kinematics. It makes no request and runs without a network.
"""

from experts.replay.files import Recording, common_scene, read_recording, save_flight
from experts.replay.flights import Flight
from experts.replay.page import replay_page, write_replay

__all__ = [
    "Flight",
    "Recording",
    "common_scene",
    "read_recording",
    "replay_page",
    "save_flight",
    "write_replay",
]
