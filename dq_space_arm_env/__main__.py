"""`python -m dq_space_arm_env`: the command line `dq-space-arm`."""

import sys

from dq_space_arm_env.command_line import main

if __name__ == "__main__":
    sys.exit(main())
