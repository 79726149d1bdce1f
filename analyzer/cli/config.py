"""The command `config`: which settings hold, and where each of them is set."""

from __future__ import annotations

from collections.abc import Iterator

import click

from bilprov.analyzer.cli.options import text_format_option
from bilprov.analyzer.output.help import command_names


@click.command()
@click.argument("words", metavar="[COMMAND]...", nargs=-1)
@text_format_option
def show(words: tuple[str, ...], style: str) -> None:
    """Show every setting and where it is set; for a COMMAND, all its options.

    Examples:
      bilprov config show
      bilprov config show capture cut

    A file has settings for all commands at its top (baud, parity, stopbits, truncation-timeout,
    probe, grammar, time, columns, yes), a table for each command with any of its options, like
    [sniff] and [capture.cut], and named devices, which then stand for their port: [device.car]
    port = "/dev/ttyUSB0", baud = 9600. The file of the working folder may come with somebody else's
    project, so it can set nothing that runs code or answers for you.
    """
    from bilprov.analyzer.output import console
    from bilprov.captures.text import printable

    rows = list(_rows(" ".join(words)))
    if style == "json":
        keys = ("command", "setting", "value", "source", "used")
        console.show_json([dict(zip(keys, row, strict=True)) for row in rows])
        return
    if not rows:
        click.echo("nothing is set; bilprov config show --help explains where and how")
        return
    cells = [
        (command, setting, printable(value), source if used else f"{source} (not used)")
        for command, setting, value, source, used in rows
    ]
    console.show(console.table(("command", "setting", "value", "from"), cells))


def _rows(name: str) -> Iterator[tuple[str, str, object, str, bool]]:
    """Yield command, setting, value, source and whether it is the one that holds."""
    from bilprov.analyzer.cli.settings import options_of, with_settings
    from bilprov.analyzer.settings import read_settings

    ctx = click.get_current_context().find_root()
    grammar = ctx.params.get("grammar")
    names = dict.fromkeys(command_names(ctx.command, ctx))
    settings = read_settings(names)
    for one in names:  # a value that its command would refuse is refused here too
        with_settings(_loaded(ctx, one), one, settings, [], grammar)
    if name:
        values = settings.values_of(name)
        for key, option in options_of(_loaded(ctx, name)).items():
            if key in values:
                yield name, key, values[key].value, values[key].source, True
            else:
                default = option.get_default(click.Context(click.Command(name)), call=True)
                shown = default if isinstance(default, str | int | float | tuple) else ""
                yield name, key, shown, "the command's default", True
        return
    for layer in settings.layers:
        later = settings.layers[settings.layers.index(layer) + 1 :]
        for key, value in layer.common.items():
            used = not any(key in other.common for other in later)
            yield "all", key, value.value, value.source, used
        for command_name, table in layer.commands.items():
            for key, value in table.items():
                used = not any(key in other.values_of(command_name) for other in later)
                yield command_name, key, value.value, value.source, used
        for device, table in layer.devices.items():
            for key, value in table.items():
                used = settings.devices[device].get(key) is value
                yield f"device {device}", key, value.value, value.source, used


def _loaded(ctx: click.Context, name: str) -> click.Command:
    """The command of that name. Raises UsageError where there is none."""
    command = ctx.command
    for word in name.split():
        if not isinstance(command, click.Group):
            raise click.UsageError(f"there is no bilprov {name}")
        _, below, _ = command.resolve_command(ctx, [word])
        assert below is not None
        command = below
    return command
