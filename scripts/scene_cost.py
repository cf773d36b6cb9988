"""Measure what scenes leave out: `dq-space-arm report scene-cost`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "scene-cost", *sys.argv[1:]]))
