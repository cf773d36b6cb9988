"""The command `python -m agents.train CONFIGURATION`, which is `dq-space-arm train`.

To be run, not imported: `agents.train` is the function.
"""

import sys

from agents.command_line import main

if __name__ != "__main__":
    raise ImportError("agents.train is a command; the function is agents.training.train")
sys.exit(main(["train", *sys.argv[1:]]))
