"""Decodes regular traffic into a batch of columns, up to the first event that is not regular.

Regular is what needs no decision: every frame is whole and without a pause that could cut it
short, no bytes are lost, and each answer is to the oldest request that waits, comes before that is
given up, and has no long pause in it. It may come before its request, as two taps stamp it.

Where a header byte tells all of a frame, frames and answers may be wrong; elsewhere they are right,
and no two requests wait between which the host has paused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise, repeat
from operator import attrgetter
from typing import Any, NamedTuple, Self

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.batch import (
    INSTRUCTION,
    Batch,
    DeviceRows,
    HostRows,
    OtherRows,
    Selection,
    StateColumns,
    repeated,
    sliced,
)
from bilprov.analyzer.decode.checkpoint import QUIET, DecoderState, WaitingFrames
from bilprov.analyzer.decode.decoder import TURNS
from bilprov.analyzer.decode.pairing import MOST, Held, Waiting
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord, Record
from bilprov.captures.events import DEVICE, HOST, LINE, Events
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.arrays.layouts import Mask, Places, Requests
from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import (
    Answers,
    answer_tables,
    request_tables,
)
from bilprov.spec.codec import Judgement, Steps
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import GIVES_UP, Reply, read_as, usual_way
from bilprov.spec.state import OTHERS, State

_FEW = 256  # frames that are looked up one by one faster than they are compared


@dataclass(frozen=True, eq=False)
class ColumnBatch(Batch):
    """Regular traffic as arrays: every frame is whole, every answer is to the request in turn.

    `data` are the host's bytes and `heard` the device's. The `requests` are the new frames, which
    came from `start` to `end` (ns); the first has the number `first`. Answer j of `answers`, whose
    first byte came at `t` (ns), is to the frame of row j of `asked`, which has the number
    `sequence` and ended at `asked_end` (ns); `after` counts the new frames before it. `before` is
    the state before the new frames. Before each of the `lines` come `line_after` new frames and
    `line_heard` answers.
    """

    decoding: ColumnDecoder
    data: NDArray[np.uint8]
    heard: NDArray[np.uint8]
    requests: Requests
    first: int
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    asked: Requests
    asked_end: NDArray[np.int64]
    sequence: NDArray[np.int64]
    answers: Answers
    t: NDArray[np.int64]
    after: NDArray[np.int64]
    before: Known
    lines: Sequence[Line]
    line_after: NDArray[np.int64]
    line_heard: NDArray[np.int64]

    def __reduce__(self) -> tuple[Any, ...]:
        kept = [getattr(self, field.name) for field in fields(self)]
        return type(self), tuple(kept)  # without what is worked out from them

    def __len__(self) -> int:
        return len(self.start) + len(self.t) + len(self.lines)

    @cached_property
    def hosts(self) -> HostRows:
        """The host's rows."""
        count, alone, tables = len(self.start), self._alone, self.decoding.requests
        timelines = self._timelines
        return HostRows(
            t=self.start,
            end=self.end,
            known=self.end,
            kind=np.full(count, INSTRUCTION, np.uint8),
            data=self.data,
            offset=self.requests.offset,
            size=self.requests.size,
            verdict=self.requests.verdict,
            sequence=self.first + np.arange(count),
            states=StateColumns(timelines.kind, count, lambda name: timelines[name][1:]),
            samples=alone._host_samples,
            header=tables.keys.take(self.requests.kind),
            due=tables.due(self.data, self.requests),
            uncertain=np.zeros(count, np.bool_),
        )

    @cached_property
    def devices(self) -> DeviceRows:
        """The device's rows."""
        alone, tables, answers = self._alone, self.decoding, self.answers
        verdict, timelines, after = self.asked.verdict, self._timelines, self.after
        right = tables.answers.agree(self.asked, answers)
        fields_at, fields_size = tables.answers.fields(self.asked.kind, answers)
        latency = self.t - self.asked_end
        late = latency > tables.late

        def sort(rows: NDArray[np.int64]) -> NDArray[np.int64]:
            """Rows with the same number have the same kinds of anomalies."""
            wrong: NDArray[np.int64] = 512 * verdict[rows].astype(np.int64) + answers.code[rows]
            return late[rows] * (1 << 18) + wrong

        return DeviceRows(
            t=self.t,
            byte=self._byte(slice(None)),
            sequence=self.sequence,
            header=tables.requests.keys.take(self.asked.kind),
            verdict=verdict,
            latency=latency,
            agrees=right.view(np.int8),
            odd=~right | late | (latency < 0),
            states=StateColumns(timelines.kind, len(after), lambda n: timelines[n].take(after)),
            samples=alone._samples,
            sort=sort,
            data=self.heard,
            offset=answers.offset,
            size=answers.size,
            name=answers.code,
            names=tables.answers.names,
            fields_at=fields_at,
            fields_size=fields_size,
            address=tables.answers.addresses(self.asked.kind, self.heard, answers),
        )

    @cached_property
    def others(self) -> OtherRows:
        """The other rows."""
        after = self.line_after
        states = self._timelines.states.take(after).tolist() if len(after) else []
        return OtherRows(
            [
                LineRecord(line, False, state, anomalies.of_line(line, lost=False))
                for line, state in zip(self.lines, states, strict=True)
            ]
        )

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], ...]:
        """The numbers of the host's, the device's and the other rows among all rows in order."""
        hosts, devices = np.arange(len(self.start)), np.arange(len(self.t))
        before = _up_to(self.after, hosts) + _up_to(self.line_after, hosts)
        return (
            hosts + before,
            devices + self.after + _up_to(self.line_heard, devices),
            np.arange(len(self.lines)) + self.line_after + self.line_heard,
        )

    def _byte(self, rows: slice | NDArray[np.int64]) -> NDArray[np.integer]:
        """The codes of some of the answers."""
        code, tables = self.answers.code[rows], self.decoding
        return code if tables.protocol.plain else tables.answers.bytes.take(code)

    def records(self, chosen: Selection | None = None) -> Sequence[Record]:
        """The rows in order as records; the chosen ones, None for all."""
        hosts, devices, others = (
            np.arange(len(places)) if chosen is None else np.flatnonzero(mask)
            for places, mask in zip(self.places, chosen or self.places, strict=True)
        )
        states = self._timelines.states
        made: list[Record] = [*self._host_records(hosts, states.take(hosts + 1).tolist())]
        made += self._answers(devices, states.take(self.after[devices]).tolist())
        made += [self.others.listed[row] for row in others.tolist()]
        rows = zip(self.places, (hosts, devices, others), strict=True)
        order = np.argsort(np.concatenate([places[some] for places, some in rows]))
        records: list[Record] = np.fromiter(made, object, len(made))[order].tolist()
        return records

    @cached_property
    def _alone(self) -> Self:
        """The batch without its rows, for what they call.

        If they held the batch that holds them, all would stay in memory until the garbage collector
        runs, which it hardly ever does among arrays.
        """
        return copy(self)

    def _host_records(self, rows: NDArray[np.int64], states: list[State]) -> Iterator[HostRecord]:
        """The records of some of the host's rows, in these states."""
        end = objects(self.end[rows])
        judged = self._judgements(rows).tolist()
        return map(
            HostRecord,
            objects(self.start[rows]),
            end,
            end,
            repeat("instruction"),
            map(attrgetter("frame"), judged),
            judged,
            (self.first + rows).tolist(),
            states,
        )

    def _host_samples(self, rows: NDArray[np.int64]) -> list[HostRecord]:
        return [*self._host_records(rows, [self.before.state] * len(rows))]

    def _samples(self, rows: NDArray[np.int64]) -> list[DeviceRecord]:
        return self._answers(rows, [self.before.state] * len(rows))

    def _answers(self, rows: NDArray[np.int64], states: list[State]) -> list[DeviceRecord]:
        """The records of some of the device's rows, in these states."""
        tables, t, end = self.decoding, self.t[rows], self.asked_end[rows]
        asked, answers = self.asked.rows(rows), self.answers.rows(rows)
        odd = ~tables.answers.agree(asked, answers) | (t - end > tables.late) | (t < end)
        # The judgements of the frames that they answer.
        new = self.sequence[rows] - self.first
        carried = int(np.searchsorted(new, 0))
        before = self._judged(asked.rows(slice(carried)))
        judged = [*before.tolist(), *self._judgements(new[carried:]).tolist()]
        made = list(
            map(
                DeviceRecord,
                objects(t),
                self._byte(rows).tolist(),
                map(tables.answers.responses.__getitem__, answers.code.tolist()),
                judged,
                self.sequence[rows].tolist(),
                objects(t - end),
                repeat(True),
                states,
                repeat(()),
                repeat(None) if tables.protocol.plain else self._replies(rows, judged),
            )
        )
        for at in np.flatnonzero(odd).tolist():
            one = made[at]
            assert one.answered is not None
            assert one.instruction is not None
            waiting = Waiting(one.instruction, int(end[at]), int(end[at]), one.answered)
            held = Held(one.t, one.byte, one.reply)
            made[at] = anomalies.answer_record(
                tables.protocol, held, one.state, waiting, skew=tables.skew
            )
        return made

    def _replies(self, rows: NDArray[np.int64], judged: Sequence[Judgement]) -> Iterator[Reply]:
        """The answers of several bytes to these frames."""
        protocol = self.decoding.protocol
        frames = sliced(self.heard, self.answers.offset[rows], self.answers.end[rows])
        for frame, asked in zip(frames, judged, strict=True):
            yield read_as(protocol, usual_way(protocol, asked.instruction), frame, asked)

    def _judgements(self, rows: NDArray[np.int64]) -> NDArray[np.object_]:
        """The judgements of some of the new frames."""
        if 2 * len(rows) < len(self.start):
            return self._judged(self.requests.rows(rows))
        return self._all_judged.take(rows)

    @cached_property
    def _all_judged(self) -> NDArray[np.object_]:  # which the records of both sides have
        return self._judged(self.requests)

    def _judged(self, requests: Requests) -> NDArray[np.object_]:
        """The judgements of some frames; where frames are equal, one of them is looked up."""
        one, place = self._distinct(requests)
        frames = sliced(self.data, requests.offset[one], requests.end[one])
        steps = self.decoding.steps
        return np.fromiter((steps[frame].judgement for frame in frames), object, len(one))[place]

    def _distinct(self, requests: Requests) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """A row of each frame that differs from the others, and which of these each row equals.

        Frames of 8 bytes and more count as different, and so do a few.
        """
        rows = np.arange(len(requests.size))
        if len(rows) < _FEW:
            return rows, rows
        eight = self.data.take(requests.offset[:, None] + np.arange(8), mode="clip").view("<u8")
        bits = np.minimum(8 * requests.size, 64).astype(np.uint64)
        low = eight[:, 0] & ((np.uint64(1) << bits) - np.uint64(1))
        key = np.where(requests.size < 8, low, rows.astype(np.uint64)) | bits << np.uint64(56)
        _, one, place = np.unique(key, return_index=True, return_inverse=True)
        return one, place

    @cached_property
    def _timelines(self) -> StateColumns:
        """The variables before the new frames and after each."""
        tables, known = self.decoding.requests.states, (self.data, self.requests, self.before)
        count = len(self.start) + 1
        return StateColumns(type(self.before.state), count, lambda n: tables.column(n, *known))


