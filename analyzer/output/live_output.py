"""The live view on a terminal: every record is counted, the screen is drawn ten times a second.

A picture takes several milliseconds to draw, and a slow terminal longer: a thread of its own does
it, so that a bridge hands bytes on meanwhile.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live

from analyzer.decode.records import Record
from analyzer.output.live_view import View, live_view
from analyzer.output.statistics import Statistics
from spec.protocol import Protocol

DRAW_EVERY = 0.1  # s
# A slow terminal gets fewer pictures, so that drawing never takes more than this part of the time.
_DRAWING_SHARE = 0.25
_LAST_HEIGHT = 24  # lines of the picture that stays
_SWITCH = 0.0005  # s that the drawing may keep the reading from going on; Python's own is 5 ms


class LiveOutput:
    """Draws the statistics of a session that is being decoded.

    `captured` tells in words what is kept so far. Uses the terminal's other screen; `close` gives
    the first one back and leaves the last picture there.
    """

    def __init__(
        self,
        protocol: Protocol,
        statistics: Statistics,
        title: str,
        captured: Callable[[], str] = lambda: "",
    ) -> None:
        self._protocol = protocol
        self._statistics = statistics
        self._title = title
        self._captured = captured
        self._next = 0.0
        self._now = 0
        self._console = Console()
        self._live = Live(
            console=self._console, screen=True, auto_refresh=False, redirect_stdout=False
        )
        self._view: View | None = None
        self._wake = threading.Event()
        self._closing = False
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH)
        self._live.start()
        self._thread = threading.Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()

    def show(self, record: Record) -> None:
        """The statistics hold it already; the next picture shows it."""

    def tick(self, now: int) -> None:
        """Hand on what is to be drawn, unless the last picture is too fresh or still being drawn.

        `now` is ns since the start.
        """
        self._now = now
        if time.monotonic() >= self._next and not self._wake.is_set():
            self._view = self._moment()
            self._wake.set()

    def close(self) -> None:
        """Leave the terminal as it was, with the last picture on it."""
        self._closing = True
        self._wake.set()
        self._thread.join()
        self._live.stop()
        sys.setswitchinterval(self._switch)
        height = min(self._console.height - 1, _LAST_HEIGHT)
        self._console.print(live_view(self._moment()), height=height)

    def _moment(self) -> View:
        snapshot = self._statistics.snapshot(self._now)
        return View(self._protocol, snapshot, self._title, self._captured())

    def _draw(self) -> None:
        """The thread's whole life: it sees only frozen views, never the statistics."""
        while not self._closing:
            self._wake.wait()
            began = time.monotonic()
            if self._view is not None and not self._closing:
                self._live.update(live_view(self._view), refresh=True)
            took = time.monotonic() - began
            self._next = began + max(DRAW_EVERY, took / _DRAWING_SHARE)
            self._wake.clear()
