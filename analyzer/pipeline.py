"""One event in, and it is kept, decoded, counted and shown: the same for sniffing and replaying."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from analyzer.decode.records import Record
from analyzer.decode.session import Session
from analyzer.monitor.passive_judge import PassiveJudge
from analyzer.output.outputs import Output, Shown
from analyzer.output.statistics import Statistics
from analyzer.replay.recorder import Recorder
from captures.schemas import Chunk, Line


class Pipeline:
    """Joins a session to what is done with its records.

    The raw bytes reach the capture before anything is made of them. `wanted` decides which records
    may be shown and judged at all (a replay's window), None for all.
    """

    def __init__(
        self,
        session: Session,
        statistics: Statistics,
        output: Output,
        shown: Shown,
        recorder: Recorder | None = None,
        wanted: Callable[[Record], bool] | None = None,
        judge: PassiveJudge | None = None,
    ) -> None:
        self._session = session
        self._statistics = statistics
        self._output = output
        self._shown = shown
        self._recorder = recorder
        self._wanted = wanted
        self._judge = judge

    @property
    def full(self) -> bool:
        """Whether as many frames were shown as were asked for."""
        return self._shown.full

    @property
    def deadline(self) -> int | None:
        """When (ns) something falls due without an event, None if nothing does."""
        return self._session.deadline

    def event(self, event: Chunk | Line) -> list[Record]:
        """Take an event; gives the records that it decided."""
        if self._recorder:
            self._recorder.event(event)
        self._statistics.event(event)
        if self._judge:
            self._judge.event(event)
        return self._records(self._session.feed(event))

    def advance(self, now: int) -> list[Record]:
        """Let time pass: no event before `now` (ns) is still to come."""
        records = self._records(self._session.advance(now))
        if self._recorder:
            self._recorder.tick(now)
        self._output.tick(now)
        return records

    def finish(self) -> list[Record]:
        """The last event has come: what was waiting comes out."""
        return self._records(self._session.finish())

    def _records(self, records: Iterable[Record]) -> list[Record]:
        listed = list(records)
        for record in listed:
            if self._recorder:
                self._recorder.record(record)
            wanted = self._wanted is None or self._wanted(record)
            if wanted and self._judge:
                self._judge.record(record)
            shown = wanted and self._shown.show(record)
            self._statistics.record(record, shown=shown)
        return listed
