"""What verbs have in common: examples in their help, --debug, --json, and what an interrupt leaves."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import dropwhile
from typing import Any

import click

SUCCESS, FAILURE, UNUSABLE, INTERNAL, INTERRUPTED = 0, 1, 2, 70, 130
"""Exit statuses: done; done, and not well; unusable input; a mistake of the program's own; interrupted."""
DEBUG_VARIABLE = "DQ_SPACE_ARM_DEBUG"


@dataclass
class Session:
    """What one run of the program remembers, the `obj` of Click's contexts.

    Attributes:
        debug: Whether errors come with their traceback.
    """

    debug: bool = False

    @classmethod
    def of_environment(cls) -> "Session":
        """A session as the environment variables say."""
        return cls(debug=os.environ.get(DEBUG_VARIABLE, "") not in ("", "0"))


class Failure(click.ClickException):
    """What was asked for cannot be done, or has gone wrong; the message says why."""

    exit_code = FAILURE


class Interrupted(click.ClickException):
    """The user has interrupted a verb; the message says what is kept."""

    exit_code = INTERRUPTED

    def __init__(self, kept: str = "nothing is saved") -> None:
        """Set up.

        Args:
            kept: What remains, and how to go on.
        """
        super().__init__(f"Interrupted: {kept}.")


@contextmanager
def keeping(kept: str) -> Iterator[None]:
    """Say what remains if the user interrupts what is done meanwhile.

    Args:
        kept: What remains, and how to go on.

    Yields:
        Nothing.

    Raises:
        Interrupted: In place of KeyboardInterrupt.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(kept) from error


def _remember_debug(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value:
        context.ensure_object(Session).debug = True


class Verb(click.Command):
    """A verb; its epilog are examples, a command and a comment in each line, printed as they stand."""

    def __init__(self, *args: Any, examples: str = "", **settings: Any) -> None:
        """Set up.

        Args:
            *args: For Click.
            examples: Lines of the form "command  # comment", without the program's name.
            **settings: For Click.
        """
        super().__init__(*args, **settings)
        self.examples = examples.strip()
        self.params.append(debug_option())

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples.

        Args:
            ctx: Of the verb.
            formatter: Where to write.
        """
        write_examples(formatter, ctx, self.examples)
        super().format_epilog(ctx, formatter)


class Verbs(click.Group):
    """Several verbs under one name."""

    command_class = Verb

    def __init__(self, *args: Any, examples: str = "", **settings: Any) -> None:
        """Set up.

        Args:
            *args: For Click.
            examples: As for `Verb`.
            **settings: For Click.
        """
        super().__init__(*args, **settings)
        self.examples = examples.strip()
        self.params.append(debug_option())

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the verbs in the order in which they were added, that of a user's way through them.

        Args:
            ctx: Of the group.

        Returns:
            Their names.
        """
        return list(self.commands)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples.

        Args:
            ctx: Of the group.
            formatter: Where to write.
        """
        write_examples(formatter, ctx, self.examples)
        super().format_epilog(ctx, formatter)


class ManyValued(Verb):
    """A verb whose repeatable options take several words at once: `--condition spin far`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat the option before each of its words."""
        repeatable = {
            name
            for parameter in self.params
            if isinstance(parameter, click.Option) and parameter.multiple
            for name in parameter.opts
        }
        words: list[str] = []
        option = ""
        for word in args:
            if word.startswith("-"):
                option = word if word in repeatable else ""
            elif option and words[-1] != option:
                words.append(option)
            words.append(word)
        return super().parse_args(ctx, words)


class VerbsWithDefault(Verbs):
    """Several verbs under one name, of which the first is meant where none is named."""

    @property
    def default(self) -> click.Command:
        """The verb that is meant where none is named."""
        return next(iter(self.commands.values()))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default's name where none stands."""
        mine = len(args) - len([*dropwhile(lambda word: word == "--debug", args)])
        first = args[mine] if mine < len(args) else ""
        if first not in (*self.commands, *ctx.help_option_names):
            args = [*args[:mine], str(self.default.name), *args[mine:]]
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the default's arguments and options, and which other verbs there are.

        Args:
            ctx: Of the group.
            formatter: Where to write.
        """
        self.default.format_options(ctx, formatter)
        self.format_commands(ctx, formatter)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """How it is used: as the default is.

        Args:
            ctx: Of the group.

        Returns:
            Pieces of the usage.
        """
        return self.default.collect_usage_pieces(ctx)


def debug_option() -> click.Option:
    """The option that shows tracebacks.

    Returns:
        The option; it is not passed on to the verb.
    """
    return click.Option(
        ["--debug"],
        is_flag=True,
        expose_value=False,
        callback=_remember_debug,
        help=f"Show tracebacks of errors; {DEBUG_VARIABLE}=1 does the same.",
    )


def write_examples(formatter: click.HelpFormatter, context: click.Context, examples: str) -> None:
    """Write examples, comments in a column of their own.

    Args:
        formatter: Where to write.
        context: Of the verb; gives the program's name.
        examples: Lines of the form "command  # comment", without the program's name.
    """
    if not examples:
        return
    program = context.find_root().info_name
    # A number sign within a word is no comment: "folder#3" is a demonstration.
    lines = [line.strip().partition(" # ")[::2] for line in examples.splitlines()]
    commands = [f"{program} {command.strip()}" for command, _ in lines]
    width = max(map(len, commands))
    with formatter.section("Examples"):
        for command, (_, comment) in zip(commands, lines, strict=True):
            text = f"{command:{width}}  # {comment.strip()}" if comment else command
            formatter.write(f"{'':{formatter.current_indent}}{text}\n")


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the option --json to a verb, its argument `as_json`.

    Args:
        function: The verb's function.

    Returns:
        The function with the option.
    """
    return click.option(
        "--json", "as_json", is_flag=True, help="Print one JSON document in place of tables."
    )(function)
