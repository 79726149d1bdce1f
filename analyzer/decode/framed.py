"""Decodes regular traffic of frames of any layout into columns; else as `regular` does.

Regular is what needs no decision: every frame is whole, valid and without a pause that could cut it
short, no bytes are lost, and each answer is the usual one to the oldest request that waits, comes
before that is given up, and has no long pause in it. No two requests wait between which the host
has paused. An answer may come before its request, as two taps stamp it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.decode.bus_state import BusState
from bilprov.analyzer.decode.checkpoint import DecoderState, WaitingFrames
from bilprov.analyzer.decode.decoder import TURNS
from bilprov.analyzer.decode.framed_batch import FramedBatch, FramedDecoding
from bilprov.analyzer.decode.pairing import MOST
from bilprov.captures.events import DEVICE, HOST, LINE, Events
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.arrays.answers import AnswerTables
from bilprov.spec.arrays.requests import Requests, request_tables
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import GIVES_UP
from bilprov.spec.state import State, after
from bilprov.spec.steps import Steps


class Reads(NamedTuple):
    """Bytes of one side, and the reads in which they came.

    `t` (ns) is when each read came, `upto` counts the bytes up to its end, and `event` is its place
    among the events, -1 for those of batches before.
    """

    data: NDArray[np.uint8]
    t: NDArray[np.int64]
    upto: NDArray[np.int64]
    event: NDArray[np.int64]

    def of(self, byte: NDArray[np.int64]) -> NDArray[np.int64]:
        """The read of each of these bytes, which increase."""
        if len(byte) and len(byte) <= len(self.upto):  # mostly, each is in a read of its own
            first = int(np.searchsorted(self.upto, byte[0], "right"))
            read = np.arange(first, first + len(byte))
            if read[-1] < len(self.upto):
                begin = np.append(0, self.upto).take(read)
                if ((begin <= byte) & (byte < self.upto.take(read))).all():
                    return read
        return np.searchsorted(self.upto, byte, "right")

    def event_of(self, byte: int) -> int:
        """The event of a byte, 0 for one of batches before."""
        return max(0, int(self.event[np.searchsorted(self.upto, byte, "right")]))

    def and_then(self, events: Events, t: NDArray[np.int64], side: int) -> Reads:
        """These and those of a side among the events, which came at `t` (ns)."""
        of_it = events.side == side
        event = np.flatnonzero(of_it & (events.size > 0))
        data = events.data[np.repeat(of_it, events.size)]
        upto = len(self.data) + np.cumsum(events.size[event])
        return Reads(
            np.concatenate([self.data, data]),
            np.concatenate([self.t, t[event]]),
            np.concatenate([self.upto, upto]),
            np.concatenate([self.event, event]),
        )

    def rest(self, low: int, events: int) -> Reads:
        """What the reads of the first `events` events have from byte `low` on."""
        count = int(np.searchsorted(self.event, events))
        high = int(self.upto[count - 1]) if count else 0
        kept = slice(int(np.searchsorted(self.upto[:count], low, "right")), count)
        upto = self.upto[kept] - low
        return Reads(self.data[low:high], self.t[kept], upto, np.full(len(upto), -1))

    def chunks(self, direction: str, low: int = 0) -> Iterator[Chunk]:
        """The bytes from `low` on as the chunks in which they came."""
        bounds = np.maximum(np.append(0, self.upto), low).tolist()
        for t, (begin, end) in zip(self.t.tolist(), pairwise(bounds), strict=True):
            if begin < end:
                yield Chunk(t, direction, self.data[begin:end].tobytes())  # type: ignore[arg-type]


NOTHING_READ = Reads(np.zeros(0, np.uint8), *(np.zeros(0, np.int64) for _ in range(3)))


class FramedCarry(NamedTuple):
    """What one batch leaves to the next.

    `host` has the requests that wait for an answer, `waiting`, and from byte `begun` on the frame
    that is not complete. `end` (ns) and `sequence` are those of the waiting ones. `device` is what
    came of answers that are not complete. `rest` is the session's state without all of these.
    """

    host: Reads
    begun: int
    waiting: Requests
    end: NDArray[np.int64]
    sequence: NDArray[np.int64]
    device: Reads
    rest: DecoderState


class FramedDecoder:
    """Decodes events into a FramedBatch, as far as they are regular; the settings are a Session's.

    Raises OverflowError for a protocol that does not fit into columns.
    """

    def __init__(self, protocol: Protocol, *, timeout: int, skew: int, paired: bool) -> None:
        requests = request_tables(protocol)
        self._answers = AnswerTables(protocol, requests)
        self._requests = requests
        self._paired = paired
        self._timeout = timeout
        self._reply_timeout = max(timeout, skew)
        self._longest = round(protocol.timing.answer_longest * MS)
        late = round(protocol.timing.answer_deadline * MS)
        self._decoding = FramedDecoding(
            protocol, requests, self._answers, Steps(protocol), skew, late
        )

    def carry(self, state: DecoderState, begun: Sequence[Chunk]) -> FramedCarry | None:
        """The state of a session that is regular (`Session.regular`) as a FramedCarry.

        `begun` are the host's bytes of the frame that is not complete, as they came.
        """
        waiting = b"".join(group.frames for group in state.waiting)
        data = np.frombuffer(waiting + b"".join(one.data for one in begun), np.uint8)
        found = self._requests.cut(data[: len(waiting)], 0)
        if found.end < len(waiting):
            return None  # a faulty request waits, too
        upto = np.cumsum([len(group.frames) for group in state.waiting], dtype=np.int64)
        count = np.diff(np.searchsorted(found.requests.end, upto, "right"), prepend=0)
        sequence = [
            (group.first or 0) + place
            for group, amount in zip(state.waiting, count.tolist(), strict=True)
            for place in range(amount)
        ]
        reads = np.cumsum([len(waiting), *(len(one.data) for one in begun)], dtype=np.int64)
        times = np.array([state.time, *(one.t for one in begun)], np.int64)
        return FramedCarry(
            Reads(data, times, reads, np.full(len(reads), -1)),
            len(waiting),
            found.requests,
            np.repeat(np.array([group.end for group in state.waiting], np.int64), count),
            np.array(sequence, np.int64),
            NOTHING_READ,
            replace(state, waiting=(), frame=b"", frame_start=0, frame_end=0),
        )

    def state(self, carry: FramedCarry) -> DecoderState:
        """A FramedCarry as the state of a session, without what is `begun`."""
        return replace(carry.rest, waiting=tuple(self._groups(carry)))

    def begun(self, carry: FramedCarry) -> list[Chunk]:
        """The bytes of the frame and of the answer that are not complete, as they came."""
        return [*carry.host.chunks("host", carry.begun), *carry.device.chunks("device")]

    def saved(self, carry: FramedCarry) -> DecoderState | None:
        """All that is needed to go on from here; None while an answer is not complete."""
        if len(carry.device.data):
            return None
        state, held = self.state(carry), self.begun(carry)
        if not held:
            return state
        frame = b"".join(one.data for one in held)
        return replace(state, frame=frame, frame_start=held[0].t, frame_end=held[-1].t)

    def _groups(self, carry: FramedCarry) -> Iterator[WaitingFrames]:
        """Yield the waiting frames, neighbours with equal times together."""
        if not len(carry.end):
            return
        changed = (np.diff(carry.end) != 0) | (np.diff(carry.sequence) != 1)
        first = np.append(0, 1 + np.flatnonzero(changed))
        data, waiting = carry.host.data, carry.waiting
        for low, high in pairwise([*first.tolist(), len(carry.end)]):
            end = int(carry.end[low])
            frames = data[int(waiting.offset[low]) : int(waiting.end[high - 1])].tobytes()
            yield WaitingFrames(end, end + self._longest, frames, int(carry.sequence[low]))

    def deadline(self, carry: FramedCarry) -> int | None:
        """When (ns) something falls due without an event, None if nothing does."""
        due = [int(end) + self._longest for end in carry.end[:1]]
        if carry.begun < len(carry.host.data):
            due.append(int(carry.host.t[-1]) + self._timeout)
        if len(carry.device.data):
            due.append(int(carry.device.t[-1]) + self._reply_timeout)
        return min(due, default=None)

    def decode(self, before: FramedCarry, events: Events) -> tuple[FramedBatch, int, FramedCarry]:
        """Decode the events, of which there must be some, as far as they are regular.

        Returns the batch, the number of events that it covers (it may be 0), and what it leaves to
        the next.
        """
        rest = before.rest
        t = np.maximum(np.maximum.accumulate(events.t), rest.time)
        host = before.host.and_then(events, t, HOST)
        device = before.device.and_then(events, t, DEVICE)
        cut = len(events)
        line_event = np.flatnonzero(events.side == LINE)
        turns = [line.event in TURNS for line in events.lines]
        if True in turns:
            cut = int(line_event[turns.index(True)])

        # Requests, and those of them that wait for an answer.
        found = self._requests.cut(host.data, before.begun, host.upto)
        requests = found.requests
        if not found.regular:
            cut = min(cut, host.event_of(found.end))
        start = host.t[host.of(requests.offset)]
        last_read = host.of(requests.end - 1)
        end, come = host.t[last_read], host.event[last_read]
        due = requests.due if self._paired else np.zeros(len(come), np.bool_)
        asked = before.waiting.and_then(requests.rows(due))
        asked_end = np.concatenate([before.end, end[due]])
        asked_come = np.concatenate([np.full(len(before.end), -1), come[due]])
        sequence = np.concatenate([before.sequence, rest.sequence + np.flatnonzero(due)])

        # Answers: answer j is to request j of those.
        given = self._answers.cut(host.data, asked, device.data, device.upto)
        answers = given.answers
        if not given.regular:
            cut = min(cut, device.event_of(given.end))
        if not self._paired and len(device.data):
            cut = min(cut, device.event_of(0))
        answer_t = device.t[device.of(answers.offset)]
        whole = device.event[device.of(answers.end - 1)]
        paired = np.maximum.accumulate(np.maximum(whole, asked_come[: len(whole)]))

        # What there is after 0, 1, 2 ... events; what falls due before the next event ends it.
        frames, asked_by, answered = (
            _counted(each, len(events)) for each in (come, asked_come, paired)
        )
        falls_due = _paused(host, np.append(before.begun, requests.end)[frames], t, self._timeout)
        heard = np.append(0, answers.end)[answered]
        falls_due |= _paused(device, heard, t, self._reply_timeout)
        expires = np.append(asked_end, 0)[answered[:-1]] + self._longest
        falls_due |= (asked_by[:-1] > answered[:-1]) & (t >= expires)
        paused = np.diff(asked_end, prepend=asked_end[:1]) >= self._decoding.late // GIVES_UP
        pauses = np.append(0, np.cumsum(paused))
        falls_due |= pauses[asked_by[:-1]] > pauses[np.minimum(answered + 1, asked_by)[:-1]]
        falls_due |= asked_by[1:] - answered[:-1] > MOST
        if falls_due.any():
            cut = min(cut, int(np.argmax(falls_due)))

        # What comes in the first `cut` events.
        rows, replies, waiting = int(frames[cut]), int(answered[cut]), int(asked_by[cut])
        begun = int(requests.end[rows - 1]) if rows else before.begun
        new = requests.rows(slice(rows))
        states, then = self._follow(rest, host.data, new)
        line_event = line_event[line_event < cut]
        batch = FramedBatch(
            decoding=self._decoding,
            data=host.data[:begun],
            heard=device.data[: int(heard[cut])],
            requests=new,
            first=rest.sequence,
            start=start[:rows],
            end=end[:rows],
            asked=asked.rows(slice(replies)),
            asked_end=asked_end[:replies],
            sequence=sequence[:replies],
            answers=answers.rows(slice(replies)),
            t=answer_t[:replies],
            device_after=frames[1 + paired[:replies]],
            before=rest.state,
            new_states=states,
            lines=[
                replace(line, t=int(t[at]))
                for line, at in zip(events.lines, line_event.tolist(), strict=False)
            ],
            line_after=frames[1 + line_event],
            line_heard=answered[1 + line_event],
        )
        if not cut:
            return batch, 0, before

        # What is left.
        low = int(asked.offset[replies]) if replies < waiting else begun
        left = asked.rows(slice(replies, waiting))
        return (
            batch,
            cut,
            FramedCarry(
                host=host.rest(low, cut),
                begun=begun - low,
                waiting=left._replace(offset=left.offset - low),
                end=asked_end[replies:waiting],
                sequence=sequence[replies:waiting],
                device=device.rest(int(heard[cut]), cut),
                rest=replace(then, time=int(t[cut - 1]), sequence=rest.sequence + rows),
            ),
        )

    def _follow(
        self, rest: DecoderState, data: NDArray[np.uint8], new: Requests
    ) -> tuple[list[State] | None, DecoderState]:
        """The states after some requests (None: nothing changes), and what is known after them."""
        if not self._requests.has_effects or not len(new.kind):
            return None, rest
        sets = self._requests.sets(data, new)
        addresses = self._requests.addresses(data, new)
        states: list[State] = []
        if addresses is None:
            state = rest.state
            for one in sets:
                state = after(state, one)
                states.append(state)
            return states, replace(rest, state=state)
        bus = BusState(self._decoding.protocol)
        bus.resume(rest.by_address or ())
        states = [bus.after(*one) for one in zip(addresses, sets, strict=True)]
        return states, replace(rest, state=states[-1], by_address=bus.saved)


def _counted(event: NDArray[np.int64], events: int) -> NDArray[np.int64]:
    """How many there are after 0, 1, 2 ... events, of what comes with these events (or before)."""
    return np.cumsum(np.bincount(event + 1, minlength=events + 1))


def _paused(
    reads: Reads, taken: NDArray[np.int64], t: NDArray[np.int64], timeout: int
) -> NDArray[np.bool_]:
    """Before which events something is under way on one side for too long (`timeout`, ns).

    `taken` counts the bytes that are in whole frames after 0, 1, 2 ... events.
    """
    count = _counted(reads.event, len(t))[:-1]
    come = np.append(0, reads.upto)[count]
    last = np.append(0, reads.t)[count]
    paused: NDArray[np.bool_] = (come > taken[:-1]) & (t - last >= timeout)
    return paused