def _up_to(values: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many of the values are at most the number of each row."""
    return np.bincount(values, minlength=len(rows))[: len(rows)].cumsum()


def objects(values: NDArray[np.int64]) -> list[int]:
    """Numbers as a list, in which neighbours that are equal are one object."""
    changed = np.ones(len(values), np.bool_)
    changed[1:] = values[1:] != values[:-1]
    listed: list[int] = repeated(values[changed].tolist(), changed).tolist()
    return listed


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
        self.protocol = protocol
        self.requests = request_tables(protocol)
        self.answers = answer_tables(protocol)
        self.steps = Steps(protocol)
        self.skew = skew
        self.late = round(protocol.timing.answer_deadline * MS)
        self._paired = paired
        self._timeout = timeout
        # How long an answer without its request, or one that is not complete, is held at least.
        self._held = min(skew, QUIET) if protocol.plain else max(timeout, skew)
        self._longest = round(protocol.timing.answer_longest * MS)
        self._plain = protocol.plain

    def carry(self, state: DecoderState, begun: Sequence[Chunk]) -> Carry | None:
        """The state of a session that is regular (`Session.regular`) as a Carry; None if it is not.

        `begun` are the host's bytes of the frame that is not complete, as they came.
        """
        if state.out_of_step is not None or (begun and begun[0].t != state.frame_start):
            return None  # the open frame ends early; its end was put off while nothing was read
        asked = list(state.instructions(self.protocol))
        waiting = b"".join(frame for *_, frame in asked)
        host = _reads_before([(state.time, waiting), *((one.t, one.data) for one in begun)])
        found = self.requests.cut(host.data[: len(waiting)], 0)
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
        answers = carry.device.chunks("device") if self._plain else ()
        held = tuple((chunk.t, byte) for chunk in answers for byte in chunk.data)
        return replace(carry.rest, waiting=tuple(self._waiting(carry)), held=held)

    def _waiting(self, carry: Carry) -> Iterator[WaitingFrames]:
        """Yield the requests that wait: neighbours with equal times together."""
        offset, upto = carry.waiting.offset, carry.waiting.end
        apart = np.diff(carry.end) != 0
        if not self._plain:
            apart |= np.diff(carry.sequence) != 1  # those between are not answered
        some = len(offset) > 0
        first, last = np.append(some, apart).nonzero()[0], np.append(apart, some).nonzero()[0]
        numbers = repeat(None) if self._plain else carry.sequence[first].tolist()
        frames = sliced(carry.host.data, offset[first], upto[last])
        for end, frame, number in zip(carry.end[first].tolist(), frames, numbers, strict=False):
            yield WaitingFrames(end, end + self._longest, frame, number)

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
            due.append(max(int(carry.device.t[0]), open_until) + self.skew)
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
        found = self.requests.cut(host.data, before.begun, host.upto)
        requests = found.whole
        if not found.regular:
            cut = min(cut, host.event_of(found.end))
        ends = requests.end
        start, last_read = host.t.take(host.of(requests.offset)), host.of(ends - 1)
        end, come = host.t.take(last_read), host.event.take(last_read)
        rows: slice | Mask = slice(0)
        if self._paired:
            due = self.requests.due(host.data, requests)
            rows = slice(None) if due is None or due.all() else due
        sequence = np.arange(rest.sequence, rest.sequence + len(end))[rows]
        asked, asked_end, asked_come = requests.rows(rows), end[rows], come[rows]
        if len(before.end):
            asked = before.waiting.and_then(asked)
            asked_end = np.append(before.end, asked_end)
            asked_come = np.append(np.full(len(before.end), -1), asked_come)
            sequence = np.append(before.sequence, sequence)

        # Answers: answer j is to request j of those.
        given = self.answers.cut(host.data, asked, device.data, device.upto)
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
                # A byte that came before its request may be given up.
                first = np.append(device.t, 0).take(np.searchsorted(device.upto, heard, "right"))
                given_up = early[:-1] & (t - first[:-1] >= self._held)
                given_up |= told.bytes[1:] - heard[1:] > MOST
                falls_due |= given_up if self._held else given_up | early[1:]
                # An answer within an open frame may end that: see `Decoder`.
                within = early & (said.bytes > taken)
                within &= device.newest(len(events)) > host.newest(len(events))
            # A late answer that is wrong may be to the next request: see `passes_over`.
            late = np.flatnonzero(answer_t - asked_end[pairs] > self.late)
            wrong = late[~self.answers.agree(asked.rows(late), answers.rows(late))]
            if len(wrong):
                cut = min(cut, device.event_of(int(wrong[0])))
            after = np.repeat(frames.take(1 + device.event), many)
            after = np.maximum(after, sequence[pairs] + (1 - rest.sequence))
        else:
            before_it = np.flatnonzero(whole < asked_come[pairs])
            ended = device.t.take(device.of(answers.end[before_it] - 1))
            unasked = before_it[ended < asked_end[before_it] - self.skew]
            if len(unasked):  # no answers to these requests: see `Decoder`
                cut = min(cut, int(asked_come[unasked[0]]))
            falls_due |= _paused(told, heard, t, self._held)
            paused = np.diff(asked_end, prepend=asked_end[:1]) >= self.late // GIVES_UP
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
        known, protocol = Known(rest.state, None), self.protocol
        if protocol.layout.part("address") and self.requests.states.has_effects:
            known = Known(rest.state, {OTHERS: protocol.power_on, **dict(rest.by_address or ())})
        line_event = line_event[line_event < cut]
        batch = ColumnBatch(
            decoding=self,
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
        if self.requests.states.has_effects:
            known = self.requests.states.last(host.data, new, known)
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
