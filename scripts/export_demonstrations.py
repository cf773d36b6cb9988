"""Write demonstrations for Minari: `dq-space-arm demonstrations export`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["demonstrations", "export", *sys.argv[1:]]))
