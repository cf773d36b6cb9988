"""The command `python -m agents.evaluate POLICY...`, which is `dq-space-arm evaluate`.

To be run, not imported: `agents.evaluate` is the function.
"""

import sys

from agents.command_line import main

if __name__ != "__main__":
    raise ImportError("agents.evaluate is a command; the function is agents.evaluation.evaluate")
sys.exit(main(["evaluate", *sys.argv[1:]]))
