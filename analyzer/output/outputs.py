"""The outputs for decoded records: text lines, JSON lines, live view.

Each line is flushed at once, so that the reader of a pipe gets it without delay.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TextIO, TypeAlias

from bilprov.analyzer.decode.records import Record, is_frame
from bilprov.analyzer.output.json_lines import JsonLine, encode, json_line
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.output.text_lines import ASCII_ARROWS, LineRenderer
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.output.live_output import LiveOutput

Format = Literal["live", "lines", "jsonl"]


class StreamOutput:
    """Writes what `line` makes of each record as a line of text; None stands for no line."""

    def __init__(self, stream: TextIO, line: Callable[[Record], str | None]) -> None:
        self._stream = stream
        self._line = line

    def show(self, record: Record) -> None:
        """Print the record's line."""
        line = self._line(record)
        if line is not None:
            self._stream.write(line + "\n")
            self._stream.flush()

    def tick(self, now: int) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Nothing is held."""


Output: TypeAlias = "StreamOutput | LiveOutput"
"""Takes each record once, in order (`show`), and is informed of the time (`tick`)."""


def stream_output(style: Literal["lines", "jsonl"]) -> Output:
    """The output to standard output as lines of text or as JSON lines.

    Lines of text have colours on a terminal only, unless NO_COLOR is set.
    """
    if style == "jsonl":
        return StreamOutput(sys.stdout, _json_text)
    arrows = ("→", "←") if _can_encode(sys.stdout, "→←") else ASCII_ARROWS
    renderer = LineRenderer(colour=_wants_colour(sys.stdout), arrows=arrows)
    return StreamOutput(sys.stdout, renderer.line)


def opened_output(
    style: Format,
    protocol: Protocol,
    statistics: Statistics,
    title: str,
    captured: Callable[[], str] = lambda: "",
) -> Output:
    """Open the output of the format `style` on standard output; see LiveOutput."""
    if style != "live":
        return stream_output(style)
    from bilprov.analyzer.output.live_output import LiveOutput

    return LiveOutput(protocol, statistics, title, captured)


def _json_text(record: Record) -> str | None:
    line = json_line(record)
    return None if line is None else encode(line).decode()


def chosen_format(asked: Format | None) -> Format:
    """The requested format; if there is none, `live` on a terminal and `lines` in a pipe."""
    if asked is not None:
        return asked
    return "live" if sys.stdout.isatty() and os.environ.get("TERM") != "dumb" else "lines"


@dataclass(slots=True)
class Shown:
    """Passes records through a filter to an output, and counts the frames that were shown.

    Without a filter (`test` is None) all records pass; one without a JSON line passes no filter.
    `left` is how many frames more are shown, None for no limit; at 0 `full` is true and nothing
    more is shown.
    """

    output: Output
    test: Callable[[JsonLine], bool] | None = None
    left: int | None = None

    @property
    def full(self) -> bool:
        """Whether the requested number of frames was shown."""
        return self.left == 0

    def show(self, record: Record) -> bool:
        """Show the record if it passes; return whether it did."""
        if self.full:
            return False
        if self.test is not None:
            line = json_line(record)
            if line is None or not self.test(line):
                return False
        self.output.show(record)
        if self.left is not None and is_frame(record):
            self.left -= 1
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
