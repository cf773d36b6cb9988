"""Time the compiled kernels and the environments: `dq-space-arm report throughput`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "throughput", *sys.argv[1:]]))
