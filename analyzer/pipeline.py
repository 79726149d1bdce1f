"""The processing of events, shared by sniffing and replaying: record, decode, count, show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import add
from typing import TYPE_CHECKING

from bilprov.analyzer.decode.checkpoint import encoded_or_none
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.captures.schemas import Chunk, Line

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.monitor.passive_judge import PassiveJudge
    from bilprov.analyzer.output.outputs import Shown
    from bilprov.analyzer.replay.recorder import Recorder

BATCH = 100_000_000  # ns; the screen is not drawn more often than that
MOST_BYTES = 1 << 14  # that wait to be decoded: so many take a millisecond, and a pty holds 4 KiB


@dataclass(slots=True)
class Pipeline:
    """Connects a decoder to its recorder, output (in `shown`) and passive judge.

    The raw bytes are written to the capture at once. Decoding may wait for `patience` (ns), up to
    16 KiB: much is decoded faster at once than in pieces. On a line that is `busy` it waits for
    0.1 s at least. The judge gets the records in the window of `shown`, whether they pass its
    filter or not. `counts` are of all that was decoded: frames, answers and faults.
    """

    decoder: StreamDecoder
    shown: Shown
    recorder: Recorder | None = None
    judge: PassiveJudge | None = None
    patience: int = 0
    busy: bool = False
    counts: tuple[int, ...] = (0, 0, 0)
    _pending: list[Chunk | Line] = field(default_factory=list)
    _bytes: int = 0

    @property
    def deadline(self) -> int | None:
        """When (ns) `advance` is next needed without an event, None if it is not."""
        if self._pending:
            return self._pending[0].t + self._wait
        return self.decoder.deadline

    @property
    def _wait(self) -> int:
        """How long (ns) the first event may wait to be decoded with those behind it."""
        return max(self.patience, BATCH) if self.busy else self.patience

    def events(self, events: Sequence[Chunk | Line]) -> list[Batch]:
        """Process events, in order, and return what they complete."""
        if not events:
            return []
        if self.recorder:
            self.recorder.events(events)
        if self.judge is None:
            self._pending += events
            self._bytes += sum([len(event.data) for event in events if type(event) is Chunk])
            if self._bytes < MOST_BYTES and events[-1].t - self._pending[0].t < self._wait:
                return []
            batches = self._decode_pending()
        else:
            batches = []  # what is judged depends on the order of events and records
            for event in events:
                self.judge.event(event)
                self._pending = [event]
                batches += self._decode_pending()
        self._save(events[-1].t)
        return batches

    def advance(self, now: int) -> list[Batch]:
        """Let time pass to `now` (ns) and return what falls due; no earlier event may follow."""
        batches: list[Batch] = []
        if self._pending and now - self._pending[0].t >= self._wait:
            batches = self._decode_pending()
            self._save(now)
        if not self._pending:
            batches += self._handled(self.decoder.advance(now), now)
        self.tick(now)
        return batches

    def tick(self, now: int) -> None:
        """Let recorder and output know the time (ns), where nothing falls due before it."""
        if self.recorder:
            self.recorder.tick(now)
            if not self._pending and self.recorder.part_due(now):
                self._save(now)
        self.shown.output.tick(now)

    def finish(self) -> list[Batch]:
        """End the session after its last event and return what is left."""
        batches = self._decode_pending()
        return batches + self._handled(self.decoder.finish(), 0)

    def _decode_pending(self) -> list[Batch]:
        events, self._pending, self._bytes = self._pending, [], 0
        if not events:
            return []
        return self._handled(self.decoder.feed(events), events[-1].t)

    def _save(self, now: int) -> None:
        """Write a checkpoint at `now` (ns), if one is due: every recorded event is decoded."""
        if self.recorder:
            self.recorder.checkpoint(now, lambda: encoded_or_none(self.decoder.saved()))

    def _handled(self, batches: list[Batch], now: int) -> list[Batch]:
        for batch in batches:
            if self.recorder:
                self.recorder.decoded(batch.counts.frames, now, batch.records)
            if self.judge:
                for record in batch.records():
                    if self.shown.window.has(record.t):
                        self.judge.record(record)
            self.shown.show(batch)
            self.counts = tuple(map(add, self.counts, batch.counts))
        return batches
