"""Reads the host's frames of a capture one by one, each with what the device answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
)
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.replay.capture_parts import Progress, decoded_batches
from bilprov.analyzer.replay.capture_session import heard
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol


@dataclass(slots=True, eq=False)
class Exchange:
    """A frame of the host and its answer. The first one of a capture has no frame.

    `missing` tells that no answer came; without it and without an answer it is not known if one
    would have come. `unasked` are device bytes behind it that answer no instruction.
    """

    frame: HostRecord | None
    answer: DeviceRecord | None = None
    missing: bool = False
    unasked: bytearray = field(default_factory=bytearray)
    settled: bool = True

    @property
    def key(self) -> tuple[str, bytes]:
        """What has to be the same in two captures for them to be compared."""
        return (self.frame.kind, self.frame.data) if self.frame else ("", b"")

    @property
    def told(self) -> bool:
        """Whether it is known what was answered."""
        return self.missing or self.answer is not None


def exchanges(capture: Capture, protocol: Protocol, progress: Progress) -> Iterator[Exchange]:
    """Yield the exchanges of a capture in order.

    Raises CaptureError as `Capture.events` does.
    """
    pairs = _Pairs(paired=heard(capture) >= BOTH)
    for batch in decoded_batches(capture, protocol, progress):
        for record in batch.records():
            pairs.record(record)
        yield from pairs.settled()
    pairs.give_up()
    yield from pairs.rest


class _Pairs:
    """Puts the records of a recording together; `rest` are exchanges that are not handed out."""

    def __init__(self, *, paired: bool) -> None:
        self.rest: deque[Exchange] = deque([Exchange(None)])
        self._paired = paired
        self._waiting: dict[int, Exchange] = {}

    def record(self, record: Record) -> None:
        """Add the next record."""
        if isinstance(record, HostRecord):
            waits = self._paired and record.sequence is not None
            self.rest.append(Exchange(record, settled=not waits))
            if waits and record.sequence is not None:
                self._waiting[record.sequence] = self.rest[-1]
        elif isinstance(record, DeviceRecord):
            if record.instruction is None:
                self.rest[-1].unasked += record.data
            elif (exchange := self._waiting.pop(record.instruction, None)) is not None:
                exchange.answer, exchange.settled = record, True
        elif isinstance(record, FaultRecord):
            number = record.fault.instruction
            if number is not None and (exchange := self._waiting.pop(number, None)) is not None:
                exchange.missing, exchange.settled = True, True
        elif isinstance(record, LineRecord) and record.lost:
            self.give_up()

    def give_up(self) -> None:
        """No more will be known of those that wait."""
        for exchange in self._waiting.values():
            exchange.settled = True
        self._waiting.clear()

    def settled(self) -> Iterator[Exchange]:
        """Yield those of which all is known; the last one may still get unasked bytes."""
        while len(self.rest) > 1 and self.rest[0].settled:
            yield self.rest.popleft()
