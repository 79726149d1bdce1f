"""`bilprov decode`, `explain` and `encode`: bytes in words, and words as bytes."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
import msgspec
from msgspec.structs import replace

from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import argument, command, flag, option, protocol_in_use
from bilprov.analyzer.output.console import show_as
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Chunk, Direction

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.decode.records import Record
    from bilprov.spec.protocol import Protocol

PIECE = 1 << 16  # bytes


class DecodeOptions(msgspec.Struct, frozen=True):
    """The options of `decode`."""

    words: tuple[str, ...] = argument(metavar="[FILE|-|HEX]...", nargs=-1)
    sender: Direction = shared.sender_option()
    request: str | None = shared.request_option()
    style: Literal["lines", "jsonl"] = option(
        "--format",
        type=click.Choice(["lines", "jsonl"]),
        default="lines",
        help="Text lines or JSON lines.",
    )
    expression: str | None = shared.filter_option()
    half_duplex: bool = shared.half_duplex_option()


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
    from bilprov.analyzer.cli import typed_input
    from bilprov.analyzer.decode.session import BOTH, Session
    from bilprov.analyzer.output.outputs import Shown, opened_output

    sender, words = options.sender, options.words
    if not words and sys.stdin.isatty():
        raise click.UsageError("nothing to decode: give HEX, a FILE or - for standard input")
    source = None if words in ((), ("-",)) else typed_input.file_or_bytes(words)
    kind = _kind(source) if isinstance(source, Path) else "bytes"
    if options.half_duplex and kind == "bytes":
        raise click.UsageError("--half-duplex is for captures and JSON lines, which have times")
    if options.request is not None and kind != "bytes":
        raise click.UsageError(f"{kind} have the requests: leave out --request")
    if kind == "captures":
        shared.only_for_bytes()
        from bilprov.analyzer.cli.command_files import opened_captures
        from bilprov.analyzer.replay.capture_decoding import opened_whole

        (capture,), protocol = opened_captures([str(source)], half_duplex=options.half_duplex)
        batches, start = opened_whole(capture, protocol).decoded(), capture.start
    else:
        protocol, start = protocol_in_use(), 0
    test = shared.compiled(options.expression, protocol)
    out = opened_output(options.style, protocol)
    if kind == "bytes":
        with shared.refused():
            requests = typed_input.requests_typed(protocol, options.request, sender)
        asked = b"".join(one.frame for one in requests)
        if isinstance(source, bytes) and test is None:
            # Without batches, and so without numpy, which takes longer to load than all else here.
            session = Session(protocol, heard=BOTH if asked else frozenset({sender}))
            session.feed(Chunk(0, "host", asked))
            records = session.feed(Chunk(0, sender, source)) + session.finish()
            out.records(_answers(records) if asked else records)
            return
        batches = _of_bytes(source, sender, protocol, asked)
    elif kind == "JSON lines":
        assert isinstance(source, Path)
        chunks = typed_input.recorded_chunks(source, sender)
        batches = typed_input.decoded_chunks(protocol, chunks, half_duplex=options.half_duplex)
    shown = Shown(out, test and test.started(start))
    for batch in batches:
        shown.show(batch)


def _answers(records: Iterable[Record]) -> list[Record]:
    """The answers; how long they took nobody knows."""
    from bilprov.analyzer.decode.records import DeviceRecord

    return [replace(one, latency=None) for one in records if isinstance(one, DeviceRecord)]


def _kind(path: Path) -> Literal["bytes", "captures", "JSON lines"]:
    """What a file has in it, by how it begins."""
    from bilprov.analyzer.cli.typed_input import are_json_lines
    from bilprov.captures.parts import is_capture, kept_parts

    if is_capture(path) or kept_parts(path):
        return "captures"
    with _readable(path):  # a pipe's bytes can be read only once
        return "JSON lines" if path.is_file() and are_json_lines(path) else "bytes"


def _of_bytes(
    source: Path | bytes | None, sender: Direction, protocol: Protocol, asked: bytes
) -> Iterator[Batch]:
    """Yield what is decoded from bytes, from those of a file, or of standard input as they come.

    `asked` are the requests that they answer, b"" where they are not known.
    """
    from bilprov.analyzer.decode.batch import Records
    from bilprov.analyzer.decode.session import BOTH
    from bilprov.analyzer.decode.stream import StreamDecoder

    decoder = StreamDecoder(protocol, heard=BOTH if asked else frozenset({sender}))

    def decoded() -> Iterator[Batch]:
        decoder.feed([Chunk(0, "host", asked)])
        if isinstance(source, bytes):
            yield from decoder.feed([Chunk(0, sender, source)])
        else:
            # Unbuffered, so that bytes from a pipe are shown at once.
            with (
                _readable(source or Path("standard input")),
                FileIO(source or sys.stdin.fileno(), closefd=source is not None) as file,
            ):
                while data := file.read(PIECE):
                    yield from decoder.feed([Chunk(0, sender, data)])
        yield from decoder.finish()

    for batch in decoded():
        yield Records(_answers(batch.records())) if asked else batch


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Raise CaptureError, in one sentence, where a file cannot be read in the block."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        raise CaptureError(f"{path} cannot be read ({why}): name a file of raw bytes") from error


class ExplainOptions(msgspec.Struct, frozen=True):
    """The options of `explain`."""

    words: tuple[str, ...] = argument(metavar="HEX...", nargs=-1, required=True)
    sender: str = shared.sender_option()
    request: str | None = shared.request_option()
    style: str = shared.text_format_option()


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

    protocol = protocol_in_use()
    with shared.refused():
        data = bytes_from_hex(" ".join(options.words))
        asked = requests_typed(protocol, options.request, options.sender)
        if options.sender == "host":
            explanation = explaining.explain(protocol, data)
        else:
            explanation = explaining.explain_responses(protocol, data, asked)
    show_as(options.style, lambda: as_json(explanation), lambda: drawn(explanation))


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

    protocol = protocol_in_use()
    with shared.refused():
        frame = encoded(protocol, options.name, options.values)
    if options.raw:
        sys.stdout.buffer.write(frame)
    else:
        click.echo(spaced(frame))
