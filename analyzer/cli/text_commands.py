"""The text commands: explain, encode."""

from __future__ import annotations

import sys
from typing import Any

import click

from bilprov.analyzer.cli.options import sender_option, text_format_option
from bilprov.analyzer.output.console import show_as


@click.command()
@click.argument("words", metavar="HEX...", nargs=-1, required=True)
@sender_option
@text_format_option
@click.pass_obj
def explain(grammar: str | None, words: tuple[str, ...], sender: str, style: str) -> None:
    """Explain bytes, bit by bit.

    Examples:
      bilprov explain 81 09
      bilprov explain --from device 02

    For each frame: what its bits mean, what a conforming device answers and does, why, the clause,
    reading or erratum of the document that this rests on, and the nearest valid frame.
    """
    from bilprov.analyzer.cli.typed_input import bytes_from_hex
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.explanation import as_json, drawn
    from bilprov.spec import explain as explaining

    data = _or_sentence(bytes_from_hex, " ".join(words))
    protocol = load_protocol(grammar)
    make = explaining.explain if sender == "host" else explaining.explain_responses
    explanation = make(protocol, data)
    show_as(style, lambda: as_json(explanation), lambda: drawn(explanation))


def _or_sentence(function: Any, *arguments: Any) -> Any:
    """Call a function and return its value; its ValueError becomes a ClickException."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise click.ClickException(str(error)) from None


# A negative value looks like an option; here it is taken as a value, whose range check refuses it.
@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("name", metavar="INSTRUCTION")
@click.argument("values", metavar="[FIELD=VALUE]...", nargs=-1)
@click.option("--raw", is_flag=True, help="Write the bytes themselves, for a pipe.")
@click.pass_obj
def encode(grammar: str | None, name: str, values: tuple[str, ...], raw: bool) -> None:
    """Build the bytes of an instruction and print them in hex.

    Examples:
      bilprov encode LED rgb=5
      bilprov encode Speed 80 --raw

    Values are decimal, 0x hex or 0b binary; without FIELD= they are taken in order. See the
    instructions and their fields with: bilprov spec show

    INSTRUCTION is a name in the grammar, FIELD one of its fields.
    """
    from bilprov.analyzer.cli.typed_input import encoded
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.spec.codec import spaced

    for word in (name, *values):
        if word.startswith("-") and not word[1:2].isdigit():
            raise click.NoSuchOption(word, possibilities=["--raw", "--help", "--grammar"])
    frame = _or_sentence(encoded, load_protocol(grammar), name, values)
    if raw:
        sys.stdout.buffer.write(frame)
    else:
        click.echo(spaced(frame))
