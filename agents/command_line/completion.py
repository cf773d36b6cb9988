"""`dq-space-arm completion`: what a shell needs to complete verbs, options, scenes and policies."""

import click

from agents.command_line.verb import Verb

SHELLS = ("bash", "zsh", "fish")
_HELP = """Print the script that completes verbs, options, scenes, configurations and policies in SHELL.

A line in the start-up file of the shell switches it on:

\b
bash, ~/.bashrc                       eval "$(dq-space-arm completion bash)"
zsh, ~/.zshrc, after compinit         eval "$(dq-space-arm completion zsh)"
fish, ~/.config/fish/config.fish      dq-space-arm completion fish | source
"""


@click.command(
    cls=Verb,
    help=_HELP,
    short_help="Complete words in bash, zsh or fish.",
    examples="completion bash   # print the script",
)
@click.argument("shell", type=click.Choice(SHELLS))
def completion(shell: str) -> None:
    """Print the script that completes words in a shell."""
    from click.shell_completion import get_completion_class

    context = click.get_current_context().find_root()
    name = str(context.info_name)
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(context.command, {}, name, f"_{name.replace('-', '_').upper()}_COMPLETE").source())
