"""Where the rows of the screen come from: a thread that reads a file or a line."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from operator import sub
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, NamedTuple

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.output.outputs import Output, Shown, Window
from bilprov.analyzer.output.row_columns import RowStyle
from bilprov.analyzer.replay import capture_decoding as decoding
from bilprov.analyzer.replay.recorder import Recorder, Spool
from bilprov.analyzer.screen.recording import Recording
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.captures.reader import appended
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.captures.events import Events

DRAW_EVERY = 0.1  # s
MOST_MEMORY = 300 << 20  # bytes of packed rows; a live session keeps no more
_STILL = 60  # s since a capture was last written to, after which nobody is taken to write it
_LAG = 2_000_000_000  # ns after which a writer has written what came


_RATED = 21  # moments at which is counted what the rates of the last two seconds are made from


class Rates(NamedTuple):
    """Frames per second, and bytes per second of host and device."""

    frames: float
    bytes: Sequence[float]


@dataclass(eq=False)
class Feed:
    """Work in a thread of its own that adds to a recording, until it ends or is told to.

    `work` is called with the feed; `halt` makes it end early. When it ends the screen closes,
    unless it `stays`. `live` is true where rows come in their own time. What the screen shows of
    it: `progress` is the share that is read (0 to 1), `rates` those of a live line,
    `captured` what was recorded, `said` why it ended, and `notice` something else that the user
    should know. `keeps` is true where the recording can be saved when the screen is left, and
    `let_go` where its oldest rows had to go. `grew` is when a file that is followed had something
    new (s, as `time.monotonic`), None where none is followed.
    """

    recording: Recording
    work: Callable[[Feed], object]
    halt: Callable[[], object] = lambda: None
    live: bool = False
    stays: bool = False
    keeps: bool = False
    progress: float | None = None
    rates: Rates | None = None
    captured: str = ""
    said: str = ""
    notice: str = ""
    let_go: bool = False
    grew: float | None = None
    stopped: Event = field(default_factory=Event)
    _working: Future[object] | None = None

    @property
    def ended(self) -> bool:
        """Whether nothing more comes."""
        return self._working is not None and self._working.done()

    @property
    def closes(self) -> bool:
        """Whether the screen has nothing more to wait for."""
        return self.ended and (not self.stays or self.start().exception() is not None)

    def start(self) -> Future[object]:
        """Begin, unless it has begun."""
        if self._working is None:
            self._working = ThreadPoolExecutor(1, "feed").submit(self.work, self)
        return self._working

    def stop(self) -> None:
        """Make it end; returns at once."""
        self.stopped.set()
        self.halt()

    def join(self) -> None:
        """Wait for the end. Raises what the work raised."""
        self.start().result()


class Told(NamedTuple):
    """What the screen shows beside the rows.

    `title` names the file or the ports, `start_wall` is the wall clock (ns since 1970) at t = 0,
    `line` has the settings of the line. `expression` and `test` are the filter to begin with. A
    capture is played `rate` times as fast as it was recorded, at 0 without pauses.
    """

    title: str
    start_wall: int
    line: LineSettings
    rows: RowStyle = RowStyle()
    expression: str = ""
    test: Filter | None = None
    rate: float = 1.0


def capture_feed(
    opened: decoding.Opened,
    protocol: Protocol,
    test: Filter | None = None,
    count: int | None = None,
    window: Window = decoding.WHOLE,
) -> Feed:
    """The rows of a capture in a window of time, read to its end as fast as it goes.

    With a `count` they are the first so many frames that pass the filter `test`, and no others;
    without one the screen filters them itself.
    """

    def take(events: Events) -> None:
        for batch in opened.decoder.decode(events):
            rows.show(batch)
        feed.progress = min(1.0, int(events.t[-1]) / length)

    def read(feed: Feed) -> None:
        for events in parts:
            if feed.stopped.is_set():
                return
            if rows.full:
                break
            take(events)
            time.sleep(0)  # whoever waits for the interpreter gets it now
        feed.progress = None
        if feed.live:
            for batch in _followed(opened, feed):
                rows.show(batch)
        for batch in opened.decoder.finish():
            rows.show(batch)

    whole = count is None and window.after is None
    capture = opened.capture
    age = time.time() - capture.volumes[0].path.stat().st_mtime
    live = whole and capture.unfinished and not capture.in_parts and age < _STILL
    # There is one line for it, so the file's name stands without its folder.
    named = replace(capture, path=Path(capture.path.name))
    notice = "; ".join(decoding.said_about(named, protocol, is_written=live))
    feed = Feed(Recording(protocol), read, stays=True, live=live, notice=notice)
    rows = (AllShown if count is None else Shown)(ScreenOutput(feed), test, count, window)
    length = max(1, capture.contents.last - capture.start)
    parts = decoding.event_batches(opened.capture.batches(opened.after), decoding.unheard, window)
    for events in islice(parts, 1):
        take(events)  # here and now, so that the first page is there when the screen is
    return feed


def _followed(opened: decoding.Opened, feed: Feed) -> Iterator[Batch]:
    """Decode what is added to a capture, until its writer finishes it or the feed is stopped."""
    capture, feed.grew = opened.capture, time.monotonic()
    while capture.unfinished and not feed.stopped.wait(DRAW_EVERY):
        more = appended(capture)
        if more is None:
            yield from opened.decoder.advance(time.time_ns() - capture.start - _LAG)
            continue
        capture, feed.grew = more, time.monotonic()
        for events in capture.batches():
            yield from opened.decoder.decode(events)


@dataclass
class ScreenOutput(Output):
    """Adds decoded batches to the recording of a feed, and takes the rates ten times a second.

    Rows are let go that are older than what a spool still has, and where the recording takes more
    than `most` bytes of memory.
    """

    feed: Feed
    recorder: Recorder | None = None
    most: int = MOST_MEMORY
    _next: float = 0.0
    _counted: deque[tuple[int, ...]] = field(default_factory=lambda: deque([(0, 0, 0, 0)], _RATED))

    def show(self, batch: Batch) -> None:
        """Add a batch."""
        self.feed.recording.add(batch)

    def tick(self, now: int) -> None:
        """Take the rates at `now` (ns since the start), if it is time."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + DRAW_EVERY
        feed, recording, recorder = self.feed, self.feed.recording, self.recorder
        totals, gone = recording.totals, recording.first
        self._counted.append((now, totals.frames, totals.host_bytes, totals.device_bytes))
        span, *counts = map(sub, self._counted[-1], self._counted[0])
        frames, *sides = [count * 1e9 / max(span, 1) for count in counts]
        feed.rates = Rates(frames, sides)
        if isinstance(recorder, Spool):
            feed.keeps = not recorder.failure
            recording.let_go_older(recorder.oldest)
        elif recorder:
            written = f"{recorder.path.name} {recorder.bytes:,} B"
            feed.captured = "" if recorder.failure else written
        while recording.nbytes > self.most and recording.let_go_oldest():
            pass
        feed.let_go = feed.let_go or recording.first > gone


class AllShown(Shown):
    """Shows every row in the window, also those that a filter hides: the screen hides them itself.

    The frames that pass the filter are counted as by any `Shown`.
    """

    def show(self, batch: Batch) -> Batch:
        """Show a batch, and return what was shown of it."""
        if self.left is not None:
            deque(self._counted(batch.records(self._chosen(batch))), maxlen=0)
        inside = batch.inside(self.window.first, self.window.after)
        if not inside.everything:
            batch = Records(batch.records(inside))
        self.output.show(batch)
        return batch
