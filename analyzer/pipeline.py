"""The processing of each event, shared by sniffing and replaying: record, decode, count, show."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.outputs import Shown
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.replay.recorder import Recorder
from bilprov.captures.schemas import Chunk, Line


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Connects a session to its recorder, statistics, output (in `shown`) and passive judge.

    The raw bytes are written to the capture before they are decoded. `wanted` selects the records
    that may be shown and judged (a replay's window), None for all.
    """

    session: Session
    statistics: Statistics
    shown: Shown
    recorder: Recorder | None = None
    wanted: Callable[[Record], bool] | None = None
    judge: PassiveJudge | None = None

    def event(self, event: Chunk | Line) -> list[Record]:
        """Process an event and return the records it completes."""
        if self.recorder:
            self.recorder.event(event)
        self.statistics.event(event)
        if self.judge:
            self.judge.event(event)
        return self._records(self.session.feed(event))

    def advance(self, now: int) -> list[Record]:
        """Let time pass to `now` (ns) and return the records due; no earlier event may follow."""
        records = self._records(self.session.advance(now))
        if self.recorder:
            self.recorder.tick(now)
        self.shown.output.tick(now)
        return records

    def finish(self) -> list[Record]:
        """End the session after its last event and return the last records."""
        return self._records(self.session.finish())

    def _records(self, records: Iterable[Record]) -> list[Record]:
        listed = list(records)
        for record in listed:
            if self.recorder:
                self.recorder.record(record)
            wanted = self.wanted is None or self.wanted(record)
            if wanted and self.judge:
                self.judge.record(record)
            shown = wanted and self.shown.show(record)
            self.statistics.record(record, shown=shown)
        return listed
