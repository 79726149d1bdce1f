"""Writes text to a stream without making the reader of a line wait for a slow terminal or pipe."""

from __future__ import annotations

import os
import select
import stat
import threading
import time
from collections import deque
from typing import TextIO

from bilprov.captures.closing import Closing

MOST = 16 * 1024 * 1024  # characters that may wait; then the writer does
_AT_ONCE = select.PIPE_BUF  # bytes that a pipe which is ready takes without waiting


class TextQueue(Closing):
    """Text for a stream that may be slower than the line; a context manager.

    Text goes out at once where that cannot wait: little of it, to a pipe with room or to a file.
    All else is written by a thread, in order. Nothing is dropped: when 16 MiB wait, `write` waits
    too, and `waited_ns` tells how long it did in all. What the stream raises is raised by the next
    call.
    """

    def __init__(self, stream: TextIO) -> None:
        self.waited_ns = 0
        self._stream = stream
        self._kind = _kind(stream)
        self._texts: deque[str] = deque()
        self._size = 0
        self._changed = threading.Condition()
        self._failure: BaseException | None = None
        self._closing = False
        self._thread: threading.Thread | None = None

    def write(self, text: str) -> None:
        """Write text now, or as soon as the stream takes it. Raises what the stream raised."""
        if self._failure is None and not self._size:
            text = self._put_at_once(text)
            if not text:
                return
        with self._changed:
            if self._size and self._size + len(text) > MOST and self._failure is None:
                began = time.monotonic_ns()
                self._changed.wait_for(lambda: self._size < MOST or self._failure is not None)
                self.waited_ns += time.monotonic_ns() - began
            self._raise()
            self._texts.append(text)
            self._size += len(text)
            if self._thread is None:
                self._thread = threading.Thread(target=self._drain, name="output", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def close(self) -> None:
        """Wait until all text is written. Raises what the stream raised."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._raise()

    def _put_at_once(self, text: str) -> str:
        """Write what goes out without waiting, and return the rest."""
        if self._kind == "file":
            self._put(text)
            return ""
        most = _AT_ONCE if text.isascii() else _AT_ONCE // 4  # a character has four bytes at most
        while text and self._kind == "pipe" and select.select([], [self._stream], [], 0)[1]:
            self._put(text[:most])
            text = text[most:]
        return text

    def _put(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    def _drain(self) -> None:
        """Write what waits, in the thread, until the queue is closed and empty."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._texts or self._closing)
                texts = list(self._texts)
                self._texts.clear()
            if not texts:
                return
            text = "".join(texts)
            try:
                self._put(text)
            except BaseException as error:
                with self._changed:
                    self._failure, self._size = error, 0
                    self._changed.notify_all()
                return
            with self._changed:
                self._size -= len(text)
                self._changed.notify_all()

    def _raise(self) -> None:
        if self._failure is not None:
            failure, self._failure = self._failure, None
            self._closing = True
            raise failure


def _kind(stream: TextIO) -> str:
    """`pipe` or `file` if the stream is one, else (a terminal, a socket) an empty string."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (OSError, ValueError):  # it has no descriptor, so it is in memory
        return "file"
    return "pipe" if stat.S_ISFIFO(mode) else "file" if stat.S_ISREG(mode) else ""
