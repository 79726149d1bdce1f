"""Decodes bytes and line events into records while it is known where frames begin.

It uses no port and no clock: the records depend on the events and their times alone. Before each
event, call `until` with the event's time, so that everything due earlier comes first. Each method
appends the records to the list that it gets, since a list costs less per record than a generator.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Final

from msgspec import UNSET
from msgspec.structs import replace

from bilprov.analyzer.decode import anomalies, pairing
from bilprov.analyzer.decode.checkpoint import QUIET, DecoderState
from bilprov.analyzer.decode.pairing import MOST, Heard, Held, ReplyFramer, Waiting
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
)
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.spec.codec import FRAMING_FAULTS, Judgement, Steps
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framed, Framer, Kind, frame_size
from bilprov.spec.protocol import NO_ANSWER, Protocol
from bilprov.spec.replies import GIVES_UP, reported
from bilprov.spec.state import OTHERS, Assigned, State, after

# Line events after which bytes are known to be missing.
LOSSES = frozenset({"gap", "overrun", "reconnected"})
# The line event from which on nothing was read, until the event that follows it.
UNREAD: Final = "waited"
# Line events after which decoding goes on in another way.
TURNS = LOSSES | {"unplugged", UNREAD}

SIDES: Final[tuple[Direction, ...]] = ("host", "device")

_Due = Callable[[int, list[Record]], None]


class Decoder:
    """Decodes the traffic of a host and a device. The first host byte must be a header.

    `timeout` and `skew` (ns) are as in Session, `answer_pause` (ns) is the longest pause within an
    answer; `paired` is true if both directions are heard.
    After a loss the next host byte counts as a header again.
    """

    def __init__(
        self, protocol: Protocol, *, timeout: int, paired: bool, skew: int, answer_pause: int
    ) -> None:
        self._protocol = protocol
        self._both_heard = paired
        self._away: frozenset[Direction] = frozenset()  # the sides whose port is unplugged
        self._paired = paired
        self._framer = Framer(protocol, timeout)
        self._replies = ReplyFramer(protocol, answer_pause)
        self._skew = skew
        # The queues of the instructions that wait for an answer and of the answers held for one,
        # the oldest first; one of them is empty at any time, and the other has MOST at most.
        self._waiting: deque[Waiting] = deque()
        self._held: deque[Held] = deque()
        self._late = round(protocol.timing.answer_deadline * MS)
        self._longest = round(protocol.timing.answer_longest * MS)
        # A device may take longer than we do to give up on a frame (R-truncation-timeout).
        self._truncation_longest = round(protocol.timing.truncation_longest * MS)
        self._steps = Steps(protocol)
        self._state = protocol.power_on
        self._bus = BusState(protocol)
        self._sequence = 0
        self._out_of_step: int | None = None  # when the open frame is given up
        self._lost_at: int | None = None  # when bytes were last known to be missing
        # Since when nothing was read, until the next event: until then nothing falls due.
        self.unread_from: int | None = None
        self._timeout = timeout
        self._in_doubt = False  # whether it is not confirmed that the host's frames begin as taken
        self._host_until = 0  # when the host's last byte came, while that is in doubt
        # Whether nothing falls due in the moment in which a frame or its answer has come.
        self._unhurried = min(timeout, self._longest) > 0

    @property
    def deadline(self) -> int | None:
        """The time (ns) at which `until` is next needed without an event, None if it is not."""
        due = self._due()
        return due[0] if due else None

    def go_on(self, now: int) -> bool:
        """Read again at `now` (ns): for all that is under way no time passed while nothing was.

        What came meanwhile has the time at which it was read, so how long it took is not known.
        Returns whether nothing was read.
        """
        if self.unread_from is None:
            return False
        pause, self.unread_from = now - self.unread_from, None
        start, end = self._framer.span if self._framer.missing else (0, 0)
        self._framer.resume(self._framer.held, start, end + pause)
        later = [replace(w, end=w.end + pause, expires=w.expires + pause) for w in self._waiting]
        self._waiting = deque(later)
        self._held = deque(replace(one, t=one.t + pause) for one in self._held)
        self._replies.delay(pause)
        if self._out_of_step is not None:
            self._out_of_step += pause
        return True

    def until(self, now: int, out: list[Record]) -> None:
        """Append the records that fall due up to `now` (ns), in the order in which they are due."""
        while (due := self._due()) is not None and due[0] <= now:
            due[1](due[0], out)

    def host(self, data: bytes, now: int, out: list[Record]) -> None:
        """Decode host bytes; each frame is handled as if it had arrived by itself."""
        self._out_of_step = None
        if not self._protocol.plain:
            if now - self._host_until >= self._timeout:
                self._in_doubt = False  # no frame can be open
            self._host_until = now
            self._framed(self._framer.feed(data, now), out)
            self._read_replies(out)
            return
        lengths, held, unhurried = self._protocol.lengths, self._held, self._unhurried
        at, size = 0, len(data)
        while at < size:
            missing = self._framer.missing
            end = at + (missing or 1 + lengths[data[at]])
            if missing or end > size:
                self._framed(self._framer.feed(data[at:end], now), out)
            else:
                self._frame("instruction", data[at:end], now, now, now, out)
            if held or not unhurried:
                self.until(now, out)
            at = end

    def device(self, data: bytes, now: int, out: list[Record]) -> None:
        """Decode device bytes; each is handled as if it had arrived by itself."""
        if not self._protocol.plain:
            self._replies.feed(data, now)
            self._read_replies(out)
            return
        waiting, late, state = self._waiting, self._late, self._state
        for byte in data:
            if waiting:
                first = waiting[0]
                judgement, number, latency = first.judgement, first.sequence, now - first.end
                answer = judgement.response
                if byte == answer.code and 0 <= latency <= late:
                    del waiting[0]
                    out.append(
                        DeviceRecord(now, byte, answer, judgement, number, latency, True, state)
                    )
                    continue
            self._answer(byte, now, out)
            self.until(now, out)
            state = self._state

    def line(self, event: Line, out: list[Record]) -> None:
        """Handle a line event; after a loss, framing and pairing start anew."""
        lost = event.event in LOSSES
        if event.event == UNREAD:
            self.unread_from = event.t
        if event.event in ("unplugged", "reconnected"):
            taps: frozenset[Direction] = frozenset({event.tap} if event.tap else SIDES)
            self._away = self._away - taps if lost else self._away | taps
            self._paired = self._both_heard and not self._away
        if lost or event.event == "unplugged":
            self._lost_at, self._out_of_step = event.t, None
            if lost and event.tap != "device":
                for framed in self._framer.drop(event.t):
                    self.garbage(framed, anomalies.LOST, out)
            # It is not known whether what waits is answered; what is held comes before all that
            # follows.
            self._waiting.clear()
            while self._held:
                self._unsolicited(self._held.popleft(), out)
        out.append(LineRecord(event, lost, self._state, anomalies.of_line(event, lost)))

    def garbage(self, framed: Framed, reason: str, out: list[Record]) -> None:
        """Append the record of host bytes that belong to no frame; `reason` says why."""
        _, start, end, known, data = framed
        out.append(HostRecord(start, end, known, "garbage", data, None, None, self._state, reason))

    def finish(self, now: int, out: list[Record]) -> None:
        """End the recording at `now` (ns): cut the open frame short and release held answers."""
        self._framed(self._framer.drop(now, "truncated"), out)
        while self._held:
            self._unsolicited(self._held.popleft(), out)
        self._read_replies(out)
        while self._replies.held:
            self._give_up_reply(now, out)

    def doubt(self, now: int) -> None:
        """Let the frames from `now` (ns) on be uncertain, until they are confirmed.

        A right sync or check confirms them, else an answer that agrees, or silence of the host.
        """
        self._in_doubt, self._host_until = True, now

    @property
    def settled(self) -> bool:
        """Whether all is known that a checkpoint cannot hold.

        That is a part of an answer, garbage, and whether frames begin as taken.
        """
        return not self._in_doubt and not self._replies.held and self._framer.settled

    @property
    def regular(self) -> bool:
        """Whether all frames that wait for an answer are whole ones, given up after the same time.

        Then columns can go on from here, if there is room for more to wait.
        """
        return (
            self._unhurried
            and not self._in_doubt
            and max(len(self._waiting), len(self._held)) < MOST
            and not self._away
            and not any(
                w.judgement.truncated or w.expires != w.end + self._longest for w in self._waiting
            )
        )

    def save(self, **session: Any) -> DecoderState:
        """The state of the decoder, and of the `session` that it belongs to."""
        start, end = self._framer.span if self._framer.missing else (0, 0)
        return DecoderState(
            **session,
            sequence=self._sequence,
            state=self._state,
            frame=self._framer.held,
            frame_start=start,
            frame_end=end,
            waiting=pairing.waiting_frames(self._waiting, numbered=not self._protocol.plain),
            held=tuple((held.t, held.byte) for held in self._held),
            out_of_step=self._out_of_step,
            lost_at=self._lost_at,
            away=tuple(sorted(self._away)),
            by_address=self._bus.saved if self._protocol.layout.part("address") else UNSET,
        )

    def resume(self, state: DecoderState) -> None:
        """Go on from a state that `DecoderState.require_sense` has accepted."""
        self._framer.resume(state.frame, state.frame_start, state.frame_end)
        self._sequence = state.sequence
        self._state = state.state
        self._bus.resume(state.by_address or ())
        self._replies.forget()
        self._waiting = deque(
            Waiting(number, group.end, group.expires, self._steps[frame].judgement)
            for number, group, frame in state.instructions(self._protocol)
        )
        self._held = deque(Held(t, byte) for t, byte in state.held)
        self._out_of_step = state.out_of_step
        self._lost_at = state.lost_at
        self._away = frozenset(state.away)
        self._paired = self._both_heard and not self._away

    @property
    def begun(self) -> list[Chunk]:
        """The host's bytes of a frame that is not complete, as they came."""
        return [Chunk(t, "host", data) for t, data in self._framer.reads]

    def hold(self, chunks: Iterable[Chunk]) -> None:
        """Take the beginnings of a frame and of an answer of any layout, after `resume`."""
        for chunk in chunks:
            if chunk.direction == "host":
                self._framer.feed(chunk.data, chunk.t)
            else:
                self._replies.feed(chunk.data, chunk.t)

    def _due(self) -> tuple[int, _Due] | None:
        """The next due time and its handler; at equal times the end of the frame comes first."""
        if self.unread_from is not None:
            return None
        due: tuple[int, _Due] | None = None
        frame_end = self._framer.deadline
        if frame_end is not None:
            due = frame_end, self._cut_short
        if self._out_of_step is not None and (due is None or self._out_of_step < due[0]):
            due = self._out_of_step, self._give_up_frame
        reply_end = self._replies.deadline
        if reply_end is not None and (due is None or reply_end < due[0]):
            due = reply_end, self._give_up_reply
        if self._held:  # the oldest may be the answer to the open frame
            patience = max(self._held[0].t, frame_end or 0) + self._skew
            if due is None or patience < due[0]:
                due = patience, self._give_up_answer
        waiting = self._waiting
        if waiting and (due is None or waiting[0].expires < due[0]):
            due = waiting[0].expires, self._give_up_waiting
        return due

    def _cut_short(self, now: int, out: list[Record]) -> None:
        self._framed(self._framer.advance(now), out)

    def _give_up_frame(self, now: int, out: list[Record]) -> None:
        """Give up a frame in which the device answered and which the host did not continue.

        The bytes are garbage, because framing was out of step. But if the answer is the one that a
        truncated frame gets, the device's time-out was shorter than ours and the frame is truncated
        (R-truncation-timeout).
        """
        self._out_of_step = None
        held = self._held
        expected = self._steps[self._framer.held].judgement.response.code
        if held and held[0].byte == expected:
            self._framed(self._framer.drop(now, "truncated"), out)
            return
        for framed in self._framer.drop(now):
            self.garbage(framed, anomalies.MID_FRAME, out)
        while held:
            self._unpaired(held.popleft(), anomalies.OUT_OF_STEP, out)

    def _give_up_answer(self, now: int, out: list[Record]) -> None:
        self._unsolicited(self._held.popleft(), out)

    def _give_up_waiting(self, now: int, out: list[Record]) -> None:
        out.append(FaultRecord(anomalies.unanswered(self._waiting.popleft(), now), self._state))

    def _read_replies(self, out: list[Record]) -> None:
        """Read the answers that are whole, and pair them."""
        while self._replies.held:
            if self._paired and not self._waiting:
                return  # the request may be delayed in the other adapter
            heard = self._replies.take(self._waiting, self._late // GIVES_UP)
            if heard is None:
                return
            for _ in range(heard.passed):
                self._give_up_waiting(heard.end, out)
            self._reply(heard, out)

    def _give_up_reply(self, now: int, out: list[Record]) -> None:
        """Take what is held of an answer that is not continued, or that no request waits for."""
        heard = self._replies.take(self._waiting, self._late // GIVES_UP, over=True)
        heard = heard or self._replies.take_rest(alone=not self._both_heard)
        if heard:
            self._reply(heard, out)

    def _reply(self, heard: Heard, out: list[Record]) -> None:
        """Pair an answer of several bytes with the oldest request that waits, if there is one."""
        response = heard.reply.response
        held = Held(heard.start, response.code if response else -1, heard.reply)
        sets = reported(self._protocol, heard.reply)
        if self._paired and self._waiting and not heard.loose:
            waiting = self._waiting.popleft()
            if waiting.sequence == self._sequence - 1:  # else a newer request may have changed it
                self._set(waiting.judgement.address, sets)
            self._pair(held, waiting, out)
        elif heard.loose and heard.reply.reason:
            self._unpaired(held, anomalies.ALONE, out)
        elif self._paired:
            self._unsolicited(held, out)
        else:
            self._set(heard.reply.address, sets)
            self._unpaired(held, anomalies.ALONE, out)

    def _framed(self, frames: Iterable[Framed], out: list[Record]) -> None:
        for framed in frames:
            if framed.kind == "garbage":
                self.garbage(framed, anomalies.NO_FRAME, out)
            else:
                self._frame(framed.kind, framed.data, *framed[1:4], out)

    def _frame(
        self, kind: Kind, data: bytes, start: int, end: int, known: int, out: list[Record]
    ) -> None:
        """Judge a frame that has ended, whole or cut short, and pair it with a held answer."""
        self._out_of_step = None
        step = self._steps[data]
        judgement = step.judgement
        if self._paired and judgement.answer_due and not self._waiting:
            while unasked := self._replies.take_before(end - self._skew):
                self._reply(unasked, out)
        sequence = self._sequence
        self._sequence = sequence + 1
        state = self._set(judgement.address, step.sets)
        note = self._note(kind, judgement) if judgement.framed else ""
        out.append(HostRecord(start, end, known, kind, data, judgement, sequence, state, note))
        if self._paired and judgement.response is not NO_ANSWER:
            expires = end + self._longest
            if judgement.truncated:
                expires += self._truncation_longest
            queue = self._waiting
            if queue and queue[-1].expires > expires:
                expires = queue[-1].expires  # answers come in order: none is given up before
            waiting = Waiting(sequence, end, expires, judgement)
            if self._held:
                self._pair(self._held.popleft(), waiting, out)
                return
            if len(queue) >= MOST:
                early = anomalies.unanswered(queue.popleft(), known, MOST)
                out.append(FaultRecord(early, state))
            queue.append(waiting)

    def _set(self, address: int | None, sets: Assigned) -> State:
        """Predict what these variables are now, of the device at an address; returns its state."""
        if address is None:
            self._state = after(self._state, sets)
        else:
            self._state = self._bus.after(address, sets)
        return self._state

    def _note(self, kind: Kind, judgement: Judgement) -> str:
        """Why a frame is uncertain, in words; "" if it is not."""
        layout, frame = self._protocol.layout, judgement.frame
        known = judgement.instruction is not None or kind != "instruction"
        if not known and frame_size(self._protocol, frame) != len(frame):
            return anomalies.SILENT_END
        if self._in_doubt and (layout.of(judgement.id).check or layout.sync):
            self._in_doubt = judgement.truncated or judgement.outcome in FRAMING_FAULTS
        return anomalies.UNCLEAR if self._in_doubt else ""

    def _answer(self, byte: int, now: int, out: list[Record]) -> None:
        held = Held(now, byte)
        if not self._paired:
            self._unpaired(held, anomalies.ALONE, out)
            return
        if not self._waiting:
            if self._framer.missing and self._out_of_step is None:
                answer = self._protocol.codes.get(byte)
                ok = answer is not None and answer.outcome is Outcome.VALID
                # A device may refuse a faulty header at once and take its data in silence, but
                # none answers a frame that may be valid before its end (R-answer-point).
                whole = self._framer.held + bytes(self._framer.missing)
                by_data = (Outcome.VALID, Outcome.BAD_DATA)
                if ok or self._steps[whole].judgement.outcome in by_data:
                    self._out_of_step = now + QUIET
            if len(self._held) >= MOST:
                self._unsolicited(self._held.popleft(), out)
            self._held.append(held)
            return
        if pairing.passes_over(held, self._waiting, self._late):
            self._give_up_waiting(now, out)
        self._pair(held, self._waiting.popleft(), out)

    def _pair(self, held: Held, waiting: Waiting, out: list[Record]) -> None:
        record = anomalies.answer_record(
            self._protocol, held, self._state, waiting, skew=self._skew
        )
        if record.agrees and waiting.judgement.valid:
            self._in_doubt = False
        out.append(record)

    def _unsolicited(self, held: Held, out: list[Record]) -> None:
        # Before the first instruction it is a banner: R-unsolicited.
        why = anomalies.UNSOLICITED if self._sequence else anomalies.EARLY
        if self._lost_at is not None and held.t - self._lost_at <= self._late:
            why = anomalies.NEAR_LOSS
        self._unpaired(held, why, out)

    def _unpaired(self, held: Held, why: anomalies.Cause, out: list[Record]) -> None:
        out.append(anomalies.answer_record(self._protocol, held, self._state, why=why))


class BusState:
    """The states by address; that of a device which was not addressed is that of OTHERS."""

    def __init__(self, protocol: Protocol) -> None:
        self._part = protocol.layout.part("address")
        self._states: dict[int, State] = {OTHERS: protocol.power_on}

    def after(self, address: int, sets: Assigned) -> State:
        """The state of the addressed device after a frame that sets some variables.

        What is sent to all changes all.
        """
        part = self._part
        if part is not None and address == part.broadcast:
            self._states = {one: after(state, sets) for one, state in self._states.items()}
            return self._states[OTHERS]
        state = self._states.get(address, self._states[OTHERS])
        if part is not None and part.low <= address <= part.high:  # there is no end of others
            state = self._states[address] = after(state, sets)
        return state

    @property
    def saved(self) -> tuple[tuple[int, State], ...]:
        """Each address and its state."""
        return tuple(sorted(self._states.items()))

    def resume(self, states: Iterable[tuple[int, State]]) -> None:
        """Go on from saved states; none is the state of power-on for all."""
        self._states = {OTHERS: self._states[OTHERS], **dict(states)}
