"""Generate demonstrations: `dq-space-arm demonstrations generate`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main(["demonstrations", "generate", *sys.argv[1:]]))
