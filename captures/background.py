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
from typing import Final, NamedTuple

from bilprov.captures import topics
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Checkpoint, Chunk
from bilprov.captures.text import printable
from bilprov.captures.writer import CaptureWriter

QUEUE_BYTES: Final = 16 * 1024 * 1024  # of payload that may wait
WAKE_BYTES: Final = 256 * 1024  # of waiting payload that is written at once
WAKE_AFTER: Final = 0.05  # s; what waits less is written then: 0.1 s at most after it was read
EVENT_BYTES: Final = 256  # counted for each event beside its bytes


class _Next(NamedTuple):
    """The file in which to go on, from `t` (ns) on; so many of the newest files are kept."""

    path: Path
    metadata: Mapping[str, str]
    t: int
    keep: int | None


class _Made(NamedTuple):
    """A file that was made here and begins at `t` (ns), and what tells it from another one."""

    path: Path
    t: int
    identity: tuple[int, int, int] | None = None


class BackgroundWriter(Closing):
    """A capture writer with a bounded queue before it; a context manager, for one thread.

    The `writer` is a new one, which nobody else uses from then on. What is handed over is written
    in order and reaches the operating system at most 0.1 s later, or at once when 256 KiB wait.
    While 16 MiB wait, handing over waits too; `waited_ns` adds up for how long.

    The capture may go on in further files. `paths` are those that are there, the newest last, and
    `oldest` is the time (ns since the start) with which the first of them begins.

    A file that can no longer be written stops nothing else: `failure` says in one sentence what
    happened and what is kept, "" before, and what is handed over after it is dropped. Any other
    error is wrong use, which every later call raises.
    """

    def __init__(self, writer: CaptureWriter) -> None:
        self.waited_ns = 0
        self.failure = ""
        self._writer = writer
        self.oldest = 0
        self._made = [_Made(self._writer.path, 0)]
        # With t and size.
        self._queue: deque[tuple[Chunk | topics.Written | _Next, int, int]] = deque()
        # Each number is changed by one thread alone, and so needs no lock.
        self._put_bytes = 0
        self._taken_bytes = 0
        self._asked = 1
        self._begun = 1
        self._wake, self._room = Event(), Event()
        self._full = False
        self._closing = False
        self._error: Exception | None = None
        self._thread = Thread(target=self._run, name="capture writer", daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        """The file that is written."""
        return self._writer.path

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that hold the capture, the newest last."""
        return tuple(file.path for file in self._made)

    @property
    def size(self) -> int:
        """How many bytes of the file are written, 0 while a next one is not begun."""
        return self._writer.size if self._asked == self._begun else 0

    def chunk(self, chunk: Chunk) -> None:
        """Hand over a chunk."""
        self._put(chunk, chunk.t, len(chunk.data) + EVENT_BYTES)

    def write(self, value: topics.Written, t: int) -> None:
        """Hand over a value for the topic of its type; `t` is ns since the capture's start."""
        size = len(value.decoder) if type(value) is Checkpoint else 0
        self._put(value, t, size + EVENT_BYTES)

    def go_on_in(
        self, path: Path, metadata: Mapping[str, str], t: int, keep: int | None = None
    ) -> None:
        """Finish the file, and write what is handed over from now on into a new one.

        It begins at `t` (ns since the capture's start). With `keep` older files are deleted, but
        for the newest so many: only those that were made here and are what they were.
        """
        self._asked += 1
        self._put(_Next(path, metadata, t, keep), t, EVENT_BYTES)

    def close(self) -> None:
        """Write all that waits, finish the file and end the thread; further calls do nothing."""
        self._closing = True
        self._wake.set()
        self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _put(self, value: Chunk | topics.Written | _Next, t: int, size: int) -> None:
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
            elif isinstance(value, _Next):
                writer = self._begin(value)
            else:
                writer.write(value, t)
            self._taken_bytes += size
            if self._full:
                self._room.set()
        writer.flush()

    def _begin(self, file: _Next) -> CaptureWriter:
        finished = self._writer
        self._writer = finished.following(file.path, file.metadata)
        self._made[-1] = self._made[-1]._replace(identity=_identity(finished.path))
        self._made.append(_Made(file.path, file.t))
        self._begun += 1
        while file.keep and len(self._made) > file.keep:
            gone = self._made[0]
            if gone.identity and gone.identity == _identity(gone.path):
                with suppress(OSError):
                    gone.path.unlink()
            self.oldest = self._made[1].t
            del self._made[0]
        return self._writer


def _identity(path: Path) -> tuple[int, int, int] | None:
    """What tells a finished file from another one of its name; None if it is not there."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size
