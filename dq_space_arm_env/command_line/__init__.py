"""The command line `dq-space-arm`.

`program` collects verbs from entry points; any installed package can add one. A verb's module imports Click
and little else, and its work when it runs: help must appear at once.
"""

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, the process's by default, and return the exit status."""
    try:
        # Importing takes most of a short verb's time, in which Ctrl-C may be pressed as well.
        from dq_space_arm_env.command_line.verb_program import main as run
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted: nothing is saved.\n")
        return 130
    return run(arguments)
