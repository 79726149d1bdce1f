"""Records a session into temporary captures of bounded size, which can be kept as one capture.

They are the parts of one recording, of which the oldest goes when all together are too large.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from bilprov.analyzer.replay.recorder import Recorder, RecordWriter, Rotation
from bilprov.captures import topics
from bilprov.captures.background import BackgroundWriter
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


class _Nowhere(BackgroundWriter):
    """Stands for a writer whose file could not be made: it has failed from the beginning on."""

    def __init__(self, failure: str) -> None:
        self.failure, self.waited_ns, self.oldest = failure, 0, 0

    def close(self) -> None:
        """Do nothing."""


class Spool(Recorder):
    """Records into temporary files that are deleted at `close`.

    At most about `most` bytes are kept. Nobody asked for these files, so they may fail from the
    beginning on. After `finish` only `keep` and `close` are called.
    """

    def __init__(
        self,
        start_wall: int,
        metadata: Mapping[str, str],
        most: int = MOST_BYTES,
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        self._shapes = shapes
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        rotation = Rotation(size=most // PARTS, keep=PARTS)
        try:
            self._folder = tempfile.TemporaryDirectory(
                prefix="bilprov-", ignore_cleanup_errors=True
            )
            super().__init__(Path(self._folder.name, _NAME), start_wall, metadata, rotation, shapes)
        except (CaptureError, OSError) as error:
            self.bytes = 0
            self._writer = _Nowhere(str(_why(error)))

    @property
    def failure(self) -> str:
        """Why the session cannot be saved, in one sentence; "" while it can."""
        why = self._writer.failure
        return f"the session cannot be saved: {printable(why)}" if why else ""

    def keep(self, path: Path) -> None:
        """Keep the finished recording as a new capture.

        Raises CaptureError if there is a file of this name, or if it cannot be written; then the
        temporary files stay, and the sentence says where.
        """
        if self.failure:
            raise CaptureError(self.failure)
        try:
            if self.oldest or len(self.paths) > 1:
                self._join(path)
            else:
                self._copy(self.path, path)
        except (CaptureError, OSError) as error:
            kept = Path(tempfile.mkdtemp(prefix="bilprov-kept-"))
            for part in self.paths:
                shutil.move(part, kept)
            why = printable(_why(error))
            raise CaptureError(
                f"{printable(path)} was not written ({why}); the capture is in {kept}"
            ) from error

    def close(self) -> None:
        """Delete the temporary files; further calls do nothing."""
        super().close()
        if self._folder:
            self._folder.cleanup()

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
        with RecordWriter(path, self._start, self._metadata, self._shapes) as writer:
            if self.oldest:
                gone = f"what came before {self.oldest / 1e9:.3f} s was dropped: no room"
                writer.event(Line(self.oldest, "gap", "", gone))
            for event in open_capture(self._name).recorded():
                if isinstance(event, Chunk | Line):
                    writer.event(event)
                elif isinstance(event, Checkpoint):
                    writer.write(event, event.t)


def _why(error: CaptureError | OSError) -> object:
    return error.strerror if isinstance(error, OSError) else error
