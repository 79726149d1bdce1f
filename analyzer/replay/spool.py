"""Records a session into temporary captures of bounded size, which can be kept as one capture.

Each part is a capture of its own. When all parts together are too large, the oldest goes.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Final, NamedTuple

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.replay.recorder import Recorder
from bilprov.analyzer.version import kit_version
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Recorded, open_capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line
from bilprov.captures.text import printable
from bilprov.captures.writer import CaptureWriter

MOST_BYTES: Final = 1 << 30
PARTS: Final = 16  # so many are there when the oldest goes


class _Part(NamedTuple):
    """One temporary capture, which begins at `t` (ns since the session's start)."""

    recorder: Recorder
    t: int


class Spool(Closing):
    """Records as a Recorder does, into temporary files that are deleted at `close`.

    At most about `most` bytes are kept. `oldest` is the time (ns since the start) from which on
    everything is there; `bytes` and `waited_ns` are as a Recorder's, over the whole session, and so
    is `failure`. Nobody asked for these files, so they may fail from the beginning on.
    """

    def __init__(
        self, start_wall: int, metadata: Mapping[str, str], most: int = MOST_BYTES
    ) -> None:
        self.oldest = 0
        self.failure = ""
        self._start_wall = start_wall
        self._metadata = dict(metadata)
        self._part_bytes = most // PARTS
        self._made = 0
        self._parts: list[_Part] = []
        self._ended_bytes = 0
        self._waited = 0
        self._closings: list[Thread] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._try(self._open)

    @property
    def bytes(self) -> int:
        """How many raw bytes were handed over."""
        return self._ended_bytes + (self._parts[-1].recorder.bytes if self._parts else 0)

    @property
    def waited_ns(self) -> int:
        """How long the reader has waited in all for files that were too slow."""
        return self._waited + (self._parts[-1].recorder.waited_ns if self._parts else 0)

    def events(self, events: Iterable[Chunk | Line]) -> None:
        """Write raw events, before they are decoded."""
        self._try(lambda: self._parts[-1].recorder.events(events))

    def decoded(self, frames: int, now: int, records: Callable[[], Iterable[Record]]) -> None:
        """Write a decoded batch; see Recorder."""
        self._try(lambda: self._parts[-1].recorder.decoded(frames, now, records))

    def checkpoint(self, t: int, save: Callable[[], str | None]) -> None:
        """Write a checkpoint at `t` if one is due, or begin the next part if this one is full."""
        self._try(lambda: self._checkpoint(t, save))

    def tick(self, now: int) -> None:
        """Let time pass to `now`."""
        self._try(lambda: self._parts[-1].recorder.tick(now))

    def finish(self) -> None:
        """End the recording; only `keep` and `close` are called after it."""
        self._try(lambda: self._parts[-1].recorder.close())
        for thread in self._closings:
            thread.join()

    def keep(self, path: Path) -> None:
        """Keep the finished recording as a new capture.

        Raises CaptureError if there is a file of this name, or if it cannot be written; then the
        temporary files stay, and the sentence says where.
        """
        if self.failure:
            raise CaptureError(self.failure)
        try:
            if len(self._parts) == 1:
                self._copy(self._parts[0].recorder.path, path)
            else:
                self._join(path)
        except (CaptureError, OSError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            kept = Path(tempfile.mkdtemp(prefix="bilprov-kept-"))
            for part in self._parts:
                shutil.move(part.recorder.path, kept)
            raise CaptureError(
                f"{printable(path)} was not written ({printable(why)}); the capture is in {kept}"
            ) from error

    def close(self) -> None:
        """Delete the temporary files; further calls do nothing."""
        if self._parts:
            self._parts[-1].recorder.close()
        for thread in self._closings:
            thread.join()
        if self._folder:
            self._folder.cleanup()

    def _try(self, act: Callable[[], object]) -> None:
        """Do something, and note the failure; nothing once there was one."""
        if self.failure:
            return
        try:
            act()
            if self._parts:
                self._note(self._parts[-1].recorder.failure)
        except (CaptureError, OSError) as error:
            self._note(error.strerror if isinstance(error, OSError) else error)

    def _note(self, why: object) -> None:
        if why:
            self.failure = f"the session cannot be saved: {printable(why)}"

    def _open(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="bilprov-", ignore_cleanup_errors=True)
        self._begin(0)

    def _begin(self, t: int) -> None:
        assert self._folder is not None
        path = Path(self._folder.name) / f"{self._made:06d}.mcap"
        self._made += 1
        self._parts.append(_Part(Recorder(path, self._start_wall, self._metadata), t))

    def _checkpoint(self, t: int, save: Callable[[], str | None]) -> None:
        recorder = self._parts[-1].recorder
        if recorder.path.stat().st_size < self._part_bytes:
            recorder.checkpoint(t, save)
            return
        self._end_part(recorder)
        self._begin(t)
        while len(self._parts) > PARTS:
            self._parts.pop(0).recorder.path.unlink(missing_ok=True)
            self.oldest = self._parts[0].t

    def _end_part(self, recorder: Recorder) -> None:
        """End the part that is written, in a thread: the line is read on meanwhile."""
        self._ended_bytes += recorder.bytes
        self._waited += recorder.waited_ns

        close = partial(self._close_part, recorder)
        thread = Thread(target=self._try, args=(close,), name="end of a part", daemon=True)
        thread.start()
        self._closings.append(thread)

    def _close_part(self, recorder: Recorder) -> None:
        recorder.close()
        self._note(recorder.failure)

    @staticmethod
    def _copy(part: Path, path: Path) -> None:
        with path.open("xb") as file, part.open("rb") as source:
            try:
                shutil.copyfileobj(source, file, 1 << 20)
            except BaseException:
                path.unlink(missing_ok=True)
                raise

    def _join(self, path: Path) -> None:
        """Write all parts into one capture; what was decoded from the bytes is left out."""
        with CaptureWriter(
            path, start_wall=self._start_wall, metadata=self._metadata, version=kit_version()
        ) as writer:
            if self.oldest:
                gone = f"what came before {self.oldest / 1e9:.3f} s was let go: no room"
                writer.write(Line(self.oldest, "gap", "", gone), self.oldest)
            for event in self._recorded():
                if isinstance(event, Chunk):
                    writer.chunk(event)
                elif isinstance(event, Line | Checkpoint):
                    writer.write(event, event.t)

    def _recorded(self) -> Iterator[Recorded]:
        for part in self._parts:
            yield from open_capture(part.recorder.path).recorded()
