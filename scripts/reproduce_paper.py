"""Solve, replay and draw the paper's maneuver: `dq-space-arm report paper`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "paper", *sys.argv[1:]]))
