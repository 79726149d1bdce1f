"""Records a session into temporary captures of bounded size, which can be kept as one capture.

They are the parts of one recording, of which the oldest goes when all together are too large.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.replay.recorder import Recorder, RecordWriter
from bilprov.analyzer.replay.rotation import Rotation
from bilprov.captures import topics
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line
from bilprov.captures.text import printable

MOST_BYTES: Final = 1 << 30
PARTS: Final = 16  # so many are there when the oldest goes
_NAME: Final = "session.mcap"


def new_name() -> str:
    """A name for a capture that is kept now."""
    return time.strftime("capture-%Y%m%d-%H%M%S.mcap", time.localtime())


class Spool(Closing):
    """Records as a Recorder does, into temporary files that are deleted at `close`.

    At most about `most` bytes are kept. `failure` is as a Recorder's. Nobody asked for these files,
    so they may fail from the beginning on.
    """

    def __init__(
        self,
        start_wall: int,
        metadata: Mapping[str, str],
        most: int = MOST_BYTES,
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        self.failure = ""
        self._start_wall = start_wall
        self._metadata = dict(metadata)
        self._shapes = shapes
        self._recorder: Recorder | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        try:
            self._folder = tempfile.TemporaryDirectory(
                prefix="bilprov-", ignore_cleanup_errors=True
            )
            self._name = Path(self._folder.name) / _NAME
            rotation = Rotation(size=most // PARTS, keep=PARTS)
            self._recorder = Recorder(self._name, start_wall, metadata, rotation, shapes)
        except (CaptureError, OSError) as error:
            self._note(error.strerror if isinstance(error, OSError) else error)

    @property
    def bytes(self) -> int:
        """How many raw bytes were handed over."""
        return self._recorder.bytes if self._recorder else 0

    @property
    def waited_ns(self) -> int:
        """How long the reader has waited in all for files that were too slow."""
        return self._recorder.waited_ns if self._recorder else 0

    @property
    def oldest(self) -> int:
        """The time (ns since the start) from which on everything is there."""
        return self._recorder.oldest if self._recorder else 0

    def part_due(self, now: int) -> bool:
        """Whether `checkpoint` begins a part at `now` (ns); see Recorder."""
        return self._recorder is not None and self._recorder.part_due(now)

    def events(self, events: Iterable[Chunk | Line]) -> None:
        """Write raw events, before they are decoded."""
        self._do(lambda recorder: recorder.events(events))

    def decoded(self, frames: int, now: int, records: Callable[[], Iterable[Record]]) -> None:
        """Write a decoded batch; see Recorder."""
        self._do(lambda recorder: recorder.decoded(frames, now, records))

    def checkpoint(self, t: int, save: Callable[[], str | None]) -> None:
        """Write a checkpoint at `t` if one is due, or begin the next part if this one is full."""
        self._do(lambda recorder: recorder.checkpoint(t, save))

    def tick(self, now: int) -> None:
        """Let time pass to `now`."""
        self._do(lambda recorder: recorder.tick(now))

    def finish(self) -> None:
        """End the recording; only `keep` and `close` are called after it."""
        self._do(lambda recorder: recorder.finish())

    def keep(self, path: Path) -> None:
        """Keep the finished recording as a new capture.

        Raises CaptureError if there is a file of this name, or if it cannot be written; then the
        temporary files stay, and the sentence says where.
        """
        if self.failure or not self._recorder:
            raise CaptureError(self.failure)
        try:
            if self._recorder.oldest or len(self._recorder.paths) > 1:
                self._join(path, self._recorder.oldest)
            else:
                self._copy(self._recorder.path, path)
        except (CaptureError, OSError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            kept = Path(tempfile.mkdtemp(prefix="bilprov-kept-"))
            for part in self._recorder.paths:
                shutil.move(part, kept)
            raise CaptureError(
                f"{printable(path)} was not written ({printable(why)}); the capture is in {kept}"
            ) from error

    def close(self) -> None:
        """Delete the temporary files; further calls do nothing."""
        if self._recorder:
            self._recorder.close()
        if self._folder:
            self._folder.cleanup()

    def _do(self, act: Callable[[Recorder], object]) -> None:
        """Do something with the recorder, and note its failure; nothing once there was one."""
        if self._recorder and not self.failure:
            act(self._recorder)
            self._note(self._recorder.failure)

    def _note(self, why: object) -> None:
        if why:
            self.failure = f"the session cannot be saved: {printable(why)}"

    @staticmethod
    def _copy(part: Path, path: Path) -> None:
        with path.open("xb") as file, part.open("rb") as source:
            try:
                shutil.copyfileobj(source, file, 1 << 20)
            except BaseException:
                path.unlink(missing_ok=True)
                raise

    def _join(self, path: Path, oldest: int) -> None:
        """Write all parts into one capture; what was decoded from the bytes is left out."""
        with RecordWriter(path, self._start_wall, self._metadata, self._shapes) as writer:
            if oldest:
                gone = f"what came before {oldest / 1e9:.3f} s was dropped: no room"
                writer.event(Line(oldest, "gap", "", gone))
            for event in open_capture(self._name).recorded():
                if isinstance(event, Chunk | Line):
                    writer.event(event)
                elif isinstance(event, Checkpoint):
                    writer.write(event, event.t)
