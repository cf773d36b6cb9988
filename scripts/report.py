"""Measure everything and write it on one page: `dq-space-arm report`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", *sys.argv[1:]]))
