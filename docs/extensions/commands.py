"""The pages of the command line, from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator

import click

from dq_space_arm_env.command_line.verb_program import program

PROGRAM = "dq-space-arm"
HELP = ["-h", "--help"]


def command_pages() -> str:
    """Write the verbs with arguments, options and examples.

    Returns:
        Markdown, its headings of level 2, and 3 for verbs of a verb.
    """
    return "\n".join(_sections(program, PROGRAM, 1))


def all_commands() -> dict[str, click.Command]:
    """Collect the commands.

    Returns:
        By the words that call them, "dq-space-arm scenes list".
    """
    return dict(_walk(program, PROGRAM))


def _walk(command: click.Command, words: str) -> Iterator[tuple[str, click.Command]]:
    yield words, command
    if isinstance(command, click.Group):
        for name, inner in _commands(command).items():
            yield from _walk(inner, f"{words} {name}")


def _commands(command: click.Command) -> dict[str, click.Command]:
    if not isinstance(command, click.Group):
        return {}
    context = click.Context(command)
    found = {name: command.get_command(context, name) for name in command.list_commands(context)}
    return {name: inner for name, inner in found.items() if inner is not None}


def _sections(command: click.Command, words: str, level: int) -> Iterator[str]:
    if level > 1:
        yield f"{'#' * level} `{words.removeprefix(PROGRAM + ' ')}`\n"
    yield _help(command, words)
    for name, inner in _commands(command).items():
        yield from _sections(inner, f"{words} {name}", level + 1)


def _help(command: click.Command, words: str) -> str:
    *before, last = words.split()
    context: click.Context | None = None
    for word in before:
        context = click.Context(program, context, info_name=word, help_option_names=HELP)
    with click.Context(command, context, last, help_option_names=HELP, terminal_width=90) as inner:
        text = command.get_help(inner)
    return f"```text\n{click.unstyle(text)}\n```\n"
