"""Draws the live view on a terminal, at most ten times a second; every record is counted.

Drawing takes several milliseconds, longer on a slow terminal, so a separate thread does it and a
bridge can pass bytes on in the meantime.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.output.live_view import View, live_view
from bilprov.analyzer.output.statistics import Statistics
from bilprov.spec.protocol import Protocol

DRAW_EVERY = 0.1  # s
# Largest share of the time that drawing may take; on a slow terminal the view is drawn less often.
_DRAWING_SHARE = 0.08
_LAST_HEIGHT = 24  # lines of the last view, which stays on the terminal
_SWITCH = 0.00005  # s after which the drawing thread yields to the reading one (Python: 5 ms)


class LiveOutput:
    """Draws the statistics of a session that is being decoded.

    `captured` returns in words what was recorded so far. The view uses the terminal's alternate
    screen; `close` restores the normal screen and leaves the last view on it.
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

    def show(self, part: Part) -> None:
        """Do nothing: the statistics get the part too, and the next drawing shows it."""

    def tick(self, now: int) -> None:
        """Start a drawing, unless the last one is too recent or still in progress.

        `now` is ns since the start.
        """
        self._now = now
        if time.monotonic() >= self._next and not self._wake.is_set():
            self._view = self._moment()
            self._wake.set()

    def close(self) -> None:
        """Restore the terminal, with the last view on it."""
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
        """Run the drawing thread; it reads only frozen views, never the statistics."""
        while not self._closing:
            self._wake.wait()
            began = time.monotonic()
            if self._view is not None and not self._closing:
                self._live.update(live_view(self._view), refresh=True)
            took = time.monotonic() - began
            self._next = began + max(DRAW_EVERY, took / _DRAWING_SHARE)
            self._wake.clear()
