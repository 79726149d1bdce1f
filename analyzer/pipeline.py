"""The processing of events, shared by sniffing and replaying: record, decode, count, show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bilprov.analyzer.columns.decoder import Part, StreamDecoder
from bilprov.analyzer.decode import checkpoint
from bilprov.captures.schemas import Chunk, Line

if TYPE_CHECKING:
    from bilprov.analyzer.monitor.passive_judge import PassiveJudge
    from bilprov.analyzer.output.outputs import Shown
    from bilprov.analyzer.output.statistics import Statistics
    from bilprov.analyzer.replay.recorder import Recorder
    from bilprov.analyzer.replay.spool import Spool

MOST_BYTES = 1 << 14  # that wait to be decoded: so many take a millisecond, and a pty holds 4 KiB


@dataclass(slots=True)
class Pipeline:
    """Connects a decoder to its recorder, statistics, output (in `shown`) and passive judge.

    The raw bytes are written to the capture at once. Decoding may wait for `patience` (ns), up to
    16 KiB: much is decoded faster at once than in pieces. The judge gets the records in the window
    of `shown`, whether they pass its filter or not.
    """

    decoder: StreamDecoder
    statistics: Statistics
    shown: Shown
    recorder: Recorder | Spool | None = None
    judge: PassiveJudge | None = None
    patience: int = 0
    _pending: list[Chunk | Line] = field(default_factory=list)
    _bytes: int = 0

    @property
    def deadline(self) -> int | None:
        """When (ns) `advance` is next needed without an event, None if it is not."""
        if self._pending:
            return self._pending[0].t + self.patience
        return self.decoder.deadline

    def events(self, events: Sequence[Chunk | Line]) -> list[Part]:
        """Process events, in order, and return what they complete."""
        if not events:
            return []
        if self.recorder:
            self.recorder.events(events)
        if self.judge is None:
            self._pending += events
            self._bytes += sum([len(event.data) for event in events if type(event) is Chunk])
            if self._bytes < MOST_BYTES and events[-1].t - self._pending[0].t < self.patience:
                return []
            parts = self._decode_pending()
        else:
            parts = []  # what is judged depends on the order of events and records
            for event in events:
                self.judge.event(event)
                self._pending = [event]
                parts += self._decode_pending()
        self._save(events[-1].t)
        return parts

    def advance(self, now: int) -> list[Part]:
        """Let time pass to `now` (ns) and return what falls due; no earlier event may follow."""
        parts: list[Part] = []
        if self._pending and now - self._pending[0].t >= self.patience:
            parts = self._decode_pending()
            self._save(now)
        if not self._pending:
            parts += self._parts(self.decoder.advance(now), now)
        self.tick(now)
        return parts

    def tick(self, now: int) -> None:
        """Let recorder and output know the time (ns), where nothing falls due before it."""
        if self.recorder:
            self.recorder.tick(now)
            if not self._pending and self.recorder.part_due(now):
                self._save(now)
        self.shown.output.tick(now)

    def finish(self) -> list[Part]:
        """End the session after its last event and return what is left."""
        parts = self._decode_pending()
        return parts + self._parts(self.decoder.finish(), 0)

    def _decode_pending(self) -> list[Part]:
        events, self._pending, self._bytes = self._pending, [], 0
        if not events:
            return []
        self.statistics.events(events)
        return self._parts(self.decoder.feed(events), events[-1].t)

    def _save(self, now: int) -> None:
        """Write a checkpoint at `now` (ns), if one is due: every recorded event is decoded."""
        if self.recorder:
            self.recorder.checkpoint(now, self._saved)

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
            self.shown.show(part)
            self.statistics.part(part)
        return parts
