"""`bilprov decode`: bytes from hex, a file or standard input, shown frame by frame."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from io import FileIO
from pathlib import Path
from typing import Literal

import click

from bilprov.analyzer.cli.options import compiled, filter_option, note, sender_option
from bilprov.analyzer.cli.typed_input import bytes_from_hex
from bilprov.analyzer.columns.decoder import StreamDecoder
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.outputs import Shown, stream_output
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.spec.protocol import Protocol

PIECE = 1 << 16  # bytes


@click.command()
@click.argument("words", metavar="[FILE|-|HEX]...", nargs=-1)
@sender_option
@click.option(
    "--format",
    "style",
    type=click.Choice(["lines", "jsonl"]),
    default="lines",
    show_default=True,
    help="Text lines or JSON lines.",
)
@filter_option
@click.pass_obj
def decode(
    grammar: str | None,
    words: tuple[str, ...],
    sender: Direction,
    style: Literal["lines", "jsonl"],
    expression: str | None,
) -> None:
    """Decode bytes: hex like 81 05, a file of raw bytes, a capture, or - for standard input.

    Examples:
      bilprov decode 81 05 20
      bilprov decode --from device --format jsonl answers.bin

    The bytes are taken as sent without a pause: only the last frame can be cut short.
    """
    protocol = load_protocol(grammar)
    test = compiled(expression, protocol)
    if not words and sys.stdin.isatty():
        raise click.UsageError("nothing to decode: give HEX, a FILE or - for standard input")
    decoder, events, start = _input(words or ("-",), sender, protocol)
    out = Shown(stream_output(style), test and test.started(start))
    for batch in events:
        for part in decoder.feed(batch):
            out.show(part)
    for part in decoder.finish():
        out.show(part)


def _input(
    words: tuple[str, ...], sender: Direction, protocol: Protocol
) -> tuple[StreamDecoder, Iterable[Sequence[Chunk | Line]], int]:
    """The decoder and the events to decode, from hex words, a file, or standard input.

    And the wall clock (ns since 1970) at their start, 0 where nobody knows it.
    """
    decoder = StreamDecoder(protocol, heard=frozenset({sender}))
    if words == ("-",):
        return decoder, _pieces(None, sender), 0
    path = Path(words[0])
    in_parts = len(words) == 1 and bool(kept_parts(path))
    if in_parts or (len(words) == 1 and _is_file(path)):
        if in_parts or _begins_like_a_capture(path):
            from bilprov.analyzer.replay.capture_session import capture_decoder, said_about
            from bilprov.analyzer.replay.playback import batches
            from bilprov.captures.reader import open_capture

            capture = open_capture(path)
            for sentence in said_about(capture, protocol):
                note(sentence)
            events = batches(capture.events(), at_once=True)
            return capture_decoder(capture, protocol), events, capture.start
        return decoder, _pieces(path, sender), 0
    try:
        data = bytes_from_hex(" ".join(words))
    except ValueError as error:
        files = "there is no such file, and " if len(words) == 1 else ""
        raise click.ClickException(f"{files}{error}") from None
    return decoder, [[Chunk(0, sender, data)]], 0


def _is_file(path: Path) -> bool:
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):  # too long for a name, or with a zero byte: no file, maybe hex
        return False


def _begins_like_a_capture(path: Path) -> bool:
    from bilprov.captures.storage.records import MAGIC

    if not path.is_file():  # a pipe's bytes can be read only once
        return False
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise _unreadable(path, error) from error


def _pieces(path: Path | None, sender: Direction) -> Iterator[list[Chunk]]:
    """Yield the bytes of a file, or of standard input as they come, as chunks."""
    try:
        # Unbuffered, so that bytes from a pipe are shown at once.
        with FileIO(path or sys.stdin.fileno(), closefd=path is not None) as file:
            while data := file.read(PIECE):
                yield [Chunk(0, sender, data)]
    except OSError as error:
        raise _unreadable(path or Path("standard input"), error) from error


def _unreadable(path: Path, error: OSError) -> CaptureError:
    why = error.strerror or error
    return CaptureError(f"{path} cannot be read ({why}): name a file of raw bytes")
