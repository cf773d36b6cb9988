"""`dq-space-arm completion`: the shell's completion script."""

import click


@click.command(
    help="""Print the script that completes verbs, options, scenes, configurations and policies in SHELL.

    To enable it, add a line to the shell's start-up file:

    \b
    bash, ~/.bashrc                       eval "$(dq-space-arm completion bash)"
    zsh, ~/.zshrc, after compinit         eval "$(dq-space-arm completion zsh)"
    fish, ~/.config/fish/config.fish      dq-space-arm completion fish | source
    """,
    short_help="Complete words in bash, zsh or fish.",
    epilog="""\b
        Examples:
          dq-space-arm completion bash  # print the script
    """,
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print a completion script."""
    from click.shell_completion import get_completion_class

    context = click.get_current_context().find_root()
    name = str(context.info_name)
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(context.command, {}, name, f"_{name.replace('-', '_').upper()}_COMPLETE").source())
