"""Records a run: raw bytes both ways, what they mean, each case's begin and end, each look."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

from analyzer.recording import Recorder
from analyzer.session import Session
from captures.schemas import CaseMark, Chunk, Line, Look
from conformance.verdicts import CaseResult


class RunRecorder:
    """A tap of the link that writes everything into a capture. Times are ns since the start.

    Raises CaptureError where the file cannot be written.
    """

    def __init__(
        self, path: str, session: Session, start_wall: int, metadata: Mapping[str, str]
    ) -> None:
        self._session = session
        self._file = Recorder(path, start_wall, metadata)
        self._now = 0
        self._event(Line(0, "open"))

    def _event(self, event: Chunk | Line) -> None:
        self._now = max(self._now, event.t)
        self._file.event(event)
        for record in self._session.feed(event):
            self._file.record(record)
        self._file.tick(self._now)

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that went to the device."""
        self._event(Chunk(max(t, self._now), "host", data))

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""
        self._event(Chunk(max(t, self._now), "device", data))

    def looked(self, look: Look) -> None:
        """A reading of the probe."""
        self._now = max(self._now, look.t)
        self._file.mark(look, look.t)

    def begin(self, ident: str) -> None:
        """A case begins."""
        self._file.mark(CaseMark(self._now, ident, "begin"), self._now)

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        mark = CaseMark(self._now, result.id, "end", result.verdict.label, result.reason)
        self._file.mark(mark, self._now)

    def close(self) -> None:
        """Finish the file."""
        for record in self._session.finish():
            self._file.record(record)
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
