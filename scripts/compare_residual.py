"""Fly a corrected plan beside the plan alone, under mismatch: `dq-space-arm compare residual`."""

import sys
from collections.abc import Sequence

from agents.command_line import main as run_program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script.

    Args:
        arguments: Command line without the program's name; that of the process if None.

    Returns:
        Exit status.
    """
    return run_program(["compare", "residual", *(sys.argv[1:] if arguments is None else arguments)])


if __name__ == "__main__":
    sys.exit(main())
