"""The command `python -m agents.evaluate --policy ... --scene paper`.

To be run, not imported: `agents.evaluate` is the function.
"""

import sys

from agents.evaluation.command import main

if __name__ != "__main__":
    raise ImportError("agents.evaluate is a command; the function is agents.evaluation.evaluate")
sys.exit(main())
