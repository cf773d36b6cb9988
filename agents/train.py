"""The command `python -m agents.train --config ...`.

To be run, not imported: `agents.train` is the function.
"""

import sys

from agents.training import main

if __name__ != "__main__":
    raise ImportError("agents.train is a command; the function is agents.training.train")
sys.exit(main())
