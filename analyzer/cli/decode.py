"""`bilprov decode`: bytes from hex, a file or standard input, shown frame by frame."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
import msgspec
from msgspec.structs import replace

from bilprov.analyzer.cli.command import argument, command, option, protocol_in_use
from bilprov.analyzer.cli.options import (
    compiled,
    filter_option,
    half_duplex_option,
    only_for_bytes,
    request_option,
    sender_option,
)
from bilprov.analyzer.cli.reading import opened_captures
from bilprov.analyzer.cli.typed_input import (
    are_json_lines,
    file_or_bytes,
    recorded_chunks,
    requests_typed,
)
from bilprov.analyzer.decode.records import DeviceRecord, Record
from bilprov.analyzer.decode.session import BOTH, Session
from bilprov.analyzer.output.outputs import Shown, stream_output
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.schemas import Chunk, Direction
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch

PIECE = 1 << 16  # bytes


class DecodeOptions(msgspec.Struct, frozen=True):
    """The options of `decode`."""

    words: tuple[str, ...] = argument(metavar="[FILE|-|HEX]...", nargs=-1)
    sender: Direction = sender_option()
    request: str | None = request_option()
    style: Literal["lines", "jsonl"] = option(
        "--format",
        type=click.Choice(["lines", "jsonl"]),
        default="lines",
        help="Text lines or JSON lines.",
    )
    expression: str | None = filter_option()
    half_duplex: bool = half_duplex_option()


@command(DecodeOptions)
def decode(options: DecodeOptions) -> None:
    """Examples:
      bilprov decode 81 05 20
      bilprov decode --from device --format jsonl answers.bin
      bilprov decode 14 03 10 --from device --request 418120 --grammar stk500v1

    HEX is bytes like 81 05, FILE a file of raw bytes, a capture, or JSON lines like {"t": 0.5,
    "dir": "host", "hex": "8105"} with the times of one clock, - standard input. Raw bytes are
    taken as sent without a pause: only the last frame can be cut short. The data of some answers
    can be read only with their --request.
    """
    sender = options.sender
    if not options.words and sys.stdin.isatty():
        raise click.UsageError("nothing to decode: give HEX, a FILE or - for standard input")
    source = _source(options.words)
    if options.half_duplex and (isinstance(source, bytes) or _kind(source) == "bytes"):
        raise click.UsageError("--half-duplex is for captures and JSON lines, which have times")
    if isinstance(source, bytes):
        protocol = protocol_in_use()
        out = stream_output(options.style, protocol)
        test = compiled(options.expression, protocol)
        asked = _asked(options, protocol)
        session = Session(protocol, heard=BOTH if asked else frozenset({sender}))
        session.feed(Chunk(0, "host", asked))
        records = session.feed(Chunk(0, sender, source)) + session.finish()
        records = _answers(records) if asked else records
        if test is None:  # and so without numpy, which takes longer to load than all else here
            out.records(records)
            return
        from bilprov.analyzer.decode.batch import Records

        Shown(out, test.started(0)).show(Records(records))
        return
    batches, start, protocol = _decoded(source, options)
    test = compiled(options.expression, protocol)
    shown = Shown(stream_output(options.style, protocol), test and test.started(start))
    for batch in batches:
        shown.show(batch)


def _source(words: Sequence[str]) -> bytes | Path | None:
    """What is to be decoded: bytes in hex, or a file; None for standard input."""
    return None if tuple(words) in ((), ("-",)) else file_or_bytes(words)


def _asked(options: DecodeOptions, protocol: Protocol) -> bytes:
    """The requests that are answered, b"" where they are not known."""
    try:
        asked = requests_typed(protocol, options.request, options.sender)
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    return b"".join(one.frame for one in asked)


def _answers(records: Iterable[Record]) -> list[Record]:
    """The answers; how long they took nobody knows."""
    return [replace(one, latency=None) for one in records if isinstance(one, DeviceRecord)]


def _decoded(path: Path | None, options: DecodeOptions) -> tuple[Iterator[Batch], int, Protocol]:
    """What is decoded from a file, or from standard input as it comes.

    And the wall clock (ns since 1970) at its start, 0 where nobody knows it, and the protocol.
    """
    kind = _kind(path)
    if path is None or kind == "bytes":
        protocol = protocol_in_use()
        asked = _asked(options, protocol)
        return _of_bytes(path, options.sender, protocol, asked), 0, protocol
    if options.request is not None:
        raise click.UsageError(f"{kind} have the requests: leave out --request")
    if kind == "JSON lines":
        protocol = protocol_in_use()
        return _of_lines(path, options, protocol), 0, protocol
    only_for_bytes()
    from bilprov.analyzer.replay.capture_decoding import opened_whole

    (capture,), protocol = opened_captures([path], half_duplex=options.half_duplex)
    batches = opened_whole(capture, protocol).decoded()
    return batches, capture.start, protocol


def _kind(path: Path | None) -> Literal["bytes", "captures", "JSON lines"]:
    """What a file has in it, by how it begins; None stands for standard input."""
    from bilprov.captures.storage.records import MAGIC

    if path is None or not path.is_file():  # a pipe's bytes can be read only once
        return "captures" if path and kept_parts(path) else "bytes"
    try:
        with path.open("rb") as file:
            if path.suffix == ".mcap" or file.read(len(MAGIC)) == MAGIC:
                return "captures"
        return "JSON lines" if are_json_lines(path) else "bytes"
    except OSError as error:
        raise _unreadable(path, error) from error


def _of_lines(path: Path, options: DecodeOptions, protocol: Protocol) -> Iterator[Batch]:
    """Yield what is decoded from a file of JSON lines."""
    from bilprov.analyzer.decode.stream import StreamDecoder
    from bilprov.analyzer.taps.half_duplex import separated

    chunks = recorded_chunks(path, options.sender)
    if options.half_duplex:
        chunks = separated(protocol, chunks)
    heard = frozenset(chunk.direction for chunk in chunks)
    decoder = StreamDecoder(protocol, heard=heard, skew=0)  # one clock stamped them all
    yield from decoder.feed(chunks)
    yield from decoder.finish()


def _of_bytes(
    path: Path | None, sender: Direction, protocol: Protocol, asked: bytes
) -> Iterator[Batch]:
    """Yield what is decoded from the bytes of a file, or of standard input as they come.

    `asked` are the requests that they answer, b"" where they are not known.
    """
    from bilprov.analyzer.decode.batch import Records
    from bilprov.analyzer.decode.stream import StreamDecoder

    decoder = StreamDecoder(protocol, heard=BOTH if asked else frozenset({sender}))
    decoder.feed([Chunk(0, "host", asked)])
    try:
        # Unbuffered, so that bytes from a pipe are shown at once.
        with FileIO(path or sys.stdin.fileno(), closefd=path is not None) as file:
            while data := file.read(PIECE):
                for batch in decoder.feed([Chunk(0, sender, data)]):
                    yield Records(_answers(batch.records())) if asked else batch
    except OSError as error:
        raise _unreadable(path or Path("standard input"), error) from error
    for batch in decoder.finish():
        yield Records(_answers(batch.records())) if asked else batch


def _unreadable(path: Path, error: OSError) -> CaptureError:
    why = error.strerror or error
    return CaptureError(f"{path} cannot be read ({why}): name a file of raw bytes")
