"""Commands whose options are declared once: as the fields of a frozen Struct.

    class PlotOptions(msgspec.Struct, frozen=True):
        file: str = argument(metavar="FILE.mcap")
        force: bool = flag("Overwrite what exists.")

    @command(PlotOptions)
    def plot(options: PlotOptions) -> None: ...

The options of several commands are a class of their own, which `group` makes a field of each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import click
from click.core import ParameterSource

from bilprov.analyzer.output.help import PageCommand, PageOption

if TYPE_CHECKING:
    from bilprov.spec.protocol import Protocol

Options = TypeVar("Options")

TYPED_GRAMMAR = "bilprov.typed-grammar"
"""The key in the `meta` of click's contexts: whether the grammar is named on the command line."""

PATH: click.Path = click.Path(readable=False, path_type=Path)
"""The type of a file's name; whether it can be read, what reads it reports."""

_FILE = re.compile(r"\[?(FILE|IN|OUT|REPORT|A)\b")  # how the metavar of a file begins


class _Declared(NamedTuple):
    """What stands as a field's default: what gives its parameters, and its value, by its name.

    The value is of the values of all parameters.
    """

    parameters: Callable[[str], list[click.Parameter]]
    value: Callable[[str, Mapping[str, Any]], Any] = lambda name, values: values[name]


def argument(**attributes: Any) -> Any:
    """A field that is an argument, with click's attributes."""
    return _Declared(lambda name: [click.Argument([name], **_completed(attributes))])


def option(*spellings: str, **attributes: Any) -> Any:
    """A field that is an option, with click's attributes; spelled as the field unless given.

    The help has its default, unless that is 0 or standard output.
    """
    return _Declared(lambda name: [_option(spellings, name, attributes)])


def flag(help: str, *spellings: str, **attributes: Any) -> Any:
    """A field that is an option without a value."""
    return option(*spellings, is_flag=True, help=help, **attributes)


def option_each(table: Mapping[str, Mapping[str, Any]]) -> Any:
    """A field with the values of several options by name, of those that are given."""
    return _Declared(
        lambda _: [_option((), name, attributes) for name, attributes in table.items()],
        lambda _, values: {name: values[name] for name in table if values[name] is not None},
    )


def group(kind: type[Any], heading: str = "") -> Any:
    """A field that holds the options of another class; the help lists them below a heading."""

    def headed(_: str) -> list[click.Parameter]:
        found = list(_parameters(kind))
        for param in found:
            if heading and isinstance(param, PageOption):
                param.heading = heading
        return found

    return _Declared(headed, lambda _, values: _gathered(kind, values))


def command(
    kind: type[Options],
    only_with: Mapping[str, Sequence[str]] = MappingProxyType({}),
    **attributes: Any,
) -> Callable[[Callable[[Options], int | None]], click.Command]:
    """Make a function a command that is called with its options as one value of a class.

    Its docstring is the help below the sentence that stands in the front door's table. `only_with`
    names, by a parameter, the options that have no use without it: who types one of them without
    it is told so.
    """

    def decorated(function: Callable[[Options], int | None]) -> click.Command:
        def called(**values: Any) -> int | None:
            for needed, names in only_with.items():
                if not values[needed]:
                    refuse(names, f"needs {_spelled(needed)}")
            return function(_gathered(kind, values))

        return PageCommand(
            function.__name__,
            callback=called,
            params=list(_parameters(kind)),
            help=function.__doc__,
            **attributes,
        )

    return decorated


def refuse(names: Iterable[str], why: str) -> None:
    """Raise UsageError for the first of the options that is typed; `why` follows its name."""
    for name in filter(asked_here, names):
        raise click.UsageError(f"{_spelled(name).partition(' ')[0]} {why}")


def asked_here(parameter: str) -> bool:
    """Whether a parameter has its value from the command line.

    A setting is for many uses of a command: where one has no use for it, it is no mistake.
    """
    source = click.get_current_context().get_parameter_source(parameter)
    return source is ParameterSource.COMMANDLINE


def _spelled(name: str) -> str:
    """How a parameter of the running command is written, with what stands for its value."""
    params = click.get_current_context().command.params
    param = next(param for param in params if param.name == name)
    words = [max(param.opts, key=len)] if isinstance(param, click.Option) else []
    return " ".join((*words, (param.metavar or "").strip("[]."))).strip()


def _option(spellings: Sequence[str], name: str, attributes: Mapping[str, Any]) -> click.Option:
    spellings = spellings or [f"--{name.replace('_', '-')}"]
    shown = attributes.get("default") not in (None, 0, "-")
    return PageOption([*spellings, name], show_default=shown, **_completed(attributes))


def _completed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a parameter, which is a path where its metavar is a file's."""
    if "type" not in attributes and _FILE.match(attributes.get("metavar", "")):
        return {"type": click.Path(readable=False), **attributes}  # so that shells complete it
    return {**attributes}


def _parameters(kind: Any) -> Iterator[click.Parameter]:
    for name, declared in _fields(kind):
        yield from declared.parameters(name)


def _gathered(kind: Any, values: Mapping[str, Any]) -> Any:
    return kind(*(declared.value(name, values) for name, declared in _fields(kind)))


def _fields(kind: Any) -> Iterator[tuple[str, _Declared]]:
    return zip(kind.__struct_fields__, kind.__struct_defaults__, strict=True)


def protocol_in_use() -> Protocol:
    """Load the protocol of the grammar that the command line names. Raises GrammarError."""
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.spec.protocol import GrammarError

    context = click.get_current_context()
    try:
        return load_protocol(context.obj)
    except GrammarError as error:
        if context.meta.get(TYPED_GRAMMAR):
            raise
        from bilprov.analyzer.cli.settings import user_file
        from bilprov.captures.text import printable

        raise GrammarError(f"{printable(user_file())}: {error}") from None


def typed_protocol() -> Protocol | None:
    """The protocol of a grammar that was typed; None where it is a setting or the kit's own.

    Raises GrammarError.
    """
    typed = click.get_current_context().meta.get(TYPED_GRAMMAR)
    return protocol_in_use() if typed else None


def family_protocol(what: str) -> Protocol:
    """The protocol in use, which must be of the robot car's family; `what` is what needs that.

    Raises GrammarError, in one sentence, for one that is not of it.
    """
    from bilprov.spec.protocol import require_family

    protocol = protocol_in_use()
    require_family(protocol, what)
    return protocol
