"""The command line `dq-space-arm`: one program with a verb for everything that the project does.

program         the verbs together, and how every mistake ends: in one sentence and an exit status
verb            what verbs have in common: examples, --debug, --json, interrupts
names           names of scenes, configurations and policies, for the shell's completion
output          where tables, documents and progress go
results         options that say where a measurement's results go
scenes, solve, simulate, demonstrations, learning, comparing, report, replay, info, completion   the verbs
scene_summary, scene_problems, scene_template, scene_exchange   what `scenes` does
starts, solving, simulating   what `solve` and `simulate` do

Modules down to the verbs import Click and little else: what a verb does is imported when it runs, so that
help is there at once. It stands above environment, experts and agents; only `scripts`
and the modules that are run by `python -m` import it.
"""

from agents.command_line.program import main

__all__ = ["main"]
