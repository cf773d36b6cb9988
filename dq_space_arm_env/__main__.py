"""`python -m dq_space_arm_env` is the command line `dq-space-arm`; it lives in `agents.command_line`."""

import sys

from agents.command_line import main

if __name__ == "__main__":
    sys.exit(main())
