"""The processing of each event, shared by sniffing and replaying: record, decode, count, show."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.outputs import Output, Shown
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.replay.recorder import Recorder
from bilprov.captures.schemas import Chunk, Line


class Pipeline:
    """Connects a session to its recorder, statistics, output and passive judge.

    The raw bytes are written to the capture before they are decoded. `wanted` selects the records
    that may be shown and judged (a replay's window), None for all.
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
        """Whether the requested number of frames was shown."""
        return self._shown.full

    @property
    def deadline(self) -> int | None:
        """The time (ns) at which `advance` is next needed without an event, None if it is not."""
        return self._session.deadline

    def event(self, event: Chunk | Line) -> list[Record]:
        """Process an event and return the records it completes."""
        if self._recorder:
            self._recorder.event(event)
        self._statistics.event(event)
        if self._judge:
            self._judge.event(event)
        return self._records(self._session.feed(event))

    def advance(self, now: int) -> list[Record]:
        """Let time pass to `now` (ns) and return the records due; no earlier event may follow."""
        records = self._records(self._session.advance(now))
        if self._recorder:
            self._recorder.tick(now)
        self._output.tick(now)
        return records

    def finish(self) -> list[Record]:
        """End the session after its last event and return the last records."""
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
