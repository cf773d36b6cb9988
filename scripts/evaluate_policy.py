"""Show an agent's flight beside the expert's; needs no PyTorch: `dq-space-arm evaluate show`."""

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
    return run_program(["evaluate", "show", *(sys.argv[1:] if arguments is None else arguments)])


if __name__ == "__main__":
    sys.exit(main())
