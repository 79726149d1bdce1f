"""Decodes regular traffic into a batch of columns, up to the first event that is not regular.

Regular is what needs no decision: every frame is whole and without a pause that could cut it
short, no bytes are lost, and each answer is to the oldest request that waits, comes before that is
given up, and has no long pause in it. It may come before its request, as two taps stamp it.

Where a header byte tells all of a frame, frames and answers may be wrong; elsewhere they are right,
and no two requests wait between which the host has paused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, repeat
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.decode.batch import sliced
from bilprov.analyzer.decode.checkpoint import QUIET, DecoderState
from bilprov.analyzer.decode.column_batch import ColumnBatch, Decoding
from bilprov.analyzer.decode.decoder import TURNS
from bilprov.analyzer.decode.pairing import MOST, waiting_frames
from bilprov.captures.events import DEVICE, HOST, LINE, Events
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.arrays.layouts import Mask, Places, Requests
from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import answer_tables, request_tables
from bilprov.spec.codec import Steps
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import GIVES_UP
from bilprov.spec.state import OTHERS


class Heard(NamedTuple):
    """How many bytes of one side there are at some times, and when (ns) the newest read came."""

    bytes: Places
    t: Places


class Reads(NamedTuple):
    """Bytes of one side, and the reads in which they came.

    `t` (ns) is when each read came, `upto` counts the bytes up to its end, and `event` is its place
    among the events, -1 for those of batches before.
    """

    data: NDArray[np.uint8]
    t: Places
    upto: Places
    event: Places

    def of(self, byte: Places) -> Places:
        """The read of each of these bytes, which increase."""
        if len(byte) > len(self.upto):
            many = np.diff(np.searchsorted(byte, self.upto), prepend=0)
            return np.repeat(np.arange(len(many)), many)
        if len(byte):  # mostly, each is in a read of its own
            first = int(np.searchsorted(self.upto, byte[0], "right"))
            read = np.arange(first, first + len(byte))
            if read[-1] < len(self.upto):
                begin = np.append(0, self.upto).take(read)
                if ((begin <= byte) & (byte < self.upto.take(read))).all():
                    return read
        return np.searchsorted(self.upto, byte, "right")

    def after(self, events: int) -> Heard:
        """What there is after 0, 1, 2 ... of the events."""
        count = _counted(self.event, events)
        return Heard(np.append(0, self.upto).take(count), np.append(0, self.t).take(count))

    def newest(self, events: int) -> Places:
        """The event of the newest read after 0, 1, 2 ... of the events, -1 if it is before them."""
        return np.append(-1, self.event).take(_counted(self.event, events))

    def event_of(self, byte: int) -> int:
        """The event of a byte, 0 for one of batches before."""
        return max(0, int(self.event[np.searchsorted(self.upto, byte, "right")]))

    def and_then(self, events: Events, t: Places, side: int) -> Reads:
        """These and those of a side among the events, which came at `t` (ns)."""
        event = np.flatnonzero((events.side == side) & (events.size > 0))
        of_it = events.side_of_byte == side
        # Of short reads an index takes five times as long, of long ones a quarter of the time.
        short = len(of_it) < _SHORT * len(events)
        data = events.data.compress(of_it) if short else events.data[of_it]
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


def _reads_before(pieces: Sequence[tuple[int, bytes]]) -> Reads:
    """Reads of batches before: when (ns) each came, and its bytes."""
    data = np.frombuffer(b"".join(piece for _, piece in pieces), np.uint8)
    upto = np.cumsum([len(piece) for _, piece in pieces], dtype=np.int64)
    return Reads(data, np.array([t for t, _ in pieces], np.int64), upto, np.full(len(upto), -1))


class Carry(NamedTuple):
    """What one batch leaves to the next.

    `host` has the requests that wait for an answer, `waiting`, and from byte `begun` on the frame
    that is not complete. `end` (ns) and `sequence` are those of the waiting ones. `device` is what
    came of answers that are not complete, or whose request is not. `rest` is the session's state
    without all of these.
    """

    host: Reads
    begun: int
    waiting: Requests
    end: Places
    sequence: Places
    device: Reads
    rest: DecoderState


class ColumnDecoder:
    """Decodes events into a ColumnBatch, as far as they are regular; the settings are a Session's.

    Raises OverflowError for a protocol that does not fit into columns.
    """

    def __init__(self, protocol: Protocol, *, timeout: int, skew: int, paired: bool) -> None:
        requests = self._requests = request_tables(protocol)
        answers = self._answers = answer_tables(protocol)
        self._paired = paired
        self._timeout = timeout
        # How long an answer without its request, or one that is not complete, is held at least.
        self._held = min(skew, QUIET) if protocol.plain else max(timeout, skew)
        self._longest = round(protocol.timing.answer_longest * MS)
        late = round(protocol.timing.answer_deadline * MS)
        self._decoding = Decoding(protocol, requests, answers, Steps(protocol), skew, late)
        self._plain = protocol.plain

    def carry(self, state: DecoderState, begun: Sequence[Chunk]) -> Carry | None:
        """The state of a session that is regular (`Session.regular`) as a Carry; None if it is not.

        `begun` are the host's bytes of the frame that is not complete, as they came.
        """
        if state.out_of_step is not None or (begun and begun[0].t != state.frame_start):
            return None  # the open frame ends early; its end was put off while nothing was read
        asked = list(state.instructions(self._decoding.protocol))
        waiting = b"".join(frame for *_, frame in asked)
        host = _reads_before([(state.time, waiting), *((one.t, one.data) for one in begun)])
        found = self._requests.cut(host.data[: len(waiting)], 0)
        if found.end < len(waiting):
            return None  # a faulty request waits, too
        return Carry(
            host,
            len(waiting),
            found.whole,
            np.array([group.end for _, group, _ in asked], np.int64),
            np.array([number for number, *_ in asked], np.int64),
            _reads_before([(t, bytes([byte])) for t, byte in state.held]),
            replace(state, waiting=(), held=(), frame=b"", frame_start=0, frame_end=0),
        )

    def state(self, carry: Carry) -> DecoderState:
        """A Carry as the state of a session, without what is `begun`."""
        frames = sliced(carry.host.data, carry.waiting.offset, carry.waiting.end)
        times = zip(carry.end.tolist(), (carry.end + self._longest).tolist(), strict=True)
        rows = zip(carry.sequence.tolist(), times, frames, repeat(False), strict=False)
        waiting = waiting_frames(rows, numbered=not self._plain)
        answers = carry.device.chunks("device") if self._plain else ()
        held = tuple((chunk.t, byte) for chunk in answers for byte in chunk.data)
        return replace(carry.rest, waiting=waiting, held=held)

    def begun(self, carry: Carry) -> list[Chunk]:
        """The bytes of the frame and of the answer that are not complete, as they came."""
        answer = [] if self._plain else carry.device.chunks("device")
        return [*carry.host.chunks("host", carry.begun), *answer]

    def saved(self, carry: Carry) -> DecoderState | None:
        """All that is needed to go on from here; None while an answer is not complete.

        A Session gives the same, but to hand over to one and back takes as long as a batch.
        """
        if len(carry.device.data) and not self._plain:
            return None
        state, held = self.state(carry), self.begun(carry)
        if not held:
            return state
        frame = b"".join(one.data for one in held)
        return replace(state, frame=frame, frame_start=held[0].t, frame_end=held[-1].t)

    def deadline(self, carry: Carry) -> int | None:
        """When (ns) something falls due without an event, None if nothing does."""
        due = [int(end) + self._longest for end in carry.end[:1]]
        open_until = 0
        if carry.begun < len(carry.host.data):
            open_until = int(carry.host.t[-1]) + self._timeout
            due.append(open_until)
        if len(carry.device.data) and self._plain:
            due.append(max(int(carry.device.t[0]), open_until) + self._decoding.skew)
        elif len(carry.device.data):
            due.append(int(carry.device.t[-1]) + self._held)
        return min(due, default=None)

    def decode(self, before: Carry, events: Events) -> tuple[ColumnBatch, int, Carry]:
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
        requests = found.whole
        if not found.regular:
            cut = min(cut, host.event_of(found.end))
        ends = requests.end
        start, last_read = host.t.take(host.of(requests.offset)), host.of(ends - 1)
        end, come = host.t.take(last_read), host.event.take(last_read)
        rows = self._due(host.data, requests)
        sequence = np.arange(rest.sequence, rest.sequence + len(end))[rows]
        asked, asked_end, asked_come = requests.rows(rows), end[rows], come[rows]
        if len(before.end):
            asked = before.waiting.and_then(asked)
            asked_end = np.append(before.end, asked_end)
            asked_come = np.append(np.full(len(before.end), -1), asked_come)
            sequence = np.append(before.sequence, sequence)

        # Answers: answer j is to request j of those.
        given = self._answers.cut(host.data, asked, device.data, device.upto)
        answers, pairs = given.whole, slice(len(given.whole.code))
        if not given.regular:
            cut = min(cut, device.event_of(given.end))
        if not self._paired and len(device.data):
            cut = min(cut, device.event_of(0))

        # What there is after 0, 1, 2 ... events; what falls due before the next event ends it.
        frames = _counted(come, len(events))
        every = self._paired and len(asked_come) == len(before.end) + len(come)
        asked_by = frames + len(before.end) if every else _counted(asked_come, len(events))
        said, told = host.after(len(events)), device.after(len(events))
        taken = np.append(before.begun, ends).take(frames)
        if self._plain:  # each byte is an answer
            many = np.diff(np.minimum(device.upto, len(answers.code)), prepend=0)
            answer_t = np.repeat(device.t, many)
            answered = heard = np.minimum(told.bytes, asked_by)
        else:
            answer_t = device.t.take(device.of(answers.offset))
            whole = device.event.take(device.of(answers.end - 1))
            paired = np.maximum(whole, asked_come[pairs])
            answered = _counted(paired, len(events))
            heard = np.append(0, answers.end).take(answered)
        falls_due = _paused(said, taken, t, self._timeout)
        if len(asked_end):
            expires = asked_end.take(answered[:-1], mode="clip") + self._longest
            falls_due |= (asked_by[:-1] > answered[:-1]) & (t >= expires)
        falls_due |= asked_by[1:] - answered[:-1] > MOST
        if self._plain:
            early = told.bytes > heard
            if early.any():
                falls_due |= self._given_up(device, told, heard, t)
                # An answer within an open frame may end that: see `Decoder`.
                within = early & (said.bytes > taken)
                within &= device.newest(len(events)) > host.newest(len(events))
            # A late answer that is wrong may be to the next request: see `passes_over`.
            late = np.flatnonzero(answer_t - asked_end[pairs] > self._decoding.late)
            wrong = late[~self._answers.agree(asked.rows(late), answers.rows(late))]
            if len(wrong):
                cut = min(cut, device.event_of(int(wrong[0])))
            after = np.repeat(frames.take(1 + device.event), many)
            after = np.maximum(after, sequence[pairs] + (1 - rest.sequence))
        else:
            before_it = np.flatnonzero(whole < asked_come[pairs])
            ended = device.t.take(device.of(answers.end[before_it] - 1))
            unasked = before_it[ended < asked_end[before_it] - self._decoding.skew]
            if len(unasked):  # no answers to these requests: see `Decoder`
                cut = min(cut, int(asked_come[unasked[0]]))
            falls_due |= _paused(told, heard, t, self._held)
            paused = np.diff(asked_end, prepend=asked_end[:1]) >= self._decoding.late // GIVES_UP
            pauses = np.append(0, np.cumsum(paused))
            falls_due |= pauses[asked_by[:-1]] > pauses[np.minimum(answered + 1, asked_by)[:-1]]
            after = frames.take(1 + paired)
        if falls_due.any():
            cut = min(cut, int(np.argmax(falls_due)))
        if self._plain and early.any():
            cut = int(np.flatnonzero(~within[: cut + 1])[-1])

        # What comes in the first `cut` events.
        count, replies, waiting = int(frames[cut]), int(answered[cut]), int(asked_by[cut])
        begun, low = int(taken[cut]), int(heard[cut])
        new = requests.rows(slice(count))
        # The states from which decoding goes on.
        known, protocol = Known(rest.state, None), self._decoding.protocol
        if protocol.layout.part("address") and self._requests.states.has_effects:
            known = Known(rest.state, {OTHERS: protocol.power_on, **dict(rest.by_address or ())})
        line_event = line_event[line_event < cut]
        batch = ColumnBatch(
            decoding=self._decoding,
            data=host.data[:begun],
            heard=device.data[:low],
            requests=new,
            first=rest.sequence,
            start=start[:count],
            end=end[:count],
            asked=asked.rows(slice(replies)),
            asked_end=asked_end[:replies],
            sequence=sequence[:replies],
            answers=answers.rows(slice(replies)),
            t=answer_t[:replies],
            after=after[:replies],
            before=known,
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
        if self._requests.states.has_effects:
            known = self._requests.states.last(host.data, new, known)
            rest = replace(rest, state=known.state)
            if known.by_address is not None:
                rest = replace(rest, by_address=tuple(sorted(known.by_address.items())))
        kept = int(asked.offset[replies]) if replies < waiting else begun
        left = asked.rows(slice(replies, waiting))
        return (
            batch,
            cut,
            Carry(
                host=host.rest(kept, cut),
                begun=begun - kept,
                waiting=left._replace(offset=left.offset - kept),
                end=asked_end[replies:waiting],
                sequence=sequence[replies:waiting],
                device=device.rest(low, cut),
                rest=replace(rest, time=int(t[cut - 1]), sequence=rest.sequence + count),
            ),
        )

    def _due(self, data: NDArray[np.uint8], requests: Requests) -> slice | Mask:
        """The requests that wait for an answer."""
        if not self._paired:
            return slice(0)
        due = self._requests.due(data, requests)
        return slice(None) if due is None or due.all() else due

    def _given_up(self, device: Reads, told: Heard, heard: Places, t: Places) -> Mask:
        """At which events a byte may be given up that came before its request.

        `told` is what came from the device, and `heard` counts the bytes that are answers, after
        0, 1, 2 ... events.
        """
        early = told.bytes > heard
        first = np.append(device.t, 0).take(np.searchsorted(device.upto, heard, "right"))
        given_up: Mask = early[:-1] & (t - first[:-1] >= self._held)
        given_up |= told.bytes[1:] - heard[1:] > MOST
        return given_up if self._held else given_up | early[1:]


_SHORT = 4  # bytes of a read
_MANY = 8  # as many together are found faster by looking for them than by counting all


def _counted(event: Places, events: int) -> Places:
    """How many there are after 0, 1, 2 ... events, of what comes with these events (or before).

    The events increase.
    """
    if len(event) > _MANY * events:
        return np.searchsorted(event, np.arange(events + 1))
    return np.cumsum(np.bincount(event + 1, minlength=events + 1))


def _paused(told: Heard, taken: Places, t: Places, timeout: int) -> Mask:
    """Before which events something is under way on one side for too long (`timeout`, ns).

    `told` is what there is, and `taken` counts the bytes that are in whole frames, after 0, 1, 2
    ... events.
    """
    paused: Mask = (told.bytes > taken)[:-1] & (t - told.t[:-1] >= timeout)
    return paused
