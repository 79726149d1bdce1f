"""`bilprov spec`: shows and exports the protocol (commands show, readings, errata, emit)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.options import text_format_option
from bilprov.analyzer.cli.output_files import STANDARD_OUTPUT, write_output
from bilprov.analyzer.output.console import show_as
from bilprov.analyzer.output.help import Group

if TYPE_CHECKING:
    from bilprov.spec.protocol import Protocol

_output_option = click.option(
    "-o",
    "--output",
    metavar="FILE",
    default=STANDARD_OUTPUT,
    help="Where to; standard output if left out.",
)


@click.group(cls=Group)
def spec() -> None:
    """Show the protocol, how its document is read, and where it is wrong; write it for others."""


@spec.command("show")
@text_format_option
@click.pass_obj
def spec_show(grammar: str | None, style: str) -> None:
    """Show header, instructions, responses, effects and defaults of the grammar in use."""
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


def _reading_ids(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    from bilprov.spec.readings import READINGS

    return [r.id for r in READINGS if r.id.lower().startswith(incomplete.lower())]


@spec.command("readings")
@click.argument("ids", metavar="[ID]...", nargs=-1, shell_complete=_reading_ids)
@text_format_option
@click.pass_obj
def spec_readings(grammar: str | None, ids: tuple[str, ...], style: str) -> None:
    """Show how the document is read where it is silent: our default, and what others get.

    Example: bilprov spec readings R-led-id
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


@spec.command("errata")
@text_format_option
@click.pass_obj
def spec_errata(grammar: str | None, style: str) -> None:
    """Run the document's own examples through the grammar and show where it contradicts itself."""
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.protocol import drawn_errata, errata_json
    from bilprov.spec.errata import check

    protocol = load_protocol(grammar)
    _require_document(protocol, "examples")
    findings = check(protocol)
    show_as(style, lambda: errata_json(findings), lambda: drawn_errata(protocol, findings))


@spec.group("emit")
def spec_emit() -> None:
    """Write the protocol for other programs, made out of the grammar in use."""


@spec_emit.command("c")
@_output_option
@click.pass_obj
def spec_emit_c(grammar: str | None, output: str) -> None:
    """A C header with the protocol's constants, for firmware and for hosts.

    Example: bilprov spec emit c -o protocol.h
    """
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.spec.emit.c import c_header

    write_output(output, c_header(load_protocol(grammar)).encode())


@spec_emit.command("wireshark")
@_output_option
@click.pass_obj
def spec_emit_wireshark(grammar: str | None, output: str) -> None:
    """A dissector in Lua for Wireshark and tshark, which reads what `export` writes as pcapng.

    Example: bilprov spec emit wireshark -o robot.lua, then tshark -2 -r drive.pcapng -X
    lua_script:robot.lua; for Wireshark, put it into the folder of personal Lua plugins.
    """
    from bilprov.analyzer.decode.session import SKEW
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.captures.schemas import MS
    from bilprov.spec.emit.wireshark import lua_dissector

    write_output(output, lua_dissector(load_protocol(grammar), SKEW / MS).encode())
