"""Chunks and line events in, decoded records out: the one way in which bytes become records.

Sniffing, replaying and decoding all go through here, so a replayed capture shows what the live run
showed. No port, no clock: what comes out depends on the events and their times alone. Before each
event everything that fell due up to its time happens, in order of the times at which it was due.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial

from analyzer import oddities
from analyzer.hunt import Hunt
from analyzer.pairing import MILLISECOND, Held, Pair, Pairing
from analyzer.record_forms import answer_record, frame_record, garbage_record
from analyzer.records import FaultRecord, LineRecord, Record, written_state
from captures.schemas import Chunk, Direction, Line
from spec.codec import Judgement, judge
from spec.fields import Outcome
from spec.framing import Framed, Framer
from spec.protocol import Protocol

SKEW = 20 * MILLISECOND
"""How far two taps through USB may stamp an answer before its instruction."""

QUIET = 20 * MILLISECOND
"""How long the host line stays idle after an answer in mid-frame until the frame is given up."""

BOTH: frozenset[Direction] = frozenset({"host", "device"})

# Line events after which bytes are known to be missing.
LOSSES = frozenset({"gap", "overrun", "reconnected"})

_Deadline = tuple[int, Callable[[int], Iterable[Record]]]


class Session:
    """Decodes one recording from its first event to its last.

    `timeout` (ns) is the longest pause inside a host frame, None for the protocol's own. `heard`
    are the directions that are listened to: with one alone nothing is paired. `skew` (ns) is how
    far an answer may be stamped before its instruction; 0 where both come through one clock.
    `attached` tells that listening began in the midst of whatever was going on: the first byte need
    not be a header, unless the host was silent for the time-out before it.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        timeout: int | None = None,
        heard: frozenset[Direction] = BOTH,
        skew: int = SKEW,
        attached: bool = False,
    ) -> None:
        self._protocol = protocol
        self._paired = heard >= BOTH
        if timeout is None:
            timeout = round(protocol.timing.truncation_timeout * MILLISECOND)
        self._timeout = timeout
        self._framer = Framer(protocol.lengths, timeout)
        self._skew = skew
        self._pairing = Pairing(protocol, skew)
        self._judged: Callable[[bytes], Judgement] = lru_cache(maxsize=8192)(
            partial(judge, protocol)
        )
        self._motion = protocol.power_on
        self._state = written_state(self._motion)
        self._sequence = 0
        self._time = 0
        self._out_of_step: int | None = None  # when the frame begun is given up
        self._lost_at: int | None = None  # when bytes were last known to be missing
        # Since when it is not known where frames begin and the host is silent; None if it is known.
        self._adrift: int | None = 0 if attached else None
        self._answered = False  # whether the device has spoken since then
        self._hunt: Hunt | None = None

    @property
    def deadline(self) -> int | None:
        """When (ns) something falls due even if no event comes, None if nothing does."""
        due = self._due()
        return due[0] if due else None

    def feed(self, event: Chunk | Line) -> list[Record]:
        """What an event decides. One that is older than the last counts as coming with it."""
        now = max(event.t, self._time)
        out = list(self._until(now))
        self._time = now
        return out + list(self._event(event, now))

    def advance(self, now: int) -> list[Record]:
        """What falls due until `now` (ns), if no event before `now` is still to come."""
        return list(self._until(now))

    def finish(self, t: int | None = None) -> list[Record]:
        """The recording ends, at `t` (ns) or with its last event: what was waiting comes out.

        A frame that is not complete is reported as cut short, an answer that was held as
        unsolicited. Whether an instruction would still have been answered is not known.
        """
        out = self.advance(self._time if t is None else t)
        while self._hunt:
            out += self._end_hunt(self._hunt)
        for framed in self._framer.drop(self._time, "truncated"):
            out += self._framed(framed)
        while self._pairing.held:
            out.append(self._unsolicited(self._pairing.release()))
        return out

    def _event(self, event: Chunk | Line, now: int) -> Iterator[Record]:
        """What an event decides at `now`, when all that fell due before has happened."""
        if isinstance(event, Line):
            if self._hunt and event.event not in LOSSES:
                self._hunt.other(event)
                return
            while self._hunt:
                yield from self._end_hunt(self._hunt)
            yield from self._line(event, now)
        elif event.direction == "host":
            yield from self._host(event.data, now)
        elif self._hunt:
            self._hunt.other(event)
            if self._hunt.over:
                yield from self._end_hunt(self._hunt)
        else:
            self._answered = True
            for byte in event.data:
                yield from self._answer(byte, now)
                yield from self._until(now)

    def _host(self, data: bytes, now: int) -> Iterator[Record]:
        """Host bytes; each frame, and while hunting each byte, as if it had come by itself."""
        self._out_of_step = None
        at = 0
        while at < len(data):
            if self._adrift is not None:
                if now - self._adrift < self._timeout:
                    self._hunt = Hunt(self._protocol, self._timeout, self._adrift, self._answered)
                self._adrift = None
            if self._hunt:
                size = 1
                self._hunt.host(data[at], now)
                if self._hunt.over:
                    yield from self._end_hunt(self._hunt)
            else:
                size = self._framer.missing or 1 + self._protocol.lengths[data[at]]
                for framed in self._framer.feed(data[at : at + size], now):
                    yield from self._framed(framed)
            at += size
            yield from self._until(now)

    def _end_hunt(self, hunt: Hunt) -> Iterator[Record]:
        """It is known where frames begin: what was held happens now, each at its own time."""
        self._hunt = None
        for event in hunt.settled():
            if isinstance(event, Framed):
                yield from self._until(event.known)
                yield self._garbage(event, oddities.ATTACHED)
            else:
                yield from self._until(event.t)
                yield from self._event(event, event.t)

    def _until(self, now: int) -> Iterator[Record]:
        while (due := self._due()) and due[0] <= now:
            yield from due[1](due[0])

    def _due(self) -> _Deadline | None:
        """The next thing that falls due; at the same time the frame's own end comes first."""
        if self._hunt:
            return self._hunt.deadline, self._heard_silence
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

    def _heard_silence(self, now: int) -> Iterator[Record]:
        if self._hunt:
            self._hunt.silence()
            yield from self._end_hunt(self._hunt)

    def _cut_short(self, now: int) -> Iterator[Record]:
        for framed in self._framer.advance(now):
            yield from self._framed(framed)

    def _give_up_frame(self, now: int) -> Iterator[Record]:
        """The device answered in mid-frame and the host said no more: not a frame of this step.

        Unless the answer is the one that a frame cut short gets: then the device lost its patience
        before we did (R-truncation-timeout).
        """
        self._out_of_step = None
        held = self._pairing.held
        expected = self._judged(self._framer.held).response.code
        if held is not None and held.byte == expected:
            for framed in self._framer.drop(now, "truncated"):
                yield from self._framed(framed)
            return
        for framed in self._framer.drop(now):
            yield self._garbage(framed, oddities.MID_FRAME)
            self._adrift, self._answered = framed.end, True
        while self._pairing.held:
            yield self._unpaired(self._pairing.release(), oddities.OUT_OF_STEP)

    def _give_up_answer(self, now: int) -> Iterator[Record]:
        yield self._unsolicited(self._pairing.release())

    def _give_up_waiting(self, now: int) -> Iterator[Record]:
        yield FaultRecord(oddities.unanswered(self._pairing.expire(), now), self._state)

    def _framed(self, framed: Framed) -> Iterator[Record]:
        """A frame is over, whole or cut short."""
        self._out_of_step = None
        judgement = self._judged(framed.data)
        sequence = self._sequence
        self._sequence += 1
        effect = self._protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        self._motion = effect.apply(self._motion, dict(judgement.fields))
        self._state = written_state(self._motion)
        faults = oddities.of_frame(judgement, framed.known, sequence)
        yield frame_record(framed, judgement, sequence, self._state, faults)
        if self._paired:
            for pair in self._pairing.instruction(sequence, framed.end, judgement):
                yield from self._paired_up(pair)

    def _garbage(self, framed: Framed, reason: str) -> Record:
        faults = oddities.of_garbage(framed.known, reason)
        return garbage_record(framed, reason, self._state, faults)

    def _answer(self, byte: int, now: int) -> Iterator[Record]:
        if not self._paired:
            yield self._unpaired(Held(now, byte), oddities.ALONE)
            return
        if self._pairing.idle and self._framer.missing and self._out_of_step is None:
            answer = self._protocol.codes.get(byte)
            ok = answer is not None and answer.outcome is Outcome.VALID
            if ok or self._may_be_valid(self._framer.held[0]):
                self._out_of_step = now + QUIET
        for pair in self._pairing.answer(byte, now):
            yield from self._paired_up(pair)

    def _may_be_valid(self, header: int) -> bool:
        """Whether a frame that begins so may be valid, and was not to be answered yet.

        A device may refuse a faulty header at once and take its data in silence (R-answer-point).
        """
        identity, length = self._protocol.headers[header]
        known = self._protocol.by_id.get(identity)
        return known is not None and known.length == length

    def _paired_up(self, pair: Pair) -> Iterator[Record]:
        for passed in pair.passed:
            yield FaultRecord(oddities.unanswered(passed, pair.held.t), self._state)
        verdict = oddities.of_answer(self._protocol, pair, self._skew)
        yield answer_record(self._protocol, pair.held, pair.waiting, verdict, self._state)

    def _unsolicited(self, held: Held) -> Record:
        near_loss = self._lost_at is not None and held.t - self._lost_at <= self._pairing.late
        return self._unpaired(held, oddities.unsolicited_because(self._sequence, near_loss))

    def _unpaired(self, held: Held, why: oddities.Why) -> Record:
        verdict = oddities.of_unpaired(self._protocol, held, why)
        return answer_record(self._protocol, held, None, verdict, self._state)

    def _line(self, event: Line, now: int) -> Iterator[Record]:
        lost = event.event in LOSSES
        if lost:
            self._out_of_step = None
            self._lost_at = now
            if event.tap != "device":
                self._adrift, self._answered = now, False
                for framed in self._framer.drop(now):
                    yield self._garbage(framed, oddities.LOST)
            for held in self._pairing.forget():
                yield self._unsolicited(held)
        line = Line(now, event.event, event.tap, event.detail)
        yield LineRecord(line, lost, self._state, oddities.of_line(line, lost))
