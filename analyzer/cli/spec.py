"""`bilprov spec`: shows the protocol, its readings and errata, and writes it for others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click
import msgspec

from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import argument, command, protocol_in_use
from bilprov.analyzer.cli.command_files import (
    STANDARD_OUTPUT,
    force_option,
    require_writable,
    write_output,
)
from bilprov.analyzer.cli.typed_input import decoded_chunks, file_or_bytes, recorded_chunks
from bilprov.analyzer.decode.decoded_share import DecodedShare, decoded_share
from bilprov.analyzer.grammar_file import SHIPPED, dissector_program, load_protocol, not_carried
from bilprov.analyzer.grammar_name import GrammarName
from bilprov.analyzer.output.console import facts, heading, parts_of, show_as, table
from bilprov.captures.parts import is_capture, kept_parts
from bilprov.captures.schemas import Chunk, Direction
from bilprov.captures.text import quantity

if TYPE_CHECKING:
    from rich.console import RenderableType

    from bilprov.spec.protocol import Protocol


class ReadingsOptions(shared.FormatOption, frozen=True):
    """The options of `spec readings`."""

    ids: tuple[str, ...] = argument(metavar="[ID]...", nargs=-1)


class EmitOption(msgspec.Struct, frozen=True):
    """Where the grammar is written."""

    output: str | None = shared.output_option(
        metavar="FILE", help="The file to write; standard output if left out."
    )
    force: bool = force_option()

    def write(self, text: str) -> None:
        """Write a text there. Raises UsageError, or UserError, if it cannot be written."""
        require_writable([("-o", self.output)], force=self.force)
        write_output(self.output or STANDARD_OUTPUT, text.encode())


_FORCED = {"output": ("force",)}


class GrammarOptions(EmitOption, frozen=True):
    """Which grammar is written, and where."""

    name: str | None = argument(metavar="[NAME]", required=False, type=click.Choice(list(SHIPPED)))


@command(shared.FormatOption)
def show(options: shared.FormatOption) -> None:
    """Examples:
      bilprov spec show
      bilprov spec show --format json

    Shown are header, instructions, responses, effects and defaults.
    """
    from bilprov.analyzer.output.protocol import drawn_protocol, protocol_json

    protocol = protocol_in_use()
    show_as(options.style, lambda: protocol_json(protocol), lambda: drawn_protocol(protocol))


@command(shared.FormatOption)
def grammars(options: shared.FormatOption) -> None:
    """Examples:
      bilprov spec grammars
      bilprov spec show --grammar modbus-rtu

    Each has its document, and the settings of the line that this asks for.
    """
    from bilprov.analyzer.transport.line_settings import line_settings

    kept, rows = [], []
    for one in map(load_protocol, SHIPPED):
        about = parts_of(one, "name", "version", "document")
        kept.append(about | {"line": msgspec.to_builtins(one.line), "sha256": one.sha256})
        rows.append((one.name, one.version, str(line_settings(one)), one.document))
    columns = ("name", "version", "line", "document")
    show_as(options.style, lambda: kept, lambda: [table(columns, rows)])


def _require_document(protocol: Protocol, what: str) -> None:
    """Refuse a grammar of another document than that of the kit's examples and readings."""
    known = load_protocol().document
    if protocol.document != known:
        raise click.ClickException(
            f"this grammar has no {what}: they belong to {known}, and its document is "
            f"{protocol.document}"
        )


@command(ReadingsOptions)
def readings(options: ReadingsOptions) -> None:
    """Examples:
      bilprov spec readings R-led-id

    For each point: the default, and other readings' verdicts.
    """
    from bilprov.analyzer.cli.typed_input import meant
    from bilprov.analyzer.output.protocol import drawn_readings, reading_json
    from bilprov.spec.readings import READINGS

    _require_document(protocol_in_use(), "readings")
    known = {reading.id.lower(): reading for reading in READINGS}
    for name in options.ids:
        if name.lower() not in known:
            hint = meant(name, [reading.id for reading in READINGS])
            raise click.ClickException(
                f"there is no reading {name!r}{hint}; see bilprov spec readings"
            )
    chosen = [known[name.lower()] for name in options.ids] or list(READINGS)
    keys = ("id", "clause", "point", "quote", "default")
    show_as(
        options.style,
        lambda: [reading_json(reading, *keys) for reading in chosen],
        lambda: drawn_readings(chosen),
    )


@command(shared.FormatOption)
def errata(options: shared.FormatOption) -> None:
    """Examples:
      bilprov spec errata

    The document's own examples are run through the grammar.
    """
    from bilprov.analyzer.output.protocol import drawn_errata, errata_json
    from bilprov.spec.explain import check

    protocol = protocol_in_use()
    _require_document(protocol, "examples")
    findings = check(protocol)
    show_as(options.style, lambda: errata_json(findings), lambda: drawn_errata(protocol, findings))


@command(EmitOption, only_with=_FORCED)
def c(options: EmitOption) -> None:
    """Examples:
    bilprov spec emit c -o protocol.h
    """
    from bilprov.spec.emit.c import c_header

    options.write(c_header(protocol_in_use()))


@command(EmitOption, only_with=_FORCED)
def stub(options: EmitOption) -> None:
    """Examples:
      bilprov spec emit stub --grammar modbus-rtu -o meter.pyi

    It has a method for each instruction, with the types of its fields and of its answer. Type
    checkers and editors read it.
    """
    from bilprov.spec.emit.python import python_stub

    options.write(python_stub(protocol_in_use()))


