"""What a shell offers for the values of arguments and options, by their metavars.

A command needs to do nothing for it: what is called EXPR in its help is a filter, PORT a serial
port, FILE.mcap a file. Other values have a function of their own (`shell_complete` of click).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeAlias

import click
from click.shell_completion import CompletionItem

from bilprov.analyzer.output.help import command_names

if TYPE_CHECKING:
    from bilprov.spec.protocol import InstructionSpec, Protocol

Item: TypeAlias = "CompletionItem[str]"
Complete: TypeAlias = Callable[[click.Context, click.Parameter, str], list[Item]]

_MOST_VALUES = 16  # of a field that are offered one by one


def protocol_of(ctx: click.Context) -> Protocol:
    """The protocol that the command line asks for."""
    from bilprov.analyzer.grammar_file import load_protocol

    return load_protocol(ctx.find_root().params.get("grammar"))


def beginning(incomplete: str, words: Iterable[tuple[str, str]]) -> list[Item]:
    """The words that begin so, in any case, each with what it says."""
    same = incomplete.lower()
    return [
        CompletionItem(word, help=says or None)
        for word, says in words
        if word.lower().startswith(same)
    ]


def filters(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """A filter as it can go on.

    A name alone is no filter: it is offered with each of its signs, so that no shell ends the word.
    """
    from bilprov.analyzer.filters.completion import completions

    protocol = protocol_of(ctx)

    def offered(text: str) -> list[tuple[str, str]]:
        found = completions(text, len(text), protocol)
        return [(text[: one.start] + one.text, one.says) for one in found]

    found = offered(incomplete)
    if len(found) == 1 and not _is_filter(protocol, found[0][0]):
        alone = found[0][0]
        found = offered(alone if alone.endswith("{") else f"{alone} ") or found
    return [CompletionItem(text, help=says or None) for text, says in found]


def _is_filter(protocol: Protocol, text: str) -> bool:
    from bilprov.analyzer.filters.filter import compile_filter
    from bilprov.analyzer.filters.parts import FilterError

    try:
        compile_filter(text, protocol)
    except FilterError:
        return False
    return True


def ports(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The serial ports of this machine, or where a path is begun that is none of them, files."""
    from bilprov.analyzer.transport.ports import list_ports

    words = [(port.path, port.description) for port in list_ports()]
    found = beginning(incomplete, _devices(ctx) + words)
    if not found and incomplete[:1] in ("/", ".", "~"):
        return files(ctx, param, incomplete)
    return found


def _devices(ctx: click.Context) -> list[tuple[str, str]]:
    """The named devices of the settings, each with its port; none if these cannot be read."""
    from bilprov.analyzer.cli.settings import PORT, SettingsError, read_settings

    try:
        tables = read_settings(_commands(ctx))
    except SettingsError:
        return []
    found = ((name.partition("device ")[2], values) for name, values in tables.items())
    return [(name, str(values[PORT])) for name, values in found if name]


def commands(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The commands, or those of the group that was named."""
    root = ctx.find_root()
    path = "".join(f"{word} " for word in ctx.params.get("words") or ())
    names = (name[len(path) :] for name in _commands(root) if name.startswith(path))
    return beginning(incomplete, ((name, "") for name in names if " " not in name))


def _commands(ctx: click.Context) -> list[str]:
    root = ctx.find_root()
    return list(command_names(root.command, root))


def files(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The files that the shell finds."""
    return [CompletionItem(incomplete, type="file")]


def instructions(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The instructions of the grammar."""
    specs = protocol_of(ctx).instructions
    return beginning(incomplete, ((spec.name, spec.prose) for spec in specs))


def fields(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """The fields of the instruction that was named, `rgb=`, and the values of small ones."""
    name = str(ctx.params.get("name", "")).lower()
    specs = protocol_of(ctx).instructions
    spec = next((spec for spec in specs if spec.name.lower() == name), None)
    given = [str(word).partition("=")[0] for word in ctx.params.get("values") or ()]
    return beginning(incomplete, _fields(spec, incomplete, given)) if spec else []


def _fields(
    spec: InstructionSpec, incomplete: str, given: Iterable[str]
) -> Iterable[tuple[str, str]]:
    from bilprov.spec.codec import bit_names

    for part in spec.fields:
        if part.name in given:
            continue
        values = range(part.low, part.high + 1)
        if len(values) > _MOST_VALUES or "=" not in incomplete:
            yield f"{part.name}=", f"{part.low} to {part.high}: {part.prose}"
            continue
        for value in values:
            says = " ".join(bit_names(part, value)) or "off" if part.bits else ""
            yield f"{part.name}={value}", says


def sent_items(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Item]:
    """What can be sent: instructions, and pauses."""
    pause = beginning(incomplete, [("pause=", "milliseconds")])
    return instructions(ctx, param, incomplete) + pause


BY_METAVAR: tuple[tuple[str, Complete], ...] = (
    (r"EXPR", filters),
    (r"PORT(\|.*)?|HOST|DEVICE", ports),
    (r"COMMAND", commands),
    (r"INSTRUCTION", instructions),
    (r"FIELD=VALUE", fields),
    (r"ITEM", sent_items),
    (r"(FILE|FIRMWARE|IN|OUT|REPORT|A|B)([.|\s].*)?", files),
)
"""What is offered for a value, by a pattern of its metavar without brackets and dots around it."""


class Offered(click.types.StringParamType):
    """The type of a text for which a function tells the completions."""

    def __init__(self, complete: Complete) -> None:
        self._complete = complete

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[Item]:
        """What the function tells."""
        return self._complete(ctx, param, incomplete)


def with_completion(command: click.Command) -> click.Command:
    """Let the parameters of a command, and of all commands below it, offer values by metavar."""
    for param in command.params:
        name = (param.metavar or param.human_readable_name.upper()).strip("[].")
        for pattern, complete in BY_METAVAR:
            if isinstance(param.type, click.types.StringParamType) and re.fullmatch(pattern, name):
                param.type = Offered(complete)
                break
    for below in command.commands.values() if isinstance(command, click.Group) else ():
        with_completion(below)
    return command
