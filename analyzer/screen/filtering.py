"""Looks for the rows that pass a filter, in a thread of its own, so that the screen goes on."""

from __future__ import annotations

from threading import Event, Thread
from typing import TYPE_CHECKING

from bilprov.analyzer.screen.recording import Recording, View

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter


class Filtering:
    """A new `view` of a recording that fills in a `thread` until it is `cancelled`.

    `text` is the filter as it was typed.
    """

    def __init__(self, recording: Recording, text: str, test: Filter | None) -> None:
        self.view = View(recording, test)
        self.text = text
        self._recording = recording
        self.cancelled = Event()
        self.thread = Thread(target=self.view.catch_up, args=(self.cancelled,), daemon=True)
        self.thread.start()

    @property
    def doing(self) -> str:
        """How much of the recording was looked at, in words."""
        return f"filtering {self.view.seen / max(1, self._recording.rows):.0%}"

    @property
    def ended(self) -> bool:
        """Whether nothing more is looked at."""
        return not self.thread.is_alive()

    def cancel(self) -> None:
        """Stop early; returns at once."""
        self.cancelled.set()
