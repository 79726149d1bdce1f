"""Writes a capture behind the reader of a line, in a thread of its own.

Nothing is dropped as long as the file can be written.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final

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


class BackgroundWriter(Closing):
    """A capture writer with a bounded queue before it; a context manager, for one thread.

    The `writer` is a new one, which nobody else uses from then on. What is handed over is written
    in order and reaches the operating system at most 0.1 s later, or at once when 256 KiB wait.
    While 16 MiB wait, handing over waits too.

    The capture may go on in further files. `paths` are those that are there, the newest last, and
    `oldest` is the time (ns since the start) with which the first of them begins.

    A file that can no longer be written stops nothing else: `failure` says in one sentence what
    happened and what is kept, "" before, and what is handed over after it is dropped. Any other
    error is wrong use, which every later call raises.
    """

    def __init__(self, writer: CaptureWriter) -> None:
        self.failure = ""
        self._writer = writer
        self._newest = writer.path
        self.oldest = 0
        # The files that were made here, the time (ns) with which each begins, and, once they are
        # finished, what tells them from others of their name.
        self._made: list[tuple[Path, int, tuple[int, ...]]] = [(writer.path, 0, ())]
        # What is to be done, with what, and how many bytes that has.
        self._queue: deque[tuple[Callable[..., None], tuple[Any, ...], int]] = deque()
        # Each number is changed by one thread alone, and so needs no lock.
        self._put_bytes = 0
        self._taken_bytes = 0
        self._wake = Event()
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
        return tuple(path for path, _, _ in self._made)

    @property
    def size(self) -> int:
        """How many bytes of the file are written, 0 while a next one is not begun."""
        return self._writer.size if self.path == self._newest else 0

    def chunk(self, chunk: Chunk) -> None:
        """Hand over a chunk."""
        self._put(self._writer.chunk, chunk, size=len(chunk.data))

    def write(self, value: topics.Written, t: int) -> None:
        """Hand over a value for the topic of its type; `t` is ns since the capture's start."""
        size = len(value.decoder) if type(value) is Checkpoint else 0
        self._put(self._writer.write, value, t, size=size)

    def go_on_in(
        self, path: Path, metadata: Mapping[str, str], t: int, keep: int | None = None
    ) -> None:
        """Finish the file, and write what is handed over from now on into a new one.

        It begins at `t` (ns since the capture's start). With `keep` older files are deleted, but
        for the newest so many: only those that were made here and are what they were.
        """
        self._newest = path
        self._put(self._go_on, path, metadata, t, keep)

    def close(self) -> None:
        """Write all that waits, finish the file and end the thread; further calls do nothing."""
        self._closing = True
        self._wake.set()
        self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _put(self, act: Callable[..., None], *given: Any, size: int = 0) -> None:
        """Hand over something to do in the thread, which holds `size` bytes."""
        self._check()
        if self._closing:
            raise ValueError(f"the capture {printable(self.path)} is closed")
        if self.failure:
            return
        size += EVENT_BYTES
        if self._waiting >= WAKE_BYTES:
            self._wake.set()
            while self._waiting > max(0, QUEUE_BYTES - size) and self._thread.is_alive():
                time.sleep(0.001)
        self._queue.append((act, given, size))
        self._put_bytes += size

    @property
    def _waiting(self) -> int:
        return self._put_bytes - self._taken_bytes

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
        if not self._queue:
            return
        while self._queue:
            act, given, size = self._queue.popleft()
            act(*given)
            self._taken_bytes += size
        self._writer.flush()

    def _go_on(self, path: Path, metadata: Mapping[str, str], t: int, keep: int | None) -> None:
        self._writer.go_on_in(path, metadata)
        finished, began, _ = self._made[-1]
        self._made[-1:] = [(finished, began, _identity(finished)), (path, t, ())]
        while keep and len(self._made) > keep:
            gone, _, identity = self._made[0]
            if identity and identity == _identity(gone):
                with suppress(OSError):
                    gone.unlink()
            self.oldest = self._made[1][1]
            del self._made[0]


def _identity(path: Path) -> tuple[int, ...]:
    """What tells a finished file from another one of its name; () if it is not there."""
    try:
        status = path.lstat()
    except OSError:
        return ()
    return status.st_dev, status.st_ino, status.st_size
