"""Gives a command the settings of files and environment as the defaults of its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any

import click

from bilprov.analyzer.cli.failures import plain_words
from bilprov.analyzer.cli.options import compiled, row_style
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.settings import COMMON, PORT, Settings, SettingsError, Value
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

PORTS = {
    "sniff": ("host", "device", "bridge"),
    "replay": ("port",),
    "send": ("target",),
    "ports": ("names",),
    "lab line": ("a", "b"),
    "conform": ("target",),
}
"""The parameters of each command that may be a named device."""


def _columns(names: str, protocol: Protocol) -> object:
    return row_style(None, names, protocol)


_NAMING: Mapping[str, Callable[[str, Protocol], object]] = {
    "expression": compiled,
    "columns": _columns,
}
"""The parameters whose values have names of the grammar, each with what refuses others."""


def spelling(param: click.Parameter) -> str:
    """The key of an option in a settings file: its longest spelling without the dashes."""
    return max(param.opts, key=len).lstrip("-")


def options_of(command: click.Command) -> dict[str, click.Parameter]:
    """The options of a command by their key; those that only print something are no settings."""
    return {
        spelling(param): param
        for param in command.params
        if isinstance(param, click.Option) and param.expose_value
    }


def with_settings(
    command: click.Command,
    name: str,
    settings: Settings,
    arguments: Sequence[str],
    grammar: str | None,
) -> tuple[click.Command, dict[str, Any]]:
    """The command, for which a device's name stands for its port, and the defaults of its options.

    The defaults are as click takes them from the context above: by command and parameter. Filters
    and columns are checked by the grammar that the arguments name, else by `grammar`. Raises
    SettingsError for a setting that the command does not have, and for a value that its option does
    not take.
    """
    context = command.context_class(command, info_name=name, resilient_parsing=True)
    given, _, _ = command.make_parser(context).parse_args(list(arguments))
    if isinstance(given.get("grammar"), str):  # behind the command, which has not taken it yet
        grammar = given["grammar"]
    named = _devices_named(name, settings, given)
    device: dict[str, Value] = {}
    for values in named.values():
        device |= values
    if named:
        ports = {word: values[PORT].value for word, values in named.items()}
        command = copy(command)
        command.params = [
            _naming_ports(param, ports) if param.name in PORTS[name] else param
            for param in command.params
        ]
    values = settings.values_of(name, device)
    defaults = _defaults(command, name, values, set(device), grammar)
    return command, {name.rpartition(" ")[2]: defaults}


def _devices_named(
    name: str, settings: Settings, given: Mapping[str, Any]
) -> dict[str, dict[str, Value]]:
    """The devices that the parsed arguments name, by the word that does."""
    words: set[str] = set()
    for port in PORTS.get(name, ()):
        value = given.get(port)
        words |= {value} if isinstance(value, str) else set()
        words |= set(value) if isinstance(value, list | tuple) else set()
    found = {word: settings.device(word) for word in words}
    return {word: device for word, device in found.items() if device is not None}


def _naming_ports(param: click.Parameter, ports: Mapping[str, Any]) -> click.Parameter:
    """The parameter, converting a device's name to its port."""
    kind = copy(param.type)
    convert = kind.convert

    def named(value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return convert(ports.get(value, value), param, ctx)

    kind.convert = named  # type: ignore[method-assign]
    other = copy(param)
    other.type = kind
    return other


def _defaults(
    command: click.Command,
    name: str,
    values: Mapping[str, Value],
    device: set[str],
    grammar: str | None,
) -> dict[str, Any]:
    """The values by parameter, as click would have converted them. Raises SettingsError."""
    options = options_of(command)
    context = click.Context(command, info_name=name)
    defaults: dict[str, Any] = {}
    for key, (value, source) in values.items():
        option = options.get(key)
        if option is None or option.name is None:
            if key in COMMON or key in device:  # for other commands
                continue
            from difflib import get_close_matches

            near = get_close_matches(key, options, n=1)
            meant = f", did you mean {near[0]}?" if near else f"; see bilprov {name} --help"
            raise SettingsError(f"{source}: {name} has no option {printable(key)}{meant}")
        if option.multiple and isinstance(value, str):
            value = value.split()
        if isinstance(value, list) and not option.multiple:
            raise SettingsError(f"{source}: {key} is a list, allowed is one value")
        given = _as_typed(value, option)
        checked = _NAMING.get(option.name)
        protocol = load_protocol(grammar) if checked else None
        try:
            option.type_cast_value(context, given)
            if checked and protocol:
                checked(str(value), protocol)
        except (click.BadParameter, UserError) as error:
            said = plain_words(str(error))
            raise SettingsError(f"{source}: {key} = {printable(value)}: {said}") from error
        defaults[option.name] = given
    return defaults


def _as_typed(value: Any, option: click.Parameter) -> Any:
    """A value as it would be typed: click converts texts, and trips over numbers of other kinds."""
    if isinstance(value, list):
        return [_as_typed(part, option) for part in value]
    is_flag = isinstance(option, click.Option) and option.is_flag
    return value if isinstance(value, bool) and is_flag else str(value)
