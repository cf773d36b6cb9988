"""The program: its verbs, and how every run ends, in an exit status and at most one sentence."""

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn

import click

from agents.command_line.comparing import compare
from agents.command_line.completion import completion
from agents.command_line.demonstrations import demonstrations
from agents.command_line.info import info, version_option
from agents.command_line.learning import evaluate, train
from agents.command_line.output import complain
from agents.command_line.replay import replay
from agents.command_line.report import report
from agents.command_line.scenes import scenes
from agents.command_line.simulate import simulate
from agents.command_line.solve import solve
from agents.command_line.verb import (
    DEBUG_VARIABLE,
    FAILURE,
    INTERNAL,
    SUCCESS,
    UNUSABLE,
    Interrupted,
    Session,
    Verbs,
    VerbsWithDefault,
)

PROGRAM = "dq-space-arm"
_OURS = ("agents", "dq_space_arm_env", "experts")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""Errors of a disk that takes no more; nothing is wrong with what the user has asked for."""


class Program(Verbs):
    """The verbs, with our own way to end."""

    def main(self, args: Sequence[str] | None = None, *_: Any, **settings: Any) -> NoReturn:
        """Run a command line, and end the process as it went.

        Args:
            args: Command line without the program's name; that of the process if None.
            *_: The program's name, which is always the same.
            **settings: For Click.

        Raises:
            SystemExit: Always.
        """
        _open_what_is_closed()
        session = Session.of_environment()
        settings |= {"prog_name": PROGRAM, "standalone_mode": False, "obj": session}
        with warnings.catch_warnings():
            warnings.showwarning = partial(_warn, session, warnings.showwarning)
            sys.exit(run_to_end(lambda: super(Program, self).main(args, **settings), session))


def run_to_end(run: Callable[[], Any], session: Session) -> int:
    """Run something; whatever ends it becomes an exit status.

    Args:
        run: Does the work; its result is an exit status, or None.
        session: Says whether tracebacks are wanted.

    Returns:
        Exit status.
    """
    try:
        status = run()
        sys.stdout.flush()
    except BrokenPipeError:
        return FAILURE  # quietly: whoever read our output has seen enough
    except SystemExit as end:  # of shell completion, and of verbs with a parser of their own
        return end.code if isinstance(end.code, int) else SUCCESS if end.code is None else FAILURE
    except (Exception, KeyboardInterrupt) as error:
        if session.debug:
            traceback.print_exc()
        return _explain(error)
    finally:
        _give_up_output_that_cannot_be_written()
    return SUCCESS if status is None else int(status)


def _explain(error: BaseException) -> int:
    """Say in one sentence what was wrong, and find the exit status."""
    if isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError):
        error = error.__cause__  # Click takes it for Ctrl-D at a prompt, and there are none
    if isinstance(error, click.Abort | KeyboardInterrupt):
        error = Interrupted()
    if isinstance(error, Interrupted):
        complain(error.message, label="")
        return error.exit_code
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
        return error.exit_code
    if isinstance(error, click.ClickException):
        complain(" ".join(error.format_message().split()) + _where_help_is(error))
        return error.exit_code
    if isinstance(error, OSError):
        complain(_in_words(error))
        return FAILURE if error.errno in _FULL else UNUSABLE
    if isinstance(error, ValueError | ImportError):
        complain(str(error))
        return UNUSABLE
    # An error of our own is written for users.
    if type(error).__module__.partition(".")[0] in _OURS:
        complain(str(error))
        return FAILURE
    complain(
        f"{type(error).__name__}: {error}. This should not happen: please report it with the output of "
        f"`{PROGRAM} info` and with the traceback that --debug (or {DEBUG_VARIABLE}=1) shows."
    )
    return INTERNAL


def _where_help_is(error: click.ClickException) -> str:
    context = error.ctx if isinstance(error, click.UsageError) else None
    if context is None:
        return ""
    above = context.parent
    group = None if above is None else above.command
    if isinstance(group, VerbsWithDefault) and group.default is context.command:
        context = above or context  # its help is the default's, and names the other verbs
    return f" (see {context.command_path} --help)"


def _warn(
    session: Session, usual: Callable[..., None], message: Warning | str, *details: Any, **more: Any
) -> None:
    """Show a warning as users read it, with the line of code that it comes from only if they debug."""
    if session.debug:
        usual(message, *details, **more)
    else:
        complain(str(message), label="Warning: ")


def _open_what_is_closed() -> None:
    """Of a process that began without output, as some that are started by others do, it goes nowhere."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def _in_words(error: OSError) -> str:
    """What the system says, without its number."""
    file = error.filename2 or error.filename
    if error.strerror is None:
        return str(error)
    return error.strerror if file is None else f"{file}: {error.strerror}"


def _give_up_output_that_cannot_be_written() -> None:
    """What is still buffered goes nowhere, rather than fail again when the interpreter ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    examples="""
        scenes list                                  # what there is to fly
        solve paper                                  # the optimal maneuver of the paper's scene
        simulate paper --policy gains --noise 0.05   # fly it with disturbed inputs
        scenes new my.yaml                           # a scene of your own, to be edited
        info                                         # what a bug report needs
        completion bash                              # TAB for verbs, scenes and policies
    """,
)
@version_option
def program() -> None:
    """A spacecraft with an arm, in dual quaternions: simulate, solve, learn, measure.

    Every verb has its own --help. Exit status: 0; 1 if the result is not as it should be; 2 if the input is
    unusable; 70 after a mistake of the program's own; 130 if interrupted.
    """


for _verb in (
    scenes,
    solve,
    simulate,
    replay,
    demonstrations,
    train,
    evaluate,
    compare,
    report,
    info,
    completion,
):
    program.add_command(_verb)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line.

    Args:
        arguments: Without the program's name; those of the process if None.

    Returns:
        Exit status.
    """
    try:
        program.main(arguments)
    except SystemExit as end:
        return int(end.code or 0)
