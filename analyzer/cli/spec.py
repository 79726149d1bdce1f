"""`bilprov spec`: shows the protocol, its readings and errata, and writes it for others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.options import text_format_option
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT, write_output
from bilprov.analyzer.output.console import show_as

if TYPE_CHECKING:
    from bilprov.spec.protocol import Protocol

_output_option = click.option(
    "-o",
    "--output",
    metavar="FILE",
    default=STANDARD_OUTPUT,
    help="The file to write; standard output if left out.",
)


@click.command("show")
@text_format_option
@click.pass_obj
def spec_show(grammar: str | None, style: str) -> None:
    """Show header, instructions, responses, effects and defaults of the grammar in use.

    Examples:
      bilprov spec show
      bilprov spec show --format json
    """
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.protocol import drawn_protocol, protocol_json

    protocol = load_protocol(grammar)
    show_as(style, lambda: protocol_json(protocol), lambda: drawn_protocol(protocol))


def _require_document(protocol: Protocol, what: str) -> None:
    """Refuse a grammar of another document than that of the kit's examples and readings."""
    from bilprov.analyzer.grammar_file import load_protocol

    known = load_protocol().document
    if protocol.document != known:
        raise click.ClickException(
            f"this grammar has no {what}: they belong to {known}, and its document is "
            f"{protocol.document}"
        )


@click.command("readings")
@click.argument("ids", metavar="[ID]...", nargs=-1)
@text_format_option
@click.pass_obj
def spec_readings(grammar: str | None, ids: tuple[str, ...], style: str) -> None:
    """Show how the document is read where it is silent: the default, other readings' verdicts.

    Examples:
      bilprov spec readings R-led-id
    """
    from bilprov.analyzer.cli.typed_input import meant
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.protocol import drawn_readings, readings_json
    from bilprov.spec.readings import READINGS

    _require_document(load_protocol(grammar), "readings")
    known = {reading.id.lower(): reading for reading in READINGS}
    for name in ids:
        if name.lower() not in known:
            hint = meant(name, [reading.id for reading in READINGS])
            raise click.ClickException(
                f"there is no reading {name!r}{hint}; see bilprov spec readings"
            )
    chosen = [known[name.lower()] for name in ids] or list(READINGS)
    show_as(style, lambda: readings_json(chosen), lambda: drawn_readings(chosen))


@click.command("errata")
@text_format_option
@click.pass_obj
def spec_errata(grammar: str | None, style: str) -> None:
    """Run the document's own examples through the grammar and show where it contradicts itself.

    Examples:
      bilprov spec errata
    """
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.protocol import drawn_errata, errata_json
    from bilprov.spec.errata import check

    protocol = load_protocol(grammar)
    _require_document(protocol, "examples")
    findings = check(protocol)
    show_as(style, lambda: errata_json(findings), lambda: drawn_errata(protocol, findings))


@click.command("c")
@_output_option
@click.pass_obj
def spec_emit_c(grammar: str | None, output: str) -> None:
    """A C header with the protocol's constants, for firmware and for hosts.

    Examples:
      bilprov spec emit c -o protocol.h
    """
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.spec.emit.c import c_header

    write_output(output, c_header(load_protocol(grammar)).encode())


@click.command("wireshark")
@_output_option
@click.pass_obj
def spec_emit_wireshark(grammar: str | None, output: str) -> None:
    """A dissector in Lua for Wireshark and tshark, which reads what `export` writes as pcapng.

    Examples:
      bilprov spec emit wireshark -o robot.lua

    Then: tshark -2 -r drive.pcapng -X lua_script:robot.lua; for Wireshark, put it into the folder
    of personal Lua plugins.
    """
    from bilprov.analyzer.decode.session import SKEW
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.captures.schemas import MS
    from bilprov.spec.emit.wireshark import lua_dissector

    write_output(output, lua_dissector(load_protocol(grammar), SKEW / MS).encode())


@click.command("grammar")
@_output_option
@click.pass_obj
def spec_emit_grammar(grammar: str | None, output: str) -> None:
    """The text of the grammar in use, to be changed and named with --grammar.

    Examples:
      bilprov spec emit grammar -o mine.py
      bilprov spec show --grammar mine.py
    """
    from bilprov.analyzer.grammar_file import load_protocol

    write_output(output, load_protocol(grammar).source.encode())
