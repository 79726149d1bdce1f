"""Recorded bytes as text: JSON lines like `{"t": 0.5, "dir": "host", "hex": "5556"}`, or hex."""

from __future__ import annotations

import json
from pathlib import Path

import click
import msgspec

from bilprov.analyzer.cli.typed_input import bytes_from_hex
from bilprov.analyzer.files import read_bounded
from bilprov.analyzer.foreign import from_json
from bilprov.captures.schemas import Chunk, Direction
from bilprov.captures.text import printable

_MOST = 1 << 26  # bytes of a file
_LINE = 1 << 16  # bytes of its first line that are looked at


class RecordedBytes(msgspec.Struct):
    """A line of recorded bytes: its time in s, who sent them, and the bytes in hex.

    The JSON lines of the kit have the key `direction`, null where a line has no bytes.
    """

    t: float
    hex: str
    dir: Direction | None = None
    direction: Direction | None = None

    @property
    def sender(self) -> Direction:
        """Who sent the bytes. Raises ValueError where the line does not tell it."""
        found = self.dir or self.direction
        if found is None:
            raise ValueError("dir is missing, allowed are host and device")
        return found


def are_json_lines(path: Path) -> bool:
    """Whether a file begins with a line that is a JSON object."""
    with path.open("rb") as file:
        line = file.readline(_LINE)
    try:
        return line.lstrip().startswith(b"{") and isinstance(json.loads(line), dict)
    except ValueError:
        return False


def recorded_chunks(path: Path, sender: Direction) -> list[Chunk]:
    """The bytes in a file of JSON lines, or of hex text from a sender. Raises ClickException."""
    try:
        text = read_bounded(path, _MOST).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise click.ClickException(
            f"{printable(str(path))} cannot be read: {why}; name a capture (.mcap), JSON lines or "
            "hex text"
        ) from error
    if not text.lstrip().startswith("{"):
        try:
            return [Chunk(0, sender, bytes_from_hex(text))]
        except ValueError as error:
            what = f"{printable(str(path))} is neither a capture nor JSON lines"
            raise click.ClickException(f"{what}: {error}") from None
    lines = enumerate(text.splitlines(), 1)
    chunks = [_chunk(path, number, line) for number, line in lines if line.strip()]
    return [chunk for chunk in chunks if chunk.data]


def _chunk(path: Path, number: int, line: str) -> Chunk:
    try:
        row = from_json(line.encode(), RecordedBytes)
        data = bytes.fromhex(row.hex)
        return Chunk(round(row.t * 1e9), row.sender if data else "host", data)
    except (ValueError, OverflowError) as error:
        raise click.ClickException(
            f"line {number} of {printable(str(path))} cannot be read: {error}; write "
            '{"t": 0.5, "dir": "host", "hex": "5556"}'
        ) from error
