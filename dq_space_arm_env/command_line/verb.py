"""What verbs share: --json, interrupts, options of several words, groups with a default verb."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import dropwhile

import click

from dq_space_arm_env.common.console import INTERRUPTED

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document instead of tables."
)


class Interrupted(click.ClickException):
    """The user interrupted a verb; the message says what is kept."""

    exit_code = INTERRUPTED

    def __init__(self, kept: str = "files are complete, or as they were") -> None:
        super().__init__(f"Interrupted: {kept}.")


@contextmanager
def keeping(kept: str) -> Iterator[None]:
    """Turn a KeyboardInterrupt into `Interrupted`, whose message says what is kept and how to resume."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(kept) from error


class MultiWordCommand(click.Command):
    """A command whose repeatable options take several words at once: `--condition spin far`."""

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


class DefaultGroup(click.Group):
    """A group that runs its first command where none is named."""

    @property
    def default(self) -> click.Command:
        """The command that runs where none is named."""
        return next(iter(self.commands.values()))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """List the default first."""
        return list(self.commands)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Insert the default's name where none stands."""
        place = len(args) - len([*dropwhile(lambda word: word == "--debug", args)])
        first = args[place] if place < len(args) else ""
        if first not in (*self.commands, *ctx.help_option_names):
            args = [*args[:place], str(self.default.name), *args[place:]]
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Show the default's options above the list of commands."""
        self.default.format_options(ctx, formatter)
        self.format_commands(ctx, formatter)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """Show the default's usage."""
        return self.default.collect_usage_pieces(ctx)