@command(EmitOption, only_with=_FORCED)
def wireshark(options: EmitOption) -> None:
    """Examples:
      bilprov spec emit wireshark -o robot.lua

    It reads what `export` writes as pcapng. Then: tshark -2 -r drive.pcapng -X
    lua_script:robot.lua; for Wireshark, put it into the folder of personal Lua plugins.
    """
    from bilprov.analyzer.decode.session import SKEW
    from bilprov.captures.schemas import MS
    from bilprov.spec.emit.wireshark import lua_dissector

    options.write(lua_dissector(protocol_in_use(), SKEW / MS, dissector_program()))


@command(GrammarOptions, only_with=_FORCED)
def grammar(options: GrammarOptions) -> None:
    """Examples:
      bilprov spec emit grammar dynamixel1 -o mine.py
      bilprov spec show --grammar mine.py

    NAME is one of bilprov spec grammars; without it, the grammar in use is written. The changed
    text is named with --grammar.
    """
    protocol = load_protocol(options.name) if options.name else protocol_in_use()
    options.write(protocol.source)


class CheckOptions(msgspec.Struct, frozen=True):
    """The options of `spec check`."""

    grammar: str = argument(metavar="NAME|FILE.py", type=GrammarName(readable=False))
    words: tuple[str, ...] = argument(metavar="FILE|HEX...", nargs=-1, required=True)
    sender: Direction = shared.sender_option()
    half_duplex: bool = shared.half_duplex_option()
    style: str = shared.text_format_option()


@command(CheckOptions)
def check(options: CheckOptions) -> int:
    """Examples:
      bilprov spec check relay.py 55 56 00 00 00 01 02 ae
      bilprov spec check dynamixel1 line.jsonl

    FILE is a capture, hex text, or JSON lines like {"t": 0.5, "dir": "host", "hex": "5556"}.
    Reported are the share of the bytes that decodes, the first bytes that do not, and the
    instruction that they nearly are. Exit code 0 if all bytes decode, else 1.
    """
    protocol = load_protocol(options.grammar)
    share = _share(protocol, options, half_duplex=options.half_duplex)
    if not share.sides:
        raise click.ClickException("there is no byte to decode: name a capture or bytes in hex")
    shared.note(not_carried(protocol))
    if not share.whole and list(share.sides) == ["host"]:
        split = _share(protocol, options, half_duplex=True)
        if split.percent > share.percent:
            most = _percent(split)
            words = f"--half-duplex decodes {most} of these bytes"
            shared.note(f"if both directions share one wire, {words}")
    show_as(options.style, lambda: _share_json(share), lambda: _drawn(protocol, share))
    return 0 if share.whole else 1


def _share(protocol: Protocol, options: CheckOptions, *, half_duplex: bool) -> DecodedShare:
    """What decodes of a file, or of bytes in hex; with `half_duplex` they are of one wire.

    Raises UserError, or ClickException.
    """
    source = file_or_bytes(options.words)
    if isinstance(source, bytes):
        chunks = [Chunk(0, options.sender, source)]
    elif is_capture(source) or kept_parts(source):
        from bilprov.analyzer.api import read_capture
        from bilprov.captures.reader import open_capture

        shared.only_for_bytes()
        if not half_duplex:
            return decoded_share(protocol, read_capture(source, protocol))
        chunks = [event for event in open_capture(source) if isinstance(event, Chunk)]
    else:
        chunks = recorded_chunks(source, options.sender)
    batches = decoded_chunks(protocol, chunks, half_duplex=half_duplex)
    return decoded_share(protocol, (record for batch in batches for record in batch.records()))


def _drawn(protocol: Protocol, share: DecodedShare) -> Iterator[RenderableType]:
    """Yield what decodes, and the first bytes that do not: what they nearly are, and why not."""
    yield heading(f"{protocol.name} decodes {_percent(share)} of the bytes")
    rows: list[tuple[str, str]] = []
    for direction, side in share.sides.items():
        frames = quantity(side.frames, "request" if direction == "host" else "answer")
        rows.append((direction, f"{side.decoded} of {side.bytes} bytes decode: {frames}"))
    if first := share.first:
        where = f"byte {first.offset} of the {first.direction}, at {first.t / 1e9:.6f} s"
        rows += [("first that does not", where), ("bytes", first.data.hex(" "))]
        nearly, near = "no instruction", first.near
        if near is not None:
            answer = "the answer to " if first.direction == "device" and near.name else ""
            nearly = f"{answer}{near.name or nearly} ({near.obstacle}): {near.reason}"
        rows += [("nearly", nearly), ("a check that fits", share.check)]
    yield facts(rows)


def _percent(share: DecodedShare) -> str:
    return "all" if share.whole else f"{min(share.percent, 99.9):.1f} %"


def _share_json(share: DecodedShare) -> dict[str, Any]:
    first = share.first
    told = first and {
        **parts_of(first, "direction", "offset"),
        "t": first.t / 1e9,
        "hex": first.data.hex(" "),
        "nearly": first.near and first.near._asdict(),
        "check": share.check,
    }
    sides: dict[str, Any] = {name: asdict(side) for name, side in share.sides.items()}
    return {"decodes": share.whole, "percent": share.percent, **sides, "first": told}
