"""Decodes bytes and line events into records while it is known where frames begin.

It uses no port and no clock: the records depend on the events and their times alone. Before each
event, call `until` with the event's time, so that everything due earlier comes first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.pairing import Held, Pair, Pairing, Waiting
from bilprov.analyzer.decode.records import (
    Anomaly,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    written_state,
)
from bilprov.captures.schemas import MS, Instruction, Line, Response
from bilprov.spec.codec import Judgement, judge, spaced
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framed, Framer
from bilprov.spec.protocol import Protocol

QUIET = 20 * MS
"""Ns of idle host line after an answer in mid-frame, after which the frame is given up."""

# Line events after which bytes are known to be missing.
LOSSES = frozenset({"gap", "overrun", "reconnected"})

_Deadline = tuple[int, Callable[[int], Iterable[Record]]]


class Decoder:
    """Decodes the traffic of a host and a device. The first host byte must be a header.

    `timeout` and `skew` (ns) are as in Session; `paired` is true if both directions are heard.
    After a loss the next host byte counts as a header again.
    """

    def __init__(self, protocol: Protocol, *, timeout: int, paired: bool, skew: int) -> None:
        self._protocol = protocol
        self._paired = paired
        self._framer = Framer(protocol.lengths, timeout)
        self._skew = skew
        self._pairing = Pairing(protocol, skew)
        self._judged: Callable[[bytes], Judgement] = lru_cache(maxsize=8192)(
            partial(judge, protocol)
        )
        self._motion = protocol.power_on
        self._state = written_state(self._motion)
        self._sequence = 0
        self._out_of_step: int | None = None  # when the open frame is given up
        self._lost_at: int | None = None  # when bytes were last known to be missing

    @property
    def deadline(self) -> int | None:
        """The time (ns) at which `until` is next needed without an event, None if it is not."""
        due = self._due()
        return due[0] if due else None

    def until(self, now: int) -> Iterator[Record]:
        """Yield the records that fall due up to `now` (ns), in the order in which they are due."""
        while (due := self._due()) and due[0] <= now:
            yield from due[1](due[0])

    def host(self, data: bytes, now: int) -> Iterator[Record]:
        """Decode host bytes; each frame is handled as if it had arrived by itself."""
        self._out_of_step = None
        at = 0
        while at < len(data):
            size = self._framer.missing or 1 + self._protocol.lengths[data[at]]
            for framed in self._framer.feed(data[at : at + size], now):
                yield from self._framed(framed)
            yield from self.until(now)
            at += size

    def device(self, data: bytes, now: int) -> Iterator[Record]:
        """Decode device bytes; each is handled as if it had arrived by itself."""
        for byte in data:
            yield from self._answer(byte, now)
            yield from self.until(now)

    def line(self, event: Line) -> Iterator[Record]:
        """Handle a line event; after a loss, framing and pairing start anew."""
        lost = event.event in LOSSES
        if lost:
            self._out_of_step = None
            self._lost_at = event.t
            if event.tap != "device":
                for framed in self._framer.drop(event.t):
                    yield self.garbage(framed, anomalies.LOST)
            for held in self._pairing.forget():
                yield self._unsolicited(held)
        yield LineRecord(event, lost, self._state, anomalies.of_line(event, lost))

    def garbage(self, framed: Framed, reason: str) -> Record:
        """The record of host bytes that belong to no frame; `reason` says why."""
        faults = anomalies.of_garbage(framed.known, reason)
        return self._host_record(framed, None, None, reason, faults)

    def finish(self, now: int) -> Iterator[Record]:
        """End the recording at `now` (ns): cut the open frame short and release held answers."""
        for framed in self._framer.drop(now, "truncated"):
            yield from self._framed(framed)
        while self._pairing.held:
            yield self._unsolicited(self._pairing.release())

    def _due(self) -> _Deadline | None:
        """The next due time and its handler; at equal times the end of the frame comes first."""
        frame_end = self._framer.deadline
        patience = self._pairing.patience(frame_end)
        expiry = self._pairing.expiry
        if frame_end is None and patience is None and expiry is None:
            return None
        due: list[_Deadline] = []
        if frame_end is not None:
            due.append((frame_end, self._cut_short))
        if self._out_of_step is not None:
            due.append((self._out_of_step, self._give_up_frame))
        if patience is not None:
            due.append((patience, self._give_up_answer))
        if expiry is not None:
            due.append((expiry, self._give_up_waiting))
        return min(due, key=lambda item: item[0])

    def _cut_short(self, now: int) -> Iterator[Record]:
        for framed in self._framer.advance(now):
            yield from self._framed(framed)

    def _give_up_frame(self, now: int) -> Iterator[Record]:
        """Give up a frame in which the device answered and which the host did not continue.

        The bytes are garbage, because framing was out of step. But if the answer is the one that a
        truncated frame gets, the device's time-out was shorter than ours and the frame is truncated
        (R-truncation-timeout).
        """
        self._out_of_step = None
        held = self._pairing.held
        expected = self._judged(self._framer.held).response.code
        if held is not None and held.byte == expected:
            for framed in self._framer.drop(now, "truncated"):
                yield from self._framed(framed)
            return
        for framed in self._framer.drop(now):
            yield self.garbage(framed, anomalies.MID_FRAME)
        while self._pairing.held:
            yield self._unpaired(self._pairing.release(), anomalies.OUT_OF_STEP)

    def _give_up_answer(self, now: int) -> Iterator[Record]:
        yield self._unsolicited(self._pairing.release())

    def _give_up_waiting(self, now: int) -> Iterator[Record]:
        yield FaultRecord(anomalies.unanswered(self._pairing.expire(), now), self._state)

    def _framed(self, framed: Framed) -> Iterator[Record]:
        """Judge a frame that has ended, whole or cut short, and pair it with a held answer."""
        self._out_of_step = None
        judgement = self._judged(framed.data)
        sequence = self._sequence
        self._sequence += 1
        effect = self._protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        self._motion = effect.apply(self._motion, dict(judgement.fields))
        self._state = written_state(self._motion)
        faults = anomalies.of_frame(judgement, framed.known, sequence)
        yield self._host_record(framed, judgement, sequence, judgement.reason, faults)
        if self._paired:
            for pair in self._pairing.instruction(sequence, framed.end, judgement):
                yield from self._paired_up(pair)

    def _answer(self, byte: int, now: int) -> Iterator[Record]:
        if not self._paired:
            yield self._unpaired(Held(now, byte), anomalies.ALONE)
            return
        if self._pairing.idle and self._framer.missing and self._out_of_step is None:
            answer = self._protocol.codes.get(byte)
            ok = answer is not None and answer.outcome is Outcome.VALID
            if ok or self._may_be_valid(self._framer.held[0]):
                self._out_of_step = now + QUIET
        for pair in self._pairing.answer(byte, now):
            yield from self._paired_up(pair)

    def _may_be_valid(self, header: int) -> bool:
        """Whether a frame with this header may be valid, so that no answer is due before its end.

        A device may refuse a faulty header at once and take its data in silence (R-answer-point).
        """
        identity, length = self._protocol.headers[header]
        known = self._protocol.by_id.get(identity)
        return known is not None and known.length == length

    def _paired_up(self, pair: Pair) -> Iterator[Record]:
        for passed in pair.passed:
            yield FaultRecord(anomalies.unanswered(passed, pair.held.t), self._state)
        verdict = anomalies.of_answer(self._protocol, pair, self._skew)
        yield self._device_record(pair.held, pair.waiting, verdict)

    def _unsolicited(self, held: Held) -> Record:
        near_loss = self._lost_at is not None and held.t - self._lost_at <= self._pairing.late
        return self._unpaired(held, anomalies.unsolicited_because(self._sequence, near_loss))

    def _unpaired(self, held: Held, why: anomalies.Cause) -> Record:
        verdict = anomalies.of_unpaired(self._protocol, held, why)
        return self._device_record(held, None, verdict)

    def _host_record(
        self,
        framed: Framed,
        judgement: Judgement | None,
        sequence: int | None,
        reason: str,
        faults: tuple[Anomaly, ...],
    ) -> HostRecord:
        """The record of a frame, whole or cut short, or of garbage, which has no judgement."""
        spec = judgement.instruction if judgement else None
        value = Instruction(
            t=framed.start,
            end=framed.end,
            kind=framed.kind,
            hex=spaced(framed.data),
            sequence=sequence,
            id=judgement.id if judgement else None,
            name=spec.name if spec else None,
            length=judgement.length if judgement else None,
            fields=dict(judgement.fields) if judgement else {},
            judgement=judgement.response.name if judgement else None,
            reason=reason,
        )
        return HostRecord(value, framed.data, judgement, self._state, faults)

    def _device_record(
        self, held: Held, waiting: Waiting | None, verdict: anomalies.AnswerCheck
    ) -> DeviceRecord:
        """The record of a device byte that answers `waiting` (None: it answers no instruction)."""
        answer = self._protocol.codes.get(held.byte)
        value = Response(
            t=held.t,
            hex=f"{held.byte:02x}",
            byte=held.byte,
            name=answer.name if answer else None,
            instruction=waiting.sequence if waiting else None,
            latency=held.t - waiting.end if waiting else None,
            agrees=verdict.agrees,
            reason="; ".join(fault.reason for fault in verdict.faults),
        )
        answered = waiting.judgement if waiting else None
        return DeviceRecord(value, answer, answered, self._state, verdict.faults)
