"""The text commands: explain, encode."""

from __future__ import annotations

import sys
from typing import Any

import click
import msgspec

from bilprov.analyzer.cli.command import argument, command, flag, protocol_in_use
from bilprov.analyzer.cli.options import request_option, sender_option, text_format_option
from bilprov.analyzer.output.console import show_as


class ExplainOptions(msgspec.Struct, frozen=True):
    """The options of `explain`."""

    words: tuple[str, ...] = argument(metavar="HEX...", nargs=-1, required=True)
    sender: str = sender_option()
    request: str | None = request_option()
    style: str = text_format_option()


@command(ExplainOptions)
def explain(options: ExplainOptions) -> None:
    """Examples:
      bilprov explain 81 09
      bilprov explain --from device 02
      bilprov explain 14 03 10 --from device --request 418120 --grammar stk500v1

    For each frame: what its bits mean, what a conforming device answers and does, why, the clause,
    reading or erratum of the document that this rests on, and the nearest valid frame.
    """
    from bilprov.analyzer.cli.typed_input import bytes_from_hex, requests_typed
    from bilprov.analyzer.output.explanation import as_json, drawn
    from bilprov.spec import explain as explaining

    data = _or_sentence(bytes_from_hex, " ".join(options.words))
    protocol = protocol_in_use()
    asked = _or_sentence(requests_typed, protocol, options.request, options.sender)
    if options.sender == "host":
        explanation = _or_sentence(explaining.explain, protocol, data)
    else:
        explanation = explaining.explain_responses(protocol, data, asked)
    show_as(options.style, lambda: as_json(explanation), lambda: drawn(explanation))


def _or_sentence(function: Any, *arguments: Any) -> Any:
    """Call a function and return its value; its ValueError becomes a ClickException."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise click.ClickException(str(error)) from None


class EncodeOptions(msgspec.Struct, frozen=True):
    """The options of `encode`."""

    name: str = argument(metavar="INSTRUCTION")
    values: tuple[str, ...] = argument(metavar="[FIELD=VALUE]...", nargs=-1)
    raw: bool = flag("Write the bytes themselves, for a pipe.")


# A negative value looks like an option; here it is taken as a value, whose range check refuses it.
@command(EncodeOptions, context_settings={"ignore_unknown_options": True})
def encode(options: EncodeOptions) -> None:
    """Examples:
      bilprov encode LED rgb=5
      bilprov encode Speed 80 --raw

    They are printed in hex. Values are decimal, 0x hex or 0b binary; without FIELD= they are taken
    in order. See the instructions and their fields with: bilprov spec show

    INSTRUCTION is a name in the grammar, FIELD one of its fields.
    """
    from bilprov.analyzer.cli.typed_input import encoded
    from bilprov.spec.codec import spaced

    frame = _or_sentence(encoded, protocol_in_use(), options.name, options.values)
    if options.raw:
        sys.stdout.buffer.write(frame)
    else:
        click.echo(spaced(frame))
