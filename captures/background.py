"""Writes a capture behind the reader of a line, in a thread of its own.

Nothing is dropped as long as the file can be written.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import Final

from bilprov.captures import topics
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Checkpoint, Chunk
from bilprov.captures.text import printable
from bilprov.captures.writer import CaptureWriter

QUEUE_BYTES: Final = 16 * 1024 * 1024  # of payload that may wait
WAKE_BYTES: Final = 256 * 1024  # of waiting payload that is written at once
WAKE_AFTER: Final = 0.07  # s; what waits less is written then, so that it waits 0.1 s at most
EVENT_BYTES: Final = 256  # counted for each event beside its bytes


class BackgroundWriter(Closing):
    """A capture writer with a bounded queue before it; a context manager, for one thread.

    Its arguments and the errors of its constructor are those of `CaptureWriter`. What is handed
    over is written in order and reaches the operating system at most 0.1 s later, or at once when
    256 KiB wait. While 16 MiB wait, handing over waits too; `waited_ns` adds up for how long.

    A file that can no longer be written stops nothing else: `failure` says in one sentence what
    happened and what is kept, "" before, and what is handed over after it is dropped. Any other
    error is wrong use, which every later call raises, `close` only if no call did.
    """

    def __init__(
        self, path: str | Path, *, start_wall: int, metadata: Mapping[str, str], version: str
    ) -> None:
        self.waited_ns = 0
        self.failure = ""
        self._writer = CaptureWriter(
            path, start_wall=start_wall, metadata=metadata, version=version
        )
        self.path = self._writer.path
        self._queue: deque[tuple[Chunk | topics.Written, int, int]] = deque()  # with t and size
        # Each number is changed by one thread alone, and so needs no lock.
        self._put_bytes = 0
        self._taken_bytes = 0
        self._wake, self._room = Event(), Event()
        self._full = False
        self._closing = False
        self._error: Exception | None = None
        self._raised = False
        self._thread = Thread(target=self._run, name="capture writer", daemon=True)
        self._thread.start()

    def chunk(self, chunk: Chunk) -> None:
        """Hand over a chunk."""
        self._put(chunk, chunk.t, len(chunk.data) + EVENT_BYTES)

    def write(self, value: topics.Written, t: int) -> None:
        """Hand over a value for the topic of its type; `t` is ns since the capture's start."""
        size = len(value.decoder) if type(value) is Checkpoint else 0
        self._put(value, t, size + EVENT_BYTES)

    def close(self) -> None:
        """Write all that waits, finish the file and end the thread; further calls do nothing."""
        self._closing = True
        self._wake.set()
        self._thread.join()
        if not self._raised:
            self._check()

    def _check(self) -> None:
        if self._error is not None:
            self._raised = True
            raise self._error

    def _put(self, value: Chunk | topics.Written, t: int, size: int) -> None:
        if self._error is not None:
            self._check()
        if self._closing:
            raise ValueError(f"the capture {printable(self.path)} is closed")
        if self.failure:
            return
        waiting = self._put_bytes - self._taken_bytes
        if waiting >= WAKE_BYTES:
            if waiting + size > QUEUE_BYTES:
                self._wait_for_room(size)
            if not self._wake.is_set():
                self._wake.set()
        self._queue.append((value, t, size))
        self._put_bytes += size

    def _wait_for_room(self, size: int) -> None:
        most = max(0, QUEUE_BYTES - size)
        began = time.monotonic_ns()
        self._full = True
        try:
            while self._put_bytes - self._taken_bytes > most and self._thread.is_alive():
                self._room.clear()
                self._wake.set()
                # Looked at again in a while, so that nothing depends on who comes first.
                self._room.wait(0.05)
        finally:
            self._full = False
            self.waited_ns += time.monotonic_ns() - began
        self._check()

    def _run(self) -> None:
        try:
            closing = False
            while not closing:
                self._wake.wait(WAKE_AFTER)
                self._wake.clear()
                closing = self._closing  # looked at before the queue: nothing is put in after it
                self._write_waiting()
            self._writer.close()
        except CaptureError as error:
            self.failure = str(error)
        except Exception as error:
            self._error = error
            with suppress(Exception):  # the first error is the one to tell
                self._writer.close()
        self._queue.clear()

    def _write_waiting(self) -> None:
        """Write what waits, in order, and pass it to the operating system."""
        queue, writer = self._queue, self._writer
        if not queue:
            return
        while queue:
            value, t, size = queue.popleft()
            if isinstance(value, Chunk):
                writer.chunk(value)
            else:
                writer.write(value, t)
            self._taken_bytes += size
            if self._full:
                self._room.set()
        writer.flush()
