"""The command `config`: which settings hold."""

from __future__ import annotations

from contextlib import suppress

import click
import msgspec
from click.shell_completion import get_completion_class, shell_complete

from bilprov.analyzer.cli.command import argument, command, protocol_in_use
from bilprov.analyzer.cli.options import FormatOption
from bilprov.analyzer.cli.settings import DEVICE, META, Tables, defaults_of
from bilprov.spec.errors import UserError


@command(FormatOption)
def config(options: FormatOption) -> None:
    """Examples:
      bilprov config
      bilprov config --format json

    Settings are read from config.toml in $XDG_CONFIG_HOME/bilprov (or ~/.config/bilprov). It has
    settings for all commands at its top (baud, parity, stopbits, echo, truncation-timeout, probe,
    grammar, time, columns, yes), a table for each command with any of its options, like [sniff] and
    [capture.cut], and named devices, which then stand for their port: [device.car] port =
    "/dev/ttyUSB0", baud = 9600. Options that are typed come before all of them. A setting that its
    command would refuse is refused here too (2).
    """
    from bilprov.analyzer.output import console

    root = click.get_current_context().find_root()
    tables: Tables = root.meta[META]
    rows = [
        {"command": name or "all", "setting": key, "value": value}
        for name, values in tables.items()
        for key, value in values.items()
    ]
    if rows:
        protocol_in_use()
        _require_taken(root, tables)
    if options.style == "json":
        console.show_json(rows)
    elif rows:
        cells = [[str(cell) for cell in row.values()] for row in rows]
        console.show(console.table(tuple(rows[0]), cells))
    else:
        click.echo("nothing is set; bilprov config --help explains where and how")


def _require_taken(ctx: click.Context, tables: Tables) -> None:
    """Raise what a command below `ctx` would, for a setting that it does not know or take."""
    group = ctx.command
    assert isinstance(group, click.Group)
    devices = [values for name, values in tables.items() if name.startswith(DEVICE)]
    for name in group.list_commands(ctx):
        _, command, _ = group.resolve_command(ctx, [name])
        assert command is not None
        if isinstance(command, click.Group):
            _require_taken(click.Context(command, ctx, name), tables)
        for values in ({}, *devices):
            below = click.Context(command, ctx, name)
            below.default_map = {**(below.default_map or {}), **defaults_of(command, values)}
            for param in command.params:
                if param.name in below.default_map:
                    param.handle_parse_result(below, {}, [])


VARIABLE = "_BILPROV_COMPLETE"  # of the environment; tells that a shell asks


class CompletionOptions(msgspec.Struct, frozen=True):
    """The options of `completion`."""

    shell: str = argument(type=click.Choice(["bash", "zsh", "fish"]))


@command(CompletionOptions)
def completion(options: CompletionOptions) -> None:
    """Examples:
      bilprov completion bash

    It completes subcommands, options and values. To install it:

    bash: eval "$(bilprov completion bash)" in ~/.bashrc

    zsh: eval "$(bilprov completion zsh)" in ~/.zshrc, after compinit

    fish: bilprov completion fish > ~/.config/fish/completions/bilprov.fish
    """
    script = get_completion_class(options.shell)
    assert script is not None
    click.echo(
        script(click.get_current_context().find_root().command, {}, "bilprov", VARIABLE).source()
    )


def answer(root: click.Command, asked: str) -> int:
    """Print what a shell's script asks for; nothing where the line has an error."""
    with suppress(UserError, click.ClickException, OSError):
        return shell_complete(root, {}, "bilprov", VARIABLE, asked)
    return 0
