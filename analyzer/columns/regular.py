"""Decodes regular traffic into a Stretch, up to the first event that is not regular.

Regular is what needs no decision: every frame is whole and without a pause that could cut it
short, no bytes are lost, and each answer comes before its instruction is given up, or so little
before its instruction (as two taps stamp it) that it is not given up itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.analyzer.columns.stretch import Decoding, Span, Stretch, values_of, written
from bilprov.analyzer.decode.checkpoint import GROUP, QUIET, DecoderState, WaitingFrames
from bilprov.analyzer.decode.decoder import TURNS
from bilprov.analyzer.decode.pairing import MOST
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.steps import Steps, data_decide, short_frames
from bilprov.spec.tables import FrameColumns, frame_tables

LATEST = 1 << 62
"""The latest time (ns) in columns: some time later still fits into 64 bits. It is 146 years."""


def prepare(protocol: Protocol) -> None:
    """Make the tables of a protocol, which are kept; none where its state fits into no column."""
    short_frames(protocol)
    with suppress(OverflowError):
        frame_tables(protocol)


class Carry(NamedTuple):
    """What one stretch leaves to the next: the frames that wait for an answer, and the open frame.

    `data` are the bytes of both, the open frame's from byte `begun` on. `end` are the times (ns) of
    the waiting frames' last bytes. `rest` is the session's state without these frames.
    """

    data: NDArray[np.uint8]
    frames: FrameColumns
    end: NDArray[np.int64]
    begun: int
    rest: DecoderState


class _Side:
    """The chunks of one side: their places among the events, and their bytes.

    `bytes` counts the bytes up to the end of each chunk, `t` (ns) is when each came.
    """

    def __init__(self, event: list[int], chunks: list[bytes], t: NDArray[np.int64]) -> None:
        self.event = np.array(event, np.int64)
        self.bytes = np.cumsum([len(chunk) for chunk in chunks], dtype=np.int64)
        self.data = np.frombuffer(b"".join(chunks), np.uint8)
        self.t = t[self.event]

    def event_of(self, byte: int) -> int:
        """The place of the event with this byte."""
        return int(self.event[np.searchsorted(self.bytes, byte, "right")])


class RegularDecoder:
    """Decodes events into a Stretch, as far as they are regular; the settings are a Session's.

    Raises OverflowError for a protocol whose state does not fit into columns.
    """

    def __init__(self, protocol: Protocol, *, timeout: int, skew: int, paired: bool) -> None:
        self._tables = frame_tables(protocol)
        self._longest = round(protocol.timing.answer_longest * MS)
        self._timeout = timeout
        late = round(protocol.timing.answer_deadline * MS)
        self._decoding = Decoding(protocol, self._tables, Steps(protocol), paired, skew, late)

    def carry(self, state: DecoderState) -> Carry:
        """The state of a session that is regular (`Session.regular`) as a Carry."""
        waiting = b"".join(group.frames for group in state.waiting)
        data = np.frombuffer(waiting + state.frame, np.uint8)
        offset, begun = self._tables.offsets(data[: len(waiting)])
        upto = np.cumsum([len(group.frames) for group in state.waiting], dtype=np.int64)
        count = np.diff(np.searchsorted(offset, upto), prepend=0)
        end = np.repeat(np.array([group.end for group in state.waiting], np.int64), count)
        frames = self._tables.frames(data, offset)
        return Carry(data, frames, end, begun, replace(state, waiting=(), frame=b""))

    def state(self, carry: Carry) -> DecoderState:
        """A Carry as the state of a session."""
        frame = carry.data[carry.begun :].tobytes()
        return replace(carry.rest, waiting=tuple(self._groups(carry)), frame=frame)

    def _groups(self, carry: Carry) -> Iterator[WaitingFrames]:
        """Yield the waiting frames, those with equal times together."""
        number = carry.rest.sequence - len(carry.end) + np.arange(len(carry.end))
        first = np.flatnonzero((np.diff(carry.end, prepend=-1) != 0) | (number % GROUP == 0))
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

    def decode(self, before: Carry, events: Sequence[Chunk | Line]) -> tuple[Stretch, int, Carry]:
        """Decode the events, of which there must be some, as far as they are regular.

        Returns the stretch, the number of events that it covers (it may be 0), and what it leaves
        to the next. Raises OverflowError if one of them is later than `LATEST`.
        """
        rest, tables = before.rest, self._tables
        t = np.maximum.accumulate(np.array([event.t for event in events], np.int64))
        np.maximum(t, rest.time, out=t)
        if t[-1] > LATEST:
            raise OverflowError("an event is too late for columns")
        host, device, lines, cut = _sorted(events, t)

        # Frames; `come` counts the host rows that are complete by the end of each host chunk.
        data = np.concatenate([before.data, host.data])
        bounds = len(before.data) + host.bytes
        offset, begun = tables.offsets(data, before.begun)
        until = np.append(offset[1:], begun)[: len(offset)]
        carried, new = len(before.end), np.searchsorted(until, bounds, "right")
        come = carried + new
        frames = tables.frames(data, offset)
        if carried:
            frames = before.frames.and_then(frames)
        end = np.concatenate([before.end, np.repeat(host.t, np.diff(new, prepend=0))])
        ends = np.append(before.begun, until)[new]
        cut = min(cut, self._first_pause(before, t, host, bounds, ends))

        # Answers; row j of the device answers row j of the host. The first rows are held already.
        held = np.array(rest.held, np.int64).reshape(-1, 2)
        byte = np.concatenate([held[:, 1].astype(np.uint8), device.data])
        answer_t = np.concatenate(
            [held[:, 0], np.repeat(device.t, np.diff(device.bytes, prepend=0))]
        )
        if self._decoding.paired:
            early = _early(host, device, np.append(carried, come), len(held))
            cut = min(cut, self._first_unsolicited(t, end, answer_t, early))
            cut = min(cut, self._first_overdue(t, end, answer_t))
            cut = min(cut, _first_crowded(host, device, np.append(carried, come), len(held)))
            wrong = self._first_shifted(frames, end, byte, answer_t)
            if wrong is not None:
                cut = min(cut, device.event_of(wrong - len(held)))

        # What comes in the first `cut` events.
        chunks, answers = np.searchsorted(host.event, cut), np.searchsorted(device.event, cut)
        rows = int(come[chunks - 1]) if chunks else carried
        heard = len(held) + (int(device.bytes[answers - 1]) if answers else 0)
        given = min(heard, rows) if self._decoding.paired else heard
        kept_frames = frames.rows(slice(rows))
        last = rest.state
        if rows > carried:
            new_frames = kept_frames.rows(slice(carried, None))
            last = written(*tables.last_state(data, new_frames, values_of(rest.state)))
        stretch = Stretch(
            decoding=self._decoding,
            data=data,
            frames=kept_frames,
            carried=carried,
            sequence=rest.sequence - carried,
            start=_starts(before, host, offset, bounds)[: rows - carried],
            end=end[:rows],
            byte=byte[:given],
            t=answer_t[:given],
            before=rest.state,
            last=last,
            lines=tuple(replace(line, t=int(t[at])) for at, line in lines if at < cut),
            spans=tuple(
                self._spans(cut, host, device, lines, [carried, *come.tolist()], len(held))
            ),
        )
        if not cut:
            return stretch, 0, before

        # What is left: the frames without an answer, and the open frame.
        said = int(bounds[chunks - 1]) if chunks else len(before.data)
        begun = int(until[rows - carried - 1]) if rows > carried else before.begun
        begun_in = int(np.searchsorted(bounds, begun, "right"))
        kept = given if self._decoding.paired else rows
        out_of_step = rest.out_of_step
        since = len(held)  # the device row from which on the host has said no more
        if chunks:
            out_of_step = None
            before_it = np.searchsorted(device.event, host.event[chunks - 1])
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
        return stretch, cut, carry

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

    def _spans(
        self,
        cut: int,
        host: _Side,
        device: _Side,
        lines: list[tuple[int, Line]],
        come: list[int],
        held: int,
    ) -> Iterator[Span]:
        """Yield the rows of each of the first `cut` events, in the order of their records.

        `come` are the host rows that are complete after 0, 1, 2 ... of the host's chunks. An answer
        that is held follows its instruction at once.
        """
        side = dict.fromkeys(host.event.tolist(), 0)
        side |= dict.fromkeys(device.event.tolist(), 1)
        side |= dict.fromkeys((place for place, _ in lines), 2)
        paired, upto = self._decoding.paired, device.bytes.tolist()
        chunks = answered = line = given = 0
        heard = held
        for place in range(cut):
            kind = side.get(place)
            if kind == 0:
                row, stop = come[chunks], come[chunks + 1]
                chunks += 1
                while paired and row < stop and row < heard:
                    yield Span("host", row, row + 1, row + 1)
                    yield Span("device", row, row + 1, row + 1)
                    row = given = row + 1
                if row < stop:
                    yield Span("host", row, stop, stop)
            elif kind == 1:
                heard = held + upto[answered]
                answered += 1
                stop = min(heard, come[chunks]) if paired else heard
                if given < stop:
                    yield Span("device", given, stop, come[chunks])
                    given = stop
            elif kind == 2:
                yield Span("line", line, line + 1, come[chunks])
                line += 1


def _sorted(
    events: Sequence[Chunk | Line], t: NDArray[np.int64]
) -> tuple[_Side, _Side, list[tuple[int, Line]], int]:
    """The host's and the device's chunks, the line events, and the place of the first loss."""
    places: dict[str, list[int]] = {"host": [], "device": []}
    chunks: dict[str, list[bytes]] = {"host": [], "device": []}
    lines: list[tuple[int, Line]] = []
    loss = len(events)
    for place, event in enumerate(events):
        if isinstance(event, Chunk):
            if event.data:
                places[event.direction].append(place)
                chunks[event.direction].append(event.data)
        else:
            lines.append((place, event))
            if event.event in TURNS:
                loss = min(loss, place)
    host, device = (_Side(places[side], chunks[side], t) for side in ("host", "device"))
    return host, device, lines, loss


def _first_crowded(host: _Side, device: _Side, come: NDArray[np.int64], held: int) -> int:
    """The first event after which more than MOST instructions wait, or answers are held.

    `come` are the host rows that are complete after 0, 1, 2 ... of the host's chunks. A number
    above that of every event where there is none.
    """
    heard = held + np.append(0, device.bytes)
    waiting = come[1:] - heard[np.searchsorted(device.event, host.event)]
    early = heard[1:] - come[np.searchsorted(host.event, device.event)]
    crowded = *host.event[waiting > MOST][:1], *device.event[early > MOST][:1]
    return int(min(crowded, default=1 << 62))


def _early(host: _Side, device: _Side, come: NDArray[np.int64], held: int) -> NDArray[np.bool_]:
    """Whether each device row, the first of which were held, came before its instruction.

    `come` are the host rows that are complete after 0, 1, 2 ... of the host's chunks.
    """
    there = come[np.searchsorted(host.event, device.event)]
    rows = np.arange(held, held + len(device.data))
    later = rows >= np.repeat(there, np.diff(device.bytes, prepend=0))
    return np.concatenate([np.ones(held, np.bool_), later])


def _starts(
    before: Carry, host: _Side, offset: NDArray[np.int64], bounds: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The time (ns) of the first byte of each new host row."""
    begun_before = int(before.begun < len(before.data) and len(offset) > 0)
    begun = np.searchsorted(offset, bounds)
    first = np.full(begun_before, before.rest.frame_start, np.int64)
    return np.concatenate([first, np.repeat(host.t, np.diff(begun, prepend=begun_before))])
