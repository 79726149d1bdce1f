"""Records a run: raw bytes both ways, what they mean, each case's begin and end, each look."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import TracebackType
from typing import Self

from analyzer.recording import Recorder
from analyzer.records import Record
from analyzer.session import Session
from captures.errors import CaptureError
from captures.schemas import CaseMark, Chunk, Line, Look
from conformance.verdicts import CaseResult


class RunRecorder:
    """A tap of the link that writes everything into a capture. Times are ns since the start.

    Raises CaptureError where the file cannot be made. What goes wrong later (a full disk) must not
    keep the run from stopping the robot: it is kept in `broken`, and nothing more is written.
    """

    broken: CaptureError | None = None

    def __init__(
        self, path: str, session: Session, start_wall: int, metadata: Mapping[str, str]
    ) -> None:
        self._session = session
        self._file = Recorder(path, start_wall, metadata)
        self._now = 0
        self._event(Line(0, "open"))

    def _event(self, event: Chunk | Line) -> None:
        self._now = max(self._now, event.t)

        def write() -> None:
            self._file.event(event)
            self._decoded(self._session.feed(event))
            self._file.tick(self._now)

        self._try(write)

    def _mark(self, value: CaseMark | Look) -> None:
        self._now = max(self._now, value.t)
        self._try(lambda: self._file.mark(value, value.t))

    def _decoded(self, records: Iterable[Record]) -> None:
        for record in records:
            self._file.record(record)

    def _try(self, write: Callable[[], None]) -> None:
        if self.broken is None:
            try:
                write()
            except CaptureError as error:
                self.broken = error

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that went to the device."""
        self._event(Chunk(max(t, self._now), "host", data))

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""
        self._event(Chunk(max(t, self._now), "device", data))

    def looked(self, look: Look) -> None:
        """A reading of the probe."""
        self._mark(look)

    def begin(self, ident: str) -> None:
        """A case begins."""
        self._mark(CaseMark(self._now, ident, "begin"))

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._mark(CaseMark(self._now, result.id, "end", result.verdict.label, result.reason))

    def close(self) -> None:
        """Finish the file."""
        self._try(lambda: self._decoded(self._session.finish()))
        self._try(self._file.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
