"""Measure error against run time: `dq-space-arm report work-precision`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "work-precision", *sys.argv[1:]]))
