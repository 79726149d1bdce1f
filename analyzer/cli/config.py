"""The command `config`: which settings hold, and where each of them is set."""

from __future__ import annotations

from collections.abc import Iterator

import click

from bilprov.analyzer.cli.options import text_format_option


@click.group()
def config() -> None:
    """Settings: of config.toml in $XDG_CONFIG_HOME/bilprov (or ~/.config/bilprov), of bilprov.toml
    in the working folder, and of the environment. Options come before all of them."""


@config.command()
@click.argument("name", metavar="[COMMAND]", required=False)
@text_format_option
def show(name: str | None, style: str) -> None:
    """Show every setting and where it is set; of a COMMAND all its options.

    A file has settings for all commands at its top (baud, parity, stopbits, truncation-timeout,
    probe, grammar, time, columns, yes), a table for each command with any of its options, and named
    devices, which then stand for their port: [device.car] port = "/dev/ttyUSB0", baud = 9600. The
    file of the working folder may come with somebody else's project, so it can set nothing that
    runs code or answers for you.

    Example: bilprov config show sniff
    """
    from bilprov.analyzer.output import console
    from bilprov.captures.text import printable

    rows = list(_rows(name))
    if style == "json":
        keys = ("command", "setting", "value", "source", "used")
        console.show_json([dict(zip(keys, row, strict=True)) for row in rows])
        return
    if not rows:
        click.echo("nothing is set; bilprov config show --help says where and how")
        return
    words = [
        (command, setting, printable(value), source if used else f"{source} (not used)")
        for command, setting, value, source, used in rows
    ]
    console.show(console.table(("command", "setting", "value", "from"), words))


def _rows(name: str | None) -> Iterator[tuple[str, str, object, str, bool]]:
    """Yield command, setting, value, source and whether it is the one that holds."""
    from bilprov.analyzer.cli.settings import options_of, with_settings
    from bilprov.analyzer.settings import read_settings

    ctx = click.get_current_context().find_root()
    front_door = ctx.command
    assert isinstance(front_door, click.Group)
    grammar = ctx.params.get("grammar")
    names = {one: one for one in front_door.list_commands(ctx)}
    settings = read_settings(names)
    for one in names:  # a value that its command would refuse is refused here too
        _, command, _ = front_door.resolve_command(ctx, [one])
        if command is not None:
            with_settings(command, one, settings, [], grammar)
    if name is not None:
        _, command, _ = front_door.resolve_command(ctx, [name])
        assert command is not None
        values = settings.values_of(name)
        for key, option in options_of(command).items():
            if key in values:
                yield name, key, values[key].value, values[key].source, True
            else:
                default = option.get_default(click.Context(command), call=True)
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
