"""Writes text to a stream without making the reader of a line wait for a slow terminal or pipe."""

from __future__ import annotations

import threading
import time
from typing import TextIO

from bilprov.captures.closing import Closing

MOST = 16 * 1024 * 1024  # characters that may wait; then the writer does


class TextQueue(Closing):
    """Text for a stream that may be slower than the line; a context manager.

    A thread writes it, in order. Nothing is dropped: when 16 MiB wait, `write` waits too, and
    `waited_ns` tells how long it did in all. What the stream raises is raised by the next call.
    """

    def __init__(self, stream: TextIO) -> None:
        self.waited_ns = 0
        self._stream = stream
        self._texts: list[str] = []
        self._size = 0
        self._changed = threading.Condition()
        self._failure: BaseException | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._drain, name="output", daemon=True)
        self._thread.start()

    def write(self, text: str) -> None:
        """Let text be written as soon as the stream takes it. Raises what the stream raised.

        Without text it only does that: what the stream raises while nothing is shown counts too.
        """
        with self._changed:
            if self._size and self._size + len(text) > MOST:
                began = time.monotonic_ns()
                self._changed.wait_for(lambda: self._size < MOST)
                self.waited_ns += time.monotonic_ns() - began
            self._raise()
            if text:
                self._texts.append(text)
                self._size += len(text)
                self._changed.notify_all()

    def close(self) -> None:
        """Wait until all text is written. Raises what the stream raised."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._raise()

    def _drain(self) -> None:
        """Write what waits, in the thread, until the queue is closed and empty."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._texts or self._closing)
                texts, self._texts = self._texts, []
            if not texts:
                return
            text = "".join(texts)
            try:
                self._stream.write(text)
                self._stream.flush()
            except BaseException as error:
                self._failure = error
            with self._changed:
                self._size = 0 if self._failure else self._size - len(text)
                self._changed.notify_all()
            if self._failure:
                return

    def _raise(self) -> None:
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
