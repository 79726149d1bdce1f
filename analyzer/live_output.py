"""The live view on a terminal: every record is counted, the screen is drawn ten times a second."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console, RenderableType
from rich.live import Live

from analyzer.live_view import View, live_view
from analyzer.records import Record
from analyzer.statistics import Statistics
from spec.protocol import Protocol

DRAW_EVERY = 0.1  # s
# A slow terminal gets fewer pictures, so that drawing never takes more than this part of the time.
_DRAWING_SHARE = 0.25
_LAST_HEIGHT = 24  # lines of the picture that stays


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
        self._live.start()

    def show(self, record: Record) -> None:
        """The statistics hold it already; the next picture shows it."""

    def tick(self, now: int) -> None:
        """Draw, unless the last picture is too fresh. `now` is ns since the start."""
        self._now = now
        began = time.monotonic()
        if began < self._next:
            return
        self._live.update(self._picture(), refresh=True)
        took = time.monotonic() - began
        self._next = began + max(DRAW_EVERY, took / _DRAWING_SHARE)

    def close(self) -> None:
        """Leave the terminal as it was, with the last picture on it."""
        self._live.stop()
        height = min(self._console.height - 1, _LAST_HEIGHT)
        self._console.print(self._picture(), height=height)

    def _picture(self) -> RenderableType:
        snapshot = self._statistics.snapshot(self._now)
        return live_view(View(self._protocol, snapshot, self._title, self._captured()))
