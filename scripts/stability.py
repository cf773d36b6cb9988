"""Try stiff and extreme cases: `dq-space-arm report stability`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["report", "stability", *sys.argv[1:]]))
