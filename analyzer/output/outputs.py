"""The outputs for decoded traffic: text lines, JSON lines, CSV, nothing.

The full screen is an output too (`screen.feeds`).

What comes together is written and flushed at once, so that a pipe's reader gets it without delay.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Literal, TextIO

import msgspec

from bilprov.analyzer.decode.json_lines import encode_lines, json_lines
from bilprov.analyzer.decode.records import Record, is_frame
from bilprov.analyzer.output.text_lines import LineRenderer, hex_width
from bilprov.captures.closing import Closing
from bilprov.spec import protocol as spec

if TYPE_CHECKING:
    from concurrent.futures import Future

    from bilprov.analyzer.decode.batch import Batch, Selection
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.output.row_columns import RowStyle


def json_text(records: Iterable[Record]) -> str:
    """JSON lines, each with its newline; see `json_lines`. A record without a line gives none."""
    return encode_lines(json_lines(records)).decode()


Format = Literal["live", "lines", "jsonl", "csv"]


class Output:
    """Takes the decoded batches once, in order, and is informed of the time; shows nothing."""

    def show(self, batch: Batch) -> None:
        """Show a batch."""

    def tick(self, now: int) -> None:
        """Let time pass to `now` (ns since the start)."""


class StreamOutput(Output):
    """Writes records as lines of text, those that come together in one piece.

    `write` takes the text and sees to it that it gets out; `text` makes the lines, each with its
    end.
    """

    def __init__(
        self, write: Callable[[str], object], text: Callable[[Iterable[Record]], str]
    ) -> None:
        self._write = write
        self._text = text

    def show(self, batch: Batch) -> None:
        """Print the lines of all records of a batch."""
        self.records(batch.records())

    def records(self, records: Sequence[Record]) -> None:
        """Print the lines of the records."""
        if text := self._text(records):
            self._write(text)

    def tick(self, now: int) -> None:
        """Notice, also while nothing is to be shown, that nobody reads any more."""
        self._write("")


def write_out(text: str) -> None:
    """Write text to standard output, and hand it on at once."""
    sys.stdout.write(text)
    sys.stdout.flush()


def opened_output(
    style: Literal["lines", "jsonl", "csv"],
    protocol: spec.Protocol,
    rows: RowStyle | None = None,
    start_wall: int = 0,
    write: Callable[[str], object] = write_out,
) -> StreamOutput:
    """The output of the format `style` to standard output.

    Lines of text have colours on a terminal only, unless NO_COLOR is set. `rows` is what was asked
    for of each; `start_wall` is the wall clock (ns since 1970) at the recording's start.
    """
    if style == "jsonl":
        return StreamOutput(write, json_text)
    # https://no-color.org: any value that is not empty.
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    colour, time = sys.stdout.isatty() and not plain, None
    if rows is not None:
        from bilprov.analyzer.output.row_columns import ColumnLines, CsvText, usual_columns

        times = rows.times(start_wall)
        if style == "csv":
            usual = usual_columns(protocol, time=rows.time is not None)
            form = CsvText(rows.columns or usual, times)
            write(form.header)
            return StreamOutput(write, form.text)
        if rows.columns:
            return StreamOutput(write, ColumnLines(rows.columns, times, colour=colour).text)
        time = times.padded if rows.time else None
    width = hex_width(protocol)
    return StreamOutput(write, LineRenderer(colour=colour, time=time, width=width).text)


def has_terminal() -> bool:
    """Whether the full screen can be shown: there is a terminal to draw on and to type at."""
    streams = (sys.stdin, sys.stdout)
    return os.environ.get("TERM", "dumb") not in ("", "dumb") and all(
        stream is not None and stream.isatty() for stream in streams
    )


class Window(msgspec.Struct, frozen=True):
    """A window of time: its first ns, and the first ns after it; None where it has no bound."""

    first: int | None = None
    after: int | None = None

    def has(self, t: int) -> bool:
        """Whether a time (ns) is inside the window."""
        return (self.first is None or t >= self.first) and (self.after is None or t < self.after)

    @property
    def bounded(self) -> bool:
        """Whether some times are outside."""
        return self.first is not None or self.after is not None


class Shown(msgspec.Struct):
    """Passes records inside a window through a filter to an output, and counts the frames.

    Without a filter (`test` is None) all records pass; one without a JSON line passes no filter.
    `left` is how many frames more are shown, None for no limit; at 0 `full` is true and nothing
    more is shown.
    """

    output: Output
    test: Filter | None = None
    left: int | None = None
    window: Window = Window()

    @property
    def full(self) -> bool:
        """Whether the requested number of frames was shown."""
        return self.left == 0

    def show(self, batch: Batch) -> Batch:
        """Show what passes of a batch, and return that."""
        chosen = self._chosen(batch)
        if self.left is not None or (chosen is not None and not chosen.everything):
            from bilprov.analyzer.decode.batch import Records

            batch = Records(list(self._counted(batch.records(chosen))))
        self.output.show(batch)
        return batch

    def _chosen(self, batch: Batch) -> Selection | None:
        """The rows inside the window that pass the filter; None for all."""
        window = self.window
        chosen = batch.inside(window.first, window.after) if window.bounded else None
        if self.test is not None:
            passing = self.test.selection(batch)
            chosen = passing if chosen is None else chosen & passing
        return chosen

    def _counted(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield the records up to the last frame that is shown."""
        for record in records:
            if self.full:
                return
            if self.left is not None and is_frame(record):
                self.left -= 1
            yield record


MOST_WAITING = 16 * 1024 * 1024  # characters that may wait; then the writer does


class TextQueue(Closing):
    """Text for a stream that may be slower than the line; a context manager.

    A thread writes it, in order. Nothing is dropped: when 16 MiB wait, `write` waits too. What the
    stream raises is raised by the next call.
    """

    def __init__(self, stream: TextIO) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self._stream = stream
        self._thread = ThreadPoolExecutor(1, "output")
        self._texts: deque[tuple[int, Future[None]]] = deque()
        self._size = 0

    def write(self, text: str) -> None:
        """Let text be written as soon as the stream takes it. Raises what the stream raised.

        Without text it only does that: what the stream raises while nothing is shown counts too.
        """
        while self._texts and (self._texts[0][1].done() or self._size + len(text) > MOST_WAITING):
            self._take()
        if text:
            self._texts.append((len(text), self._thread.submit(self._write, text)))
            self._size += len(text)

    def close(self) -> None:
        """Wait until all text is written. Raises what the stream raised."""
        while self._texts:
            self._take()
        self._thread.shutdown()

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _take(self) -> None:
        """Wait until the oldest text is written; where it cannot be, the others are dropped."""
        size, written = self._texts.popleft()
        self._size -= size
        try:
            written.result()
        except BaseException:
            self._texts.clear()
            self._thread.shutdown(wait=False, cancel_futures=True)
            raise
