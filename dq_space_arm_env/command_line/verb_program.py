"""The program `dq-space-arm`: the verbs of all installed packages, each run ending in an exit status."""

import errno
import os
import sys
import threading
import traceback
import warnings
from _thread import interrupt_main
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NoReturn

import click

from dq_space_arm_env.command_line.info import version_option
from dq_space_arm_env.command_line.verb import Interrupted
from dq_space_arm_env.common.console import FAILURE, INTERNAL, SUCCESS, UNUSABLE, complain
from dq_space_arm_env.common.entry_points import entry_points, load

PROGRAM = "dq-space-arm"
GROUP = "dq_space_arm.verbs"
"""Entry-point group: a package adds a verb by naming a Click command here."""
DEBUG_VARIABLE = "DQ_SPACE_ARM_DEBUG"
_OURS = ("agents", "dq_space_arm_env", "experts")
_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENOMEM)
"""Errors of the disk or the memory rather than of what the user asked for."""


def _switch_debug_on(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value:
        context.ensure_object(dict)["debug"] = True


_debug_option = click.Option(
    ["--debug"],
    is_flag=True,
    expose_value=False,
    callback=_switch_debug_on,
    help=f"Show tracebacks of errors; {DEBUG_VARIABLE}=1 does the same.",
)


def _add_debug_option(command: click.Command) -> None:
    if _debug_option not in command.params:
        command.params.append(_debug_option)
        for inner in getattr(command, "commands", {}).values():
            _add_debug_option(inner)


class Program(click.Group):
    """The verbs, each imported when it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the verbs of all installed packages."""
        if not entry_points(GROUP):
            raise ImportError("the installation lists no verbs: install dq-space-arm again")
        return list(entry_points(GROUP))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a verb."""
        known = self.list_commands(ctx)
        if cmd_name not in known:
            if cmd_name.startswith("-") or ctx.resilient_parsing:
                return None
            raise click.exceptions.NoSuchCommand(cmd_name, possibilities=known, ctx=ctx)
        command: click.Command = load(entry_points(GROUP)[cmd_name])
        _add_debug_option(command)
        return command

    def main(self, args: Sequence[str] | None = None, *_: Any, **settings: Any) -> NoReturn:
        """Run a command line and exit; `args` are the process's by default.

        Raises:
            SystemExit: Always.
        """
        _replace_closed_streams()
        session = {"debug": _debug_by_default()}
        settings |= {"prog_name": PROGRAM, "standalone_mode": False, "obj": session}
        with warnings.catch_warnings():
            warnings.showwarning = partial(_warn, session, warnings.showwarning)
            sys.exit(run_to_end(lambda: super(Program, self).main(args, **settings), session))


def _debug_by_default() -> bool:
    return os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")


def run_to_end(run: Callable[[], Any], session: Mapping[str, bool] | None = None) -> int:
    """Run something; turn its result, or the error that ends it, into an exit status.

    Without a session, the environment variable alone asks for tracebacks.
    """
    session = {"debug": _debug_by_default()} if session is None else session
    try:
        with _no_interrupt_lost(), _threads_in_sentences(session):
            status = run()
        sys.stdout.flush()
    except BrokenPipeError:
        return FAILURE  # quietly: the reader of our output has seen enough
    except SystemExit as end:  # shell completion
        return end.code if isinstance(end.code, int) else SUCCESS if end.code is None else FAILURE
    except (Exception, KeyboardInterrupt) as error:
        if session["debug"]:
            traceback.print_exc()
        return _explain(error)
    finally:
        _discard_unwritable_output()
    return SUCCESS if status is None else int(status)


@contextmanager
def _no_interrupt_lost() -> Iterator[None]:
    """Repeat interrupts that Python drops inside a block, as it does in callbacks and finalizers."""
    usual = sys.unraisablehook

    def repeat(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, interrupt_main).start()  # once the callback has returned
        else:
            usual(dropped)

    sys.unraisablehook = repeat
    try:
        yield
    finally:
        sys.unraisablehook = usual


@contextmanager
def _threads_in_sentences(session: Mapping[str, bool]) -> Iterator[None]:
    """Show what the disk refuses to a library's thread as a sentence, inside a block."""
    usual = threading.excepthook

    def show(failed: threading.ExceptHookArgs) -> None:
        error = failed.exc_value
        if isinstance(error, OSError) and not session["debug"]:
            complain(error.strerror or str(error), label="Warning: ")
        else:
            usual(failed)

    threading.excepthook = show
    try:
        yield
    finally:
        threading.excepthook = usual


def _explain(error: BaseException) -> int:
    """Print one sentence about an error; return the exit status."""
    if isinstance(error, click.Abort) and isinstance(error.__cause__, EOFError):
        error = error.__cause__  # Click takes it for Ctrl-D at a prompt; we have no prompts
    if isinstance(error, click.Abort | KeyboardInterrupt):
        error = Interrupted()
    if isinstance(error, Interrupted):
        complain(error.message, label="")
        return error.exit_code
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
        return error.exit_code
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        see = "" if context is None else f" (see {context.command_path} --help)"
        message = " ".join(error.format_message().split())
        if message.startswith("Got unexpected extra") and any(
            "--scene" in param.opts for param in getattr(getattr(context, "command", None), "params", ())
        ):
            message += "; here a scene is given as --scene SCENE"
        complain(message + see)
        return error.exit_code
    if _is_out_of_memory(error):
        error.__traceback__ = None  # its frames hold what could be freed
        # Plainly: the console would need memory of its own.
        said = "" if isinstance(error, MemoryError) else f" ({type(error).__name__}: {error})"
        print(f"Error: out of memory{said}; finished files are complete, repeat the command", file=sys.stderr)
        return FAILURE
    if isinstance(error, OSError):
        file = error.filename2 or error.filename
        reason = error.strerror or str(error)
        complain(reason if file is None else f"{file}: {reason}")
        return FAILURE if error.errno in _MACHINE else UNUSABLE
    if isinstance(error, ValueError | ImportError):
        complain(str(error))
        return UNUSABLE
    # The project's own exceptions carry a message for the user.
    if type(error).__module__.partition(".")[0] in _OURS:
        complain(str(error))
        return FAILURE
    complain(
        f"{type(error).__name__}: {error}. This is a bug: please report it with the output of "
        f"`{PROGRAM} info` and the traceback that --debug (or {DEBUG_VARIABLE}=1) shows."
    )
    return INTERNAL


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Tell whether memory ran out, in this error or in one that it followed.

    A SystemError is how that ends where the interpreter has no memory for the error itself.
    """
    while error is not None:
        if isinstance(error, MemoryError | SystemError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _warn(
    session: dict[str, bool], usual: Callable[..., None], message: Warning | str, *details: Any, **more: Any
) -> None:
    """Show a warning as a sentence; with --debug, with the line of code that raised it."""
    if session["debug"]:
        usual(message, *details, **more)
    else:
        complain(str(message), label="Warning: ")


def _replace_closed_streams() -> None:
    """Send output to /dev/null in a process that was started without stdout or stderr."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def _discard_unwritable_output() -> None:
    """Drop buffered output that cannot be written, or the interpreter would fail again as it exits."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    params=[_debug_option],
    epilog="""\b
        Examples:
          dq-space-arm scenes list                                 # the scenes that ship
          dq-space-arm solve paper                                 # the optimal maneuver of the paper
          dq-space-arm simulate paper --policy gains --noise 0.05  # fly it with disturbed inputs
          dq-space-arm scenes new my.yaml                          # write a scene of your own
          dq-space-arm info                                        # versions, for a bug report
          dq-space-arm completion bash                             # complete words with TAB
    """,
)
@version_option
def program() -> None:
    """A spacecraft with an arm, in dual quaternions: simulate, solve, learn, measure.

    Every verb has its own --help. Exit status: 0 success; 1 the result falls short of what was asked, in the
    ways that the verb's help names; 2 unusable input; 70 a bug; 130 interrupted.
    """


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line, the process's by default, and return the exit status."""
    try:
        program.main(arguments)
    except SystemExit as end:
        return int(end.code or 0)
