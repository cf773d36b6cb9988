"""The command line `dq-space-arm`.

`program` collects verbs from entry points; any installed package can add one. A verb's module imports Click
and little else, and its work when it runs: help must appear at once.
"""

from dq_space_arm_env.command_line.verb_program import main

__all__ = ["main"]
