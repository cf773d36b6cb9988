"""Measure the optimal-control expert: `dq-space-arm report expert`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "expert", *sys.argv[1:]]))
