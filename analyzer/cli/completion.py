"""Completion in shells, by click's own scripts: `bilprov completion`, and what answers them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import click
from click.shell_completion import get_completion_class, shell_complete

from bilprov.analyzer.cli.command import argument, command
from bilprov.spec.errors import UserError

VARIABLE = "_BILPROV_COMPLETE"  # of the environment; tells that a shell asks

# How to install the completion script permanently in each shell.
INSTALL = {
    "bash": 'eval "$(bilprov completion bash)" in ~/.bashrc',
    "zsh": 'eval "$(bilprov completion zsh)" in ~/.zshrc, after compinit',
    "fish": "bilprov completion fish > ~/.config/fish/completions/bilprov.fish",
}


@dataclass(frozen=True)
class CompletionOptions:
    """The options of `completion`."""

    shell: str = argument(type=click.Choice(list(INSTALL)))


@command(
    CompletionOptions, epilog="\n\n".join(f"{shell}: {line}" for shell, line in INSTALL.items())
)
def completion(options: CompletionOptions) -> None:
    """Examples:
      bilprov completion bash

    It completes subcommands, options and values.
    """
    script = get_completion_class(options.shell)
    assert script is not None
    click.echo(
        script(click.get_current_context().find_root().command, {}, "bilprov", VARIABLE).source()
    )


def answer(root: click.Command, asked: str) -> int:
    """Print what a shell's script asks for; nothing where the line has an error."""
    with suppress(UserError, OSError):
        return shell_complete(root, {}, "bilprov", VARIABLE, asked)
    return 0
