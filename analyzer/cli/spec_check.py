"""`bilprov spec check`: how much of recorded bytes a grammar decodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import click

from bilprov.analyzer.cli.command import argument, command
from bilprov.analyzer.cli.options import note_each, sender_option, text_format_option
from bilprov.analyzer.cli.typed_input import file_or_bytes, recorded_chunks
from bilprov.analyzer.decode.decoded_share import DecodedShare, Undecoded, decoded_share
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol, not_carried
from bilprov.analyzer.grammar_name import GrammarName
from bilprov.analyzer.output.console import facts, heading, show_as
from bilprov.captures.parts import kept_parts
from bilprov.captures.schemas import Chunk, Direction

if TYPE_CHECKING:
    from rich.console import RenderableType

    from bilprov.analyzer.decode.records import Record
    from bilprov.spec.protocol import Protocol


@dataclass(frozen=True)
class CheckOptions:
    """The options of `spec check`."""

    grammar: str = argument(metavar="NAME|FILE.py", type=GrammarName(readable=False))
    words: tuple[str, ...] = argument(metavar="FILE|HEX...", nargs=-1, required=True)
    sender: Direction = sender_option()
    style: str = text_format_option()


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
    share = decoded_share(protocol, _records(protocol, options.words, options.sender))
    if not share.sides:
        raise click.ClickException("there is no byte to decode: name a capture or bytes in hex")
    note_each([not_carried(protocol)])
    show_as(options.style, lambda: _share_json(share), lambda: _drawn(protocol, share))
    return 0 if share.whole else 1


def _records(protocol: Protocol, words: Sequence[str], sender: Direction) -> Iterator[Record]:
    """The records of a file, or of bytes in hex. Raises UserError, or ClickException."""
    source = file_or_bytes(words)
    if isinstance(source, bytes):
        chunks = [Chunk(0, sender, source)]
    elif source.suffix == ".mcap" or kept_parts(source):
        from bilprov.analyzer.api import read_capture

        yield from read_capture(source, protocol)
        return
    else:
        chunks = recorded_chunks(source, sender)
    session = Session(protocol, heard=frozenset(chunk.direction for chunk in chunks))
    for chunk in chunks:
        yield from session.feed(chunk)
    yield from session.finish()


def _drawn(protocol: Protocol, share: DecodedShare) -> Iterator[RenderableType]:
    """Yield what decodes, and the first bytes that do not."""
    yield heading(f"{protocol.name} decodes {_percent(share)} of the bytes")
    rows: list[tuple[str, str]] = []
    for direction, side in share.sides.items():
        kind = "request" if direction == "host" else "answer"
        frames = f"{side.frames} {kind}{'s' * (side.frames != 1)}"
        rows.append((direction, f"{side.decoded} of {side.bytes} bytes decode: {frames}"))
    first = share.first
    if first:
        rows += [
            ("first that does not", _place(first)),
            ("bytes", first.data.hex(" ")),
            ("nearly", _nearly(first)),
            ("a check that fits", share.check),
        ]
    yield facts(rows)


def _percent(share: DecodedShare) -> str:
    return "all" if share.whole else f"{min(share.percent, 99.9):.1f} %"


def _place(first: Undecoded) -> str:
    return f"byte {first.offset} of the {first.direction}, at {first.t / 1e9:.6f} s"


def _nearly(first: Undecoded) -> str:
    """What the bytes nearly are and why they are not, in words."""
    if first.near is None:
        return "no instruction"
    name = first.near.name or "no instruction"
    answer = "the answer to " if first.direction == "device" and first.near.name else ""
    return f"{answer}{name} ({first.near.obstacle}): {first.near.reason}"


def _share_json(share: DecodedShare) -> dict[str, Any]:
    first = share.first
    told = first and {
        "direction": first.direction,
        "offset": first.offset,
        "t": first.t / 1e9,
        "hex": first.data.hex(" "),
        "nearly": first.near and first.near._asdict(),
        "check": share.check,
    }
    sides: dict[str, Any] = {name: asdict(side) for name, side in share.sides.items()}
    return {"decodes": share.whole, "percent": share.percent, **sides, "first": told}
