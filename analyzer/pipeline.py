"""The processing of events, shared by sniffing and replaying: record, decode, count, show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bilprov.analyzer.columns.decoder import Part, StreamDecoder
from bilprov.analyzer.decode import checkpoint
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.outputs import Shown
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.replay.recorder import Recorder
from bilprov.captures.schemas import Chunk, Line


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Connects a decoder to its recorder, statistics, output (in `shown`) and passive judge.

    The raw bytes are written to the capture before they are decoded. The judge gets the records in
    the window of `shown`, whether they pass its filter or not.
    """

    decoder: StreamDecoder
    statistics: Statistics
    shown: Shown
    recorder: Recorder | None = None
    judge: PassiveJudge | None = None

    def events(self, events: Sequence[Chunk | Line]) -> list[Part]:
        """Process events, in order, and return what they complete."""
        if not events:
            return []
        if self.judge is None:
            return self._events(events)
        parts: list[Part] = []  # what is judged depends on the order of events and records
        for event in events:
            self.judge.event(event)
            parts += self._events([event])
        return parts

    def advance(self, now: int) -> list[Part]:
        """Let time pass to `now` (ns) and return what falls due; no earlier event may follow."""
        parts = self._parts(self.decoder.advance(now), now)
        if self.recorder:
            self.recorder.tick(now)
        self.shown.output.tick(now)
        return parts

    def finish(self) -> list[Part]:
        """End the session after its last event and return what is left."""
        return self._parts(self.decoder.finish(), 0)

    def _events(self, events: Sequence[Chunk | Line]) -> list[Part]:
        if self.recorder:
            self.recorder.events(events)
        self.statistics.events(events)
        now = events[-1].t
        parts = self._parts(self.decoder.feed(events), now)
        if self.recorder:
            self.recorder.checkpoint(now, self._saved)
        return parts

    def _saved(self) -> str | None:
        state = self.decoder.saved()
        return None if state is None else checkpoint.encoded(state)

    def _parts(self, parts: list[Part], now: int) -> list[Part]:
        for part in parts:
            if self.recorder:
                self.recorder.decoded(part.host_rows, now, part.records)
            if self.judge:
                for record in part.records():
                    if self.shown.window.has(record.t):
                        self.judge.record(record)
            self.statistics.part(part, self.shown.show(part))
        return parts
