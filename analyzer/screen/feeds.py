"""Where the rows of the screen come from: a thread that reads a file, a line, or a replay."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.output.statistics import Snapshot, Statistics
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.analyzer.replay.playback import batches
from bilprov.analyzer.screen.recording import Recording
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

DRAW_EVERY = 0.1  # s
_SWITCH = 0.00005  # s after which a thread yields to the reader of a line (Python: 5 ms)


class Feed:
    """Work in a thread of its own that adds to a recording, until it ends or is told to.

    `work` is called with the feed and returns a sentence that says why it ended, "" where nobody
    need be told: then the screen closes, unless it `stays`. `stop` is called to end it early.
    `live` is true where more may come for ever. `progress` is the share that is read (0 to 1).
    `snapshot` are the rates of a live line, `notice` a sentence about what happens to the rows.
    """

    def __init__(
        self,
        recording: Recording,
        work: Callable[[Feed], str],
        *,
        stop: Callable[[], object] = lambda: None,
        live: bool = False,
        stays: bool = True,
    ) -> None:
        self.recording = recording
        self.live = live
        self.stays = stays
        self.progress: float | None = None
        self.snapshot: Snapshot | None = None
        self.captured = ""
        self.notice = ""
        self.stopped = Event()
        self.result = ""
        self._work = work
        self._stop = stop
        self._error: BaseException | None = None
        self._thread = Thread(target=self._run, name="feed", daemon=True)

    @property
    def ended(self) -> bool:
        """Whether nothing more comes."""
        return self._thread.ident is not None and not self._thread.is_alive()

    @property
    def closes(self) -> bool:
        """Whether the screen has nothing more to wait for."""
        return (self.ended and not (self.stays or self.result)) or self._error is not None

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Make it end; returns at once."""
        self.stopped.set()
        self._stop()

    def join(self) -> str:
        """Wait for the end; the sentence of the work. Raises what the work raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self.result

    def _run(self) -> None:
        try:
            self.result = self._work(self)
        except BaseException as error:
            self._error = error


def capture_feed(capture: Capture, protocol: Protocol, timeout: int | None = None) -> Feed:
    """The rows of a capture, read from its beginning to its end as fast as it goes.

    `timeout` is as in `capture_timeout`.
    """

    def read(feed: Feed) -> str:
        decoder = capture_decoder(capture, protocol, timeout)
        length = max(1, capture.contents.last - capture.start)
        feed.progress = 0.0
        for batch in batches(capture.events(), at_once=True):
            if feed.stopped.is_set():
                return ""
            for part in decoder.feed(batch):
                feed.recording.add(part)
            feed.progress = min(1.0, batch[-1].t / length)
            time.sleep(0)  # whoever waits for the interpreter gets it now
        for part in decoder.finish():
            feed.recording.add(part)
        feed.progress = None
        return ""

    return Feed(Recording(protocol), read)


class ScreenOutput:
    """Adds decoded parts to the recording of a feed, and takes the rates ten times a second."""

    def __init__(
        self, feed: Feed, statistics: Statistics, captured: Callable[[], str] = lambda: ""
    ) -> None:
        self._feed = feed
        self._statistics = statistics
        self._captured = captured
        self._next = 0.0

    def show(self, part: Part) -> None:
        """Add a part."""
        self._feed.recording.add(part)

    def tick(self, now: int) -> None:
        """Take the rates at `now` (ns since the start), if it is time."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + DRAW_EVERY
            self._feed.snapshot = self._statistics.snapshot(now)
            self._feed.captured = self._captured()

    def close(self) -> None:
        """Nothing is held."""


@contextmanager
def reader_first() -> Iterator[None]:
    """Let threads take turns quickly in the block, so that the reader of a line never waits."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
