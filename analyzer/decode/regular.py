"""Decodes regular traffic into a batch of columns, up to the first event that is not regular.

Regular is what needs no decision: every frame is whole and without a pause that could cut it
short, no bytes are lost, and each answer comes before its instruction is given up, or so little
before its instruction (as two taps stamp it) that it is not given up itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, repeat
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.batch import (
    INSTRUCTION,
    NO_VERDICT,
    DeviceRows,
    HostRows,
    StateColumns,
    sliced,
)
from bilprov.analyzer.decode.checkpoint import QUIET, DecoderState, WaitingFrames
from bilprov.analyzer.decode.column_batch import ColumnBatch, objects
from bilprov.analyzer.decode.decoder import TURNS, paired_record, unpaired_record
from bilprov.analyzer.decode.pairing import MOST, Held, Waiting
from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.captures.events import DEVICE, HOST, LINE, Events
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from bilprov.spec.steps import Steps, data_decide
from bilprov.spec.tables import FrameColumns, FrameTables, frame_tables


def prepare(protocol: Protocol) -> None:
    """Make the tables of a protocol, which are kept; none where its state fits into no column."""
    with suppress(OverflowError):
        frame_tables(protocol)


@dataclass(frozen=True)
class Decoding:
    """What decoding into columns rests on: the protocol, its tables, and the session's settings.

    `paired` is true if both directions are heard; `skew` and `late` (the answer's deadline) are in
    ns.
    """

    protocol: Protocol
    tables: FrameTables
    steps: Steps
    paired: bool
    skew: int
    late: int


class _Checked(NamedTuple):
    """Of answers: the latency (ns), whether they are as expected, late, or have an anomaly."""

    latency: NDArray[np.int64]
    agrees: NDArray[np.bool_]
    late: NDArray[np.bool_]
    odd: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RegularBatch(ColumnBatch):
    """Regular traffic: every frame is whole, and every answer came while it was waited for.

    `data` are the host's bytes. Of the `frames` the first `carried` came in batches before and only
    wait for an answer; the first of all has the number `first`. `frame_end` (ns, of the last byte)
    has all of them, `start` (ns, of the first byte) the new ones. Byte j of the device (`byte`, `t`
    in ns) answers frame j, or none if nothing is paired; `device_after` new frames come before it.
    `before` is the state before the new frames. Before each of the `lines` come `line_after` new
    frames and `line_heard` bytes of the device.
    """

    decoding: Decoding
    data: NDArray[np.uint8]
    frames: FrameColumns
    carried: int
    first: int
    frame_end: NDArray[np.int64]
    byte: NDArray[np.uint8]

    @cached_property
    def hosts(self) -> HostRows:
        """The host's rows."""
        alone = self._alone
        new = self.frames.rows(slice(self.carried, None))
        end = self.frame_end[self.carried :]
        return HostRows(
            t=self.start,
            end=end,
            known=end,
            kind=np.broadcast_to(np.uint8(INSTRUCTION), len(end)),
            data=self.data,
            offset=new.offset,
            size=self.decoding.tables.sizes.take(new.key >> 8),
            verdict=new.verdict,
            sequence=self.first + np.arange(self.carried, len(self.frame_end)),
            states=StateColumns(type(self.before), len(end), alone._host_states),
            reasons=lambda rows: [one.reason for one in alone._judgements(alone.carried + rows)],
        )

    @cached_property
    def devices(self) -> DeviceRows:
        """The device's rows."""
        count, alone = len(self.byte), self._alone
        if self.decoding.paired:
            verdict = self.frames.verdict[:count]
            header = (self.frames.key[:count] >> 8).astype(np.uint8)
            sequence = np.arange(self.first, self.first + count)
            latency, right, late, odd = self._checked(slice(count))
            agrees = right.view(np.int8)
        else:
            verdict = np.broadcast_to(np.uint8(NO_VERDICT), count)
            header = np.broadcast_to(np.uint8(0), count)
            sequence = np.broadcast_to(np.int64(-1), count)
            latency, late = np.broadcast_to(np.int64(0), count), np.broadcast_to(False, count)
            odd = ~self.decoding.tables.used.take(self.byte)
            agrees = odd.astype(np.int8) - np.int8(1)

        def sort(rows: NDArray[np.int64]) -> NDArray[np.int64]:
            """Rows with the same number have the same kinds of anomalies."""
            kinds = alone.byte[rows].astype(np.int64) | verdict[rows].astype(np.int64) << 8
            return kinds | late[rows].astype(np.int64) << 16

        made = partial(alone._device_states, self.hosts.states)
        return DeviceRows(
            t=self.t,
            byte=self.byte,
            sequence=sequence,
            header=header,
            verdict=verdict,
            latency=latency,
            agrees=agrees,
            odd=odd,
            states=StateColumns(type(self.before), count, made),
            samples=alone._samples,
            sort=sort,
        )

    def _host_judgements(self, rows: NDArray[np.int64]) -> Sequence[Judgement]:
        return self._judgements(self.carried + rows)

    def _answers(self, rows: NDArray[np.int64], states: list[State]) -> list[DeviceRecord]:
        """The records of some of the device's rows, in these states."""
        byte, t, protocol = self.byte[rows].tolist(), objects(self.t[rows]), self.decoding.protocol
        if not self.decoding.paired:
            return [
                unpaired_record(protocol, Held(at, value), anomalies.ALONE, state)
                for at, value, state in zip(t, byte, states, strict=True)
            ]
        checked = self._checked(rows)
        made = list(
            map(
                DeviceRecord,
                t,
                byte,
                map(protocol.codes.get, byte),
                self._judgements(rows),
                (self.first + rows).tolist(),
                objects(checked.latency),
                repeat(True),
                states,
            )
        )
        for at in np.flatnonzero(checked.odd).tolist():
            made[at] = self._odd_answer(made[at], int(self.frame_end[rows[at]]))
        return made

    def _odd_answer(self, record: DeviceRecord, end: int) -> DeviceRecord:
        """The record with its anomalies, of an answer to an instruction that ended at `end`."""
        assert record.answered is not None
        assert record.instruction is not None
        waiting = Waiting(record.instruction, end, end, record.answered)
        held = Held(record.t, record.byte)
        protocol, skew = self.decoding.protocol, self.decoding.skew
        return paired_record(protocol, held, waiting, skew, record.state)

    def _checked(self, rows: slice | NDArray[np.int64]) -> _Checked:
        """How some of the device's rows answer the frames of the same places."""
        latency = self.t[rows] - self.frame_end[rows]
        agrees = self.byte[rows] == self.decoding.tables.codes.take(self.frames.verdict[rows])
        late = latency > self.decoding.late
        return _Checked(latency, agrees, late, ~agrees | late | (latency < 0))

    def _judgements(self, rows: NDArray[np.int64]) -> Sequence[Judgement]:
        """The judgements of some of the frames."""
        if 2 * len(rows) < len(self.frame_end):
            return self._judged(rows)
        judged: list[Judgement] = self._all_judged.take(rows).tolist()
        return judged

    @cached_property
    def _all_judged(self) -> NDArray[np.object_]:
        """The judgements of all frames, which the records of both sides have."""
        judged = self._judged(slice(None))
        return np.fromiter(judged, object, len(judged))

    def _judged(self, rows: slice | NDArray[np.int64]) -> list[Judgement]:
        start, steps = self.frames.offset[rows], self.decoding.steps
        size = self.decoding.tables.sizes.take(self.frames.key[rows] >> 8)
        return [steps[frame].judgement for frame in sliced(self.data, start, start + size)]

    def _host_states(self, variable: str) -> NDArray[Any]:
        new = self.frames.rows(slice(self.carried, None))
        return self.decoding.tables.state(variable, self.data, new, self.before.codes)

    def _device_states(self, hosts: StateColumns, variable: str) -> NDArray[Any]:
        column = hosts[variable]
        first = self.before.code(variable, getattr(self.before, variable))
        return np.append(np.array([first], column.dtype), column).take(self.after)

    @cached_property
    def _states(self) -> NDArray[np.object_]:
        """The state before the new frames, and after each of them."""
        states = [self.before, *self.hosts.states.states()]
        return np.fromiter(states, object, len(states))


class Carry(NamedTuple):
    """What one batch leaves to the next: the frames that wait for an answer, and the open frame.

    `data` are the bytes of both, the open frame's from byte `begun` on. `end` are the times (ns) of
    the waiting frames' last bytes. `rest` is the session's state without these frames.
    """

    data: NDArray[np.uint8]
    frames: FrameColumns
    end: NDArray[np.int64]
    begun: int
    rest: DecoderState


class _Side:
    """The reads of one side: their places among the events, and their bytes.

    `bytes` counts the bytes up to the end of each read, `t` (ns) is when each came, and `before`
    counts the reads before each event.
    """

    def __init__(self, events: Events, t: NDArray[np.int64], side: int) -> None:
        of_it = events.side == side
        read = of_it & (events.size > 0)
        self.event = np.flatnonzero(read)
        self.before = np.append(0, np.cumsum(read))
        self.bytes = np.cumsum(events.size[self.event])
        self.data = events.data[np.repeat(of_it, events.size)]
        self.t = t[self.event]

    def event_of(self, byte: int) -> int:
        """The place of the event with this byte."""
        return int(self.event[np.searchsorted(self.bytes, byte, "right")])


class RegularDecoder:
    """Decodes events into a RegularBatch, as far as they are regular; the settings are a Session's.

    Raises OverflowError for a protocol whose state does not fit into columns.
    """

    def __init__(self, protocol: Protocol, *, timeout: int, skew: int, paired: bool) -> None:
        self._tables = frame_tables(protocol)
        self._longest = round(protocol.timing.answer_longest * MS)
        self._timeout = timeout
        late = round(protocol.timing.answer_deadline * MS)
        self._decoding = Decoding(protocol, self._tables, Steps(protocol), paired, skew, late)

    def carry(self, state: DecoderState, begun: Sequence[Chunk] = ()) -> Carry:
        """The state of a session that is regular (`Session.regular`) as a Carry.

        It has all that a session has `begun`.
        """
        waiting = b"".join(group.frames for group in state.waiting)
        data = np.frombuffer(waiting + state.frame, np.uint8)
        offset, after = self._tables.offsets(data[: len(waiting)])
        upto = np.cumsum([len(group.frames) for group in state.waiting], dtype=np.int64)
        count = np.diff(np.searchsorted(offset, upto), prepend=0)
        end = np.repeat(np.array([group.end for group in state.waiting], np.int64), count)
        frames = self._tables.frames(data, offset)
        return Carry(data, frames, end, after, replace(state, waiting=(), frame=b""))

    def state(self, carry: Carry) -> DecoderState:
        """A Carry as the state of a session."""
        frame = carry.data[carry.begun :].tobytes()
        return replace(carry.rest, waiting=tuple(self._groups(carry)), frame=frame)

    def saved(self, carry: Carry) -> DecoderState:
        """All that is needed to go on from here."""
        return self.state(carry)

    def begun(self, carry: Carry) -> list[Chunk]:
        """What the state does not have: nothing."""
        return []

    def _groups(self, carry: Carry) -> Iterator[WaitingFrames]:
        """Yield the waiting frames, those with equal times together."""
        first = np.flatnonzero(np.diff(carry.end, prepend=-1))
        bounds = [*carry.frames.offset[first].tolist(), carry.begun]
        for end, (low, high) in zip(carry.end[first].tolist(), pairwise(bounds), strict=True):
            yield WaitingFrames(end, end + self._longest, carry.data[low:high].tobytes())

    def deadline(self, carry: Carry) -> int | None:
        """When (ns) something falls due without an event, None if nothing does."""
        rest, skew = carry.rest, self._decoding.skew
        due = [int(end) + self._longest for end in carry.end[:1]]
        patience = [t + skew for t, _ in rest.held[:1]]
        if carry.begun < len(carry.data):
            cut_short = rest.frame_end + self._timeout
            due.append(cut_short)
            patience = [max(end, cut_short + skew) for end in patience]
        if rest.out_of_step is not None:
            due.append(rest.out_of_step)
        return min(due + patience, default=None)

    def decode(self, before: Carry, events: Events) -> tuple[RegularBatch, int, Carry]:
        """Decode the events, of which there must be some, as far as they are regular.

        Returns the batch, the number of events that it covers (it may be 0), and what it leaves to
        the next.
        """
        rest, tables, paired = before.rest, self._tables, self._decoding.paired
        t = np.maximum.accumulate(events.t)
        np.maximum(t, rest.time, out=t)
        host, device = _Side(events, t, HOST), _Side(events, t, DEVICE)
        line_event = np.flatnonzero(events.side == LINE)
        turns = [line.event in TURNS for line in events.lines]
        cut = int(line_event[turns.index(True)]) if True in turns else len(events)

        # Frames; `come` counts those that are complete after 0, 1, 2 ... of the host's reads.
        data = np.concatenate([before.data, host.data])
        bounds = len(before.data) + host.bytes
        offset, begun = tables.offsets(data, before.begun)
        until = np.append(offset[1:], begun)[: len(offset)]
        carried, new = len(before.end), np.searchsorted(until, bounds, "right")
        come = np.append(carried, carried + new)
        frames = tables.frames(data, offset)
        if carried:
            frames = before.frames.and_then(frames)
        end = np.concatenate([before.end, np.repeat(host.t, np.diff(new, prepend=0))])
        ends = np.append(before.begun, until)[new]
        cut = min(cut, self._first_pause(before, t, host, bounds, ends))

        # Answers; byte j of the device answers frame j. The first ones are held already.
        held = np.array(rest.held, np.int64).reshape(-1, 2)
        byte = np.concatenate([held[:, 1].astype(np.uint8), device.data])
        in_read = np.diff(device.bytes, prepend=0)
        answer_t = np.concatenate([held[:, 0], np.repeat(device.t, in_read)])
        there = np.repeat(come[host.before[device.event]], in_read)
        there = np.concatenate([np.zeros(len(held), np.int64), there])  # frames before each answer
        if paired:
            early = np.arange(len(byte)) >= there
            cut = min(cut, self._first_unsolicited(t, end, answer_t, early))
            cut = min(cut, self._first_overdue(t, end, answer_t))
            cut = min(cut, _first_crowded(host, device, come, len(held)))
            wrong = self._first_shifted(frames, end, byte, answer_t)
            if wrong is not None:
                cut = min(cut, device.event_of(wrong - len(held)))

        # What comes in the first `cut` events.
        chunks, answers = int(host.before[cut]), int(device.before[cut])
        rows = int(come[chunks])
        begun = int(until[rows - carried - 1]) if rows > carried else before.begun
        heard = len(held) + (int(device.bytes[answers - 1]) if answers else 0)
        given = min(heard, rows) if paired else heard
        new_frames = frames.rows(slice(carried, rows))
        last = rest.state.of_codes(tables.last_state(data, new_frames, rest.state.codes))
        if paired:  # an answer that is held follows its instruction at once
            there = np.maximum(there, np.arange(1, len(there) + 1))
        line_event = line_event[line_event < cut]
        line_after = come[host.before[line_event]]
        upto = np.append(0, device.bytes)[device.before[line_event]] + len(held)
        batch = RegularBatch(
            decoding=self._decoding,
            data=data[:begun],
            frames=frames.rows(slice(rows)),
            carried=carried,
            first=rest.sequence - carried,
            start=_starts(before, host, offset, bounds)[: rows - carried],
            frame_end=end[:rows],
            byte=byte[:given],
            t=answer_t[:given],
            device_after=there[:given] - carried,
            before=rest.state,
            lines=[
                replace(line, t=int(t[at]))
                for line, at in zip(events.lines, line_event.tolist(), strict=False)
            ],
            line_after=line_after - carried,
            line_heard=np.minimum(upto, line_after) if paired else upto,
        )
        if not cut:
            return batch, 0, before

        # What is left: the frames without an answer, and the open frame.
        said = int(bounds[chunks - 1]) if chunks else len(before.data)
        begun_in = int(np.searchsorted(bounds, begun, "right"))
        kept = given if paired else rows
        out_of_step = rest.out_of_step
        since = len(held)  # the device row from which on the host has said no more
        if chunks:
            out_of_step = None
            before_it = int(device.before[host.event[chunks - 1]])
            since += int(device.bytes[before_it - 1]) if before_it else 0
        if out_of_step is None and given < heard and begun < said:
            since = max(since, given)
            out_of_step = self._out_of_step(
                int(data[begun]), byte[since:heard], answer_t[since:heard]
            )
        low = int(frames.offset[kept]) if kept < rows else begun
        left = frames.rows(slice(kept, rows))
        carry = Carry(
            data=data[low:said],
            frames=left._replace(offset=left.offset - low),
            end=end[kept:rows],
            begun=begun - low,
            rest=replace(
                rest,
                time=int(t[cut - 1]),
                sequence=rest.sequence + rows - carried,
                state=last,
                frame_start=rest.frame_start
                if begun < len(before.data)
                else int(host.t[begun_in])
                if begun < said
                else 0,
                frame_end=(int(host.t[chunks - 1]) if chunks else rest.frame_end)
                if begun < said
                else 0,
                held=tuple(
                    zip(answer_t[given:heard].tolist(), byte[given:heard].tolist(), strict=True)
                ),
                out_of_step=out_of_step,
            ),
        )
        return batch, cut, carry

    def _first_pause(
        self,
        before: Carry,
        t: NDArray[np.int64],
        host: _Side,
        bounds: NDArray[np.int64],
        ends: NDArray[np.int64],
    ) -> int:
        """The first event after too long a pause in a frame; the number of events if none is.

        `bounds` are the ends of the host's chunks and `ends` those of the last whole frames in
        them, both in bytes of the stretch.
        """
        is_open = np.append(before.begun, ends) < np.append(len(before.data), bounds)
        last = np.append(before.rest.frame_end, host.t)
        pauses = np.flatnonzero(is_open & (np.append(host.t, t[-1]) - last >= self._timeout))
        if not len(pauses):
            return len(t)
        return int(np.searchsorted(t, last[pauses[0]] + self._timeout))

    def _first_unsolicited(
        self,
        t: NDArray[np.int64],
        end: NDArray[np.int64],
        answer_t: NDArray[np.int64],
        early: NDArray[np.bool_],
    ) -> int:
        """The first event after an answer may have been given up for which no instruction came.

        The number of events if there is none. Answers that came before their instructions are
        `early`.
        """
        hold = min(self._decoding.skew, QUIET)
        pairs = min(len(end), len(answer_t))
        given_up = np.flatnonzero(early[:pairs] & (end[:pairs] - answer_t[:pairs] >= hold))
        row = int(given_up[0]) if len(given_up) else pairs
        return int(np.searchsorted(t, answer_t[row] + hold)) if row < len(answer_t) else len(t)

    def _out_of_step(
        self, header: int, byte: NDArray[np.uint8], t: NDArray[np.int64]
    ) -> int | None:
        """When (ns) an open frame is given up, in which these answers came to no instruction.

        See `Decoder`; None if they do not show that it is out of step.
        """
        protocol = self._decoding.protocol
        if not data_decide(protocol, bytes([header]) + bytes(protocol.lengths[header])):
            ok = protocol.answers[Outcome.VALID].code
            t = t[byte == ok]
        return int(t[0]) + QUIET if len(t) else None

    def _first_overdue(
        self, t: NDArray[np.int64], end: NDArray[np.int64], answer_t: NDArray[np.int64]
    ) -> int:
        """The first event after an instruction was given up; the number of events if none is."""
        pairs = min(len(end), len(answer_t))
        given_up = np.flatnonzero(answer_t[:pairs] - end[:pairs] >= self._longest)
        row = int(given_up[0]) if len(given_up) else pairs
        return int(np.searchsorted(t, end[row] + self._longest)) if row < len(end) else len(t)

    def _first_shifted(
        self,
        frames: FrameColumns,
        end: NDArray[np.int64],
        byte: NDArray[np.uint8],
        answer_t: NDArray[np.int64],
    ) -> int | None:
        """The first device row that is late and may belong to the next instruction, if any.

        See `Pairing.passes_over`.
        """
        pairs = min(len(end), len(answer_t))
        late = np.flatnonzero(answer_t[:pairs] - end[:pairs] > self._decoding.late)
        wrong = late[byte[late] != self._tables.codes[frames.verdict[late]]]
        return int(wrong[0]) if len(wrong) else None


def _first_crowded(host: _Side, device: _Side, come: NDArray[np.int64], held: int) -> int:
    """The first event after which more than MOST instructions wait, or answers are held.

    `come` are the frames that are complete after 0, 1, 2 ... of the host's reads. A number above
    that of every event where there is none.
    """
    heard = held + np.append(0, device.bytes)
    waiting = come[1:] - heard[device.before[host.event]]
    early = heard[1:] - come[host.before[device.event]]
    crowded = *host.event[waiting > MOST][:1], *device.event[early > MOST][:1]
    return int(min(crowded, default=1 << 62))


def _starts(
    before: Carry, host: _Side, offset: NDArray[np.int64], bounds: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The time (ns) of the first byte of each new host row."""
    begun_before = int(before.begun < len(before.data) and len(offset) > 0)
    begun = np.searchsorted(offset, bounds)
    first = np.full(begun_before, before.rest.frame_start, np.int64)
    return np.concatenate([first, np.repeat(host.t, np.diff(begun, prepend=begun_before))])
