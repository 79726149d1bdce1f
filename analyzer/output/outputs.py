"""The outputs for decoded records (text lines, JSON lines, live view) and their interface.

Each line is flushed at once, so that the reader of a pipe gets it without delay.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Literal, Protocol, TextIO

from bilprov.analyzer.decode.records import Record, is_frame
from bilprov.analyzer.output.json_lines import JsonLine, encode, json_line
from bilprov.analyzer.output.text_lines import ASCII_ARROWS, LineRenderer

Format = Literal["live", "lines", "jsonl"]


class Output(Protocol):
    """An output of records: takes each record once, in order, and is informed of the time."""

    def show(self, record: Record) -> None:
        """Show one record."""
        ...

    def tick(self, now: int) -> None:
        """Draw what is due at `now` (ns since the start)."""
        ...

    def close(self) -> None:
        """Restore the terminal."""
        ...


class LinesOutput:
    """Writes one line of text per record; colours on a terminal only, unless NO_COLOR is set."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        arrows = ("→", "←") if _can_encode(stream, "→←") else ASCII_ARROWS
        self._renderer = LineRenderer(colour=_wants_colour(stream), arrows=arrows)

    def show(self, record: Record) -> None:
        """Print the record's line."""
        self._stream.write(self._renderer.line(record) + "\n")
        self._stream.flush()

    def tick(self, now: int) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Nothing is held."""


class JsonOutput:
    """Writes one JSON line per record that has one (see `bilprov.analyzer.output.json_lines`)."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def show(self, record: Record) -> None:
        """Print the record's line."""
        line = json_line(record)
        if line is not None:
            self._stream.write(encode(line).decode() + "\n")
            self._stream.flush()

    def tick(self, now: int) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Nothing is held."""


def chosen_format(asked: Format | None) -> Format:
    """The requested format; if there is none, `live` on a terminal and `lines` in a pipe."""
    if asked is not None:
        return asked
    return "live" if sys.stdout.isatty() and os.environ.get("TERM") != "dumb" else "lines"


def passes(record: Record, test: Callable[[JsonLine], bool] | None) -> bool:
    """Whether a record passes a filter (None: all do); one without a JSON line passes no filter."""
    if test is None:
        return True
    line = json_line(record)
    return line is not None and test(line)


class Shown:
    """Passes records through a filter to an output, and counts the frames that were shown.

    `limit` is the number of frames after which `full` is true and nothing more is shown, None for
    no limit.
    """

    def __init__(
        self,
        output: Output,
        test: Callable[[JsonLine], bool] | None = None,
        limit: int | None = None,
    ) -> None:
        self._output = output
        self._test = test
        self._left = limit

    @property
    def full(self) -> bool:
        """Whether the requested number of frames was shown."""
        return self._left == 0

    def show(self, record: Record) -> bool:
        """Show the record if it passes; return whether it did."""
        if self.full or not passes(record, self._test):
            return False
        self._output.show(record)
        if self._left is not None and is_frame(record):
            self._left -= 1
        return True


def _wants_colour(stream: TextIO) -> bool:
    # https://no-color.org: any value that is not empty.
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _can_encode(stream: TextIO, text: str) -> bool:
    try:
        text.encode(stream.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
