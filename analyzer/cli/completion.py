"""Completion in shells, by click's own scripts: `bilprov completion`, and what answers them."""

from __future__ import annotations

import re
from contextlib import suppress

import click
from click.shell_completion import get_completion_class, shell_complete

from bilprov.spec.errors import UserError

VARIABLE = "_BILPROV_COMPLETE"  # of the environment; tells that a shell asks
_FILE = re.compile(r"\[?(FILE|IN|OUT|REPORT|A)\b")  # how the metavar of a file begins

# How to install the completion script permanently in each shell.
INSTALL = {
    "bash": 'eval "$(bilprov completion bash)" in ~/.bashrc',
    "zsh": 'eval "$(bilprov completion zsh)" in ~/.zshrc, after compinit',
    "fish": "bilprov completion fish > ~/.config/fish/completions/bilprov.fish",
}


@click.command(epilog="\n\n".join(f"{shell}: {line}" for shell, line in INSTALL.items()))
@click.argument("shell", type=click.Choice(list(INSTALL)))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the script that completes bilprov's subcommands, options and values in a shell.

    Examples:
      bilprov completion bash
    """
    script = get_completion_class(shell)
    assert script is not None
    click.echo(script(ctx.find_root().command, {}, "bilprov", VARIABLE).source())


def answer(root: click.Command, asked: str) -> int:
    """Print what a shell's script asks for; nothing where the line has an error."""
    with suppress(UserError, OSError):
        return shell_complete(root, {}, "bilprov", VARIABLE, asked)
    return 0


def with_files(command: click.Command) -> None:
    """Let click complete the parameters whose metavar is a file's."""
    for param in command.params:
        if param.type is click.STRING and _FILE.match(param.metavar or ""):
            param.type = click.Path()
