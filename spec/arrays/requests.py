"""Cuts and judges the requests in a buffer in arrays, as far as they are whole and valid.

Those with one header byte may be faulty, too: their headers tell where they end.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise

import numpy as np

from bilprov.spec.arrays.layouts import (
    BAD_DATA,
    OUTCOMES,
    WIDEST,
    Bytes,
    Cut,
    Mask,
    Places,
    Requests,
    checks_hold,
    constants_hold,
    data_sizes,
    fixed_size,
    frame_sizes,
    in_range,
    leading,
    number_values,
    part_values,
    require_arrays,
    require_narrow,
)
from bilprov.spec.arrays.states import StateTables
from bilprov.spec.codec import Step, Steps
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import is_open
from bilprov.spec.protocol import NO_ANSWER, InstructionSpec, Protocol


class RequestTables:
    """Cuts requests and judges them. Raises OverflowError for what does not fit into 64 bits."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        layout = self.layout = protocol.layout
        self.specs = protocol.instructions
        identity = layout.part("id")
        if identity is None:
            raise OverflowError("frames without an ID are not decoded by columns")
        self._id = identity
        require_narrow(layout)
        for spec in self.specs:
            _require_numbers(spec)
            require_arrays(spec)
        self._ids = np.array([spec.id for spec in self.specs], np.int64)
        every = np.arange(256)  # each byte, for an ID of one
        self._by_byte = self._kinds_of(
            part_values(identity, every.astype(np.uint8), every - identity.offset, every)
        )
        # The sizes of frames by kind, and the kinds whose size differs.
        sizes = [fixed_size(layout, spec) for spec in self.specs]
        self._varied = [place for place, size in enumerate(sizes) if not size]
        self._fixed = np.array([*sizes, 0], np.int64)  # the last is that of unused IDs, -1
        answered = protocol.answers[Outcome.VALID] is not NO_ANSWER
        self._answered = np.array(
            [answered and spec.answer is not None for spec in self.specs], np.bool_
        )
        self.keys = np.array([protocol.key_of(spec.id) for spec in self.specs], np.uint8)
        self._verdict = np.zeros(0, np.uint8)  # by kind, of frames with one header byte
        # Of these the instructions with more than one data byte, which are judged field by field.
        self._long: dict[int, InstructionSpec] = {}
        self._size_of = np.array([1 + length for length in protocol.lengths], np.int64)
        if protocol.plain:
            self._fill()
            return
        self.states = StateTables(protocol, len(self.specs))
        for place, spec in enumerate(self.specs):
            self.states.add(place, spec.effect.assignments, spec.fields)

    def _fill(self) -> None:
        """Fill the tables of frames with one header byte from the judgements of such frames."""
        protocol, steps = self._protocol, Steps(self._protocol)
        keys = [protocol.key_of(identity) for identity, _ in protocol.headers]
        self.keys = np.repeat(np.array(keys, np.uint8), 256)
        self._verdict = np.zeros(1 << 16, np.uint8)
        self._answered = np.ones(1 << 16, np.bool_)
        self.states = StateTables(protocol, 1 << 16)
        for header, length in enumerate(protocol.lengths):
            frame, kind = bytes([header]) + bytes(length), header << 8
            step = steps[frame]
            if not length or step.judgement.outcome not in (Outcome.VALID, Outcome.BAD_DATA):
                self._add(slice(kind, kind + 256), step)
            elif length == 1:
                for first in range(256):
                    self._add(kind | first, steps[bytes([header, first])])
            else:
                spec = self._long[header] = protocol.by_id[protocol.headers[header][0]]
                self.states.add(kind, spec.effect.assignments, spec.fields)
                self._answered[kind] = spec.answer is not None
                self._verdict[kind | 1] = BAD_DATA
                self.states.add(kind | 1, protocol.on_fault.assignments)

    def _add(self, kinds: int | slice, step: Step) -> None:
        self._verdict[kinds] = OUTCOMES.index(step.judgement.outcome)
        self._answered[kinds] = step.judgement.answer_due
        self.states.add(kinds, step.sets)

    def cut(self, data: Bytes, begun: int, reads: Places | None = None) -> Cut[Requests]:
        """The requests of `data` from byte `begun` on, as far as they are whole and valid.

        `reads` are where the reads end in which the bytes came: mostly, each is one frame.
        """
        if len(self._verdict):
            offset, end = self.offsets(data, begun)
            size = np.diff(offset, append=end)
            return Cut(self._judged(data, offset, size), end, regular=True)
        bounds = np.array([begun]) if reads is None else self._whole_reads(data, begun, reads)
        if bounds[-1] < len(data):
            bounds = np.concatenate([bounds[:-1], self._walk(data, int(bounds[-1]))])
        offset, size = bounds[:-1], np.diff(bounds)
        kind = self._kinds(data, offset)
        good = self._valid(data, offset, bounds[1:], kind)
        rows = leading(good)
        regular = rows == len(good) and is_open(self._protocol, data[bounds[-1] :].tobytes())
        found = Requests(offset, size, kind, np.zeros(len(kind), np.uint8)).rows(slice(rows))
        return Cut(found, int(bounds[rows]), regular)

    def _judged(self, data: Bytes, offset: Places, size: Places) -> Requests:
        """Frames with one header byte, valid or not."""
        kind = data.take(offset).astype(np.int64) << 8
        kind |= data.take(offset + 1, mode="clip")
        for header, spec in self._long.items():
            rows = np.flatnonzero(kind >> 8 == header)
            start = offset[rows]
            good = self._good_data(spec, data, start, start + size[rows])
            kind[rows] = header << 8 | ~good
        return Requests(offset, size, kind, self._verdict.take(kind))

    def offsets(self, data: Bytes, start: int = 0) -> tuple[Places, int]:
        """The offsets of all complete frames in `data`, and that of the first header after them.

        Byte `start` is a header. Where a frame begins depends on all frames before it. So block by
        block, for each place the place 2^k frames on is looked up (k times an array operation);
        only each 2^k-th frame is then walked to one by one, and those between are looked up again.
        """
        spare = int(self._size_of.max())
        block = min(len(data) - start, _BLOCK)
        places = np.arange(block + spare, dtype=np.int64)
        jumps = [np.empty(block + spare, np.int64) for _ in range(_DOUBLINGS + 1)]
        found, at = [np.empty(0, np.int64)], start
        for base in range(start, len(data), _BLOCK):
            size = min(len(data) - base, _BLOCK)
            reach = size + spare
            np.take(self._size_of, data[base : base + size], out=jumps[0][:size], mode="clip")
            jumps[0][:size] += places[:size]
            jumps[0][size:reach] = places[size:reach]  # behind the block each place is its own next
            for near, far in pairwise(jumps):
                np.take(near[:reach], near[:reach], out=far[:reach], mode="clip")
            walked = _followed(jumps[-1].data, at - base, size)
            at = base + walked.pop()
            frames = np.array(walked, np.int64)
            for jump in reversed(jumps[:-1]):
                both = np.empty(2 * len(frames), np.int64)
                both[::2] = frames
                np.take(jump, frames, out=both[1::2], mode="clip")
                frames = both
            frames = frames[: np.searchsorted(frames, size)]
            frames += base
            found.append(frames)
        offsets = np.concatenate(found)
        if at > len(data):  # the last frame is not complete
            return offsets[:-1], int(offsets[-1])
        return offsets, at

    def _whole_reads(self, data: Bytes, begun: int, reads: Places) -> Places:
        """Where the frames begin of which each is one read, and where the next one begins."""
        bounds = np.append(begun, reads[np.searchsorted(reads, begun, "right") :])
        whole = self._sizes_at(data, bounds[:-1]) == np.diff(bounds)
        return bounds[: 1 + leading(whole)]

    def _sizes_at(self, data: Bytes, offset: Places) -> Places:
        """The sizes of the frames at these places, 0 for none; see `frame_sizes`."""
        if self.layout.part("length") is not None:
            return frame_sizes(self.layout, DataSpec(), data, offset)
        kinds = self._kinds(data, offset)
        found = self._fixed.take(kinds)
        for place in self._varied:
            rows = np.flatnonzero(kinds == place)
            if len(rows):
                found[rows] = frame_sizes(self.layout, self.specs[place], data, offset[rows])
        return found

    def _walk(self, data: Bytes, at: int) -> Places:
        """Where the frames from `at` on begin that are whole, and where the next one begins."""
        places = np.arange(at, len(data))
        size = self._sizes_at(data, places)
        size[size == 0] = len(data) + 1  # no frame: the walk ends there
        jumps = places - at + size
        walked = _followed(jumps.data, 0, len(jumps))
        if walked[-1] > len(jumps):
            walked.pop()
        return at + np.array(walked)

    def _kinds(self, data: Bytes, offset: Places) -> Places:
        """The place of each frame's instruction; -1 for an unused ID."""
        if self._id.size == 1:
            return self._by_byte.take(data.take(offset + self._id.offset, mode="clip"))
        return self._kinds_of(part_values(self._id, data, offset, offset))

    def _kinds_of(self, identity: Places) -> Places:
        """The places of the instructions with these IDs; -1 for an unused one."""
        place = np.minimum(np.searchsorted(self._ids, identity), len(self._ids) - 1)
        return np.where(self._ids.take(place) == identity, place, -1)

    def due(self, data: Bytes, requests: Requests) -> Mask | None:
        """To which requests a conforming device gives an answer; None: to each."""
        if self._answered.all() and self.layout.part("address") is None:
            return None
        due: Mask = self._answered.take(requests.kind)
        if self.layout.part("address") is not None:
            due &= self._to(data, requests.offset, broadcast=False)
        return due

    def _to(self, data: Bytes, offset: Places, *, broadcast: bool) -> Mask:
        """Which frames are for one device that there can be, or with `broadcast` for all."""
        part = self.layout.part("address")
        if part is None:
            return np.ones(len(offset), np.bool_)
        to = part_values(part, data, offset, offset)
        one = (to >= part.low) & (to <= part.high)
        return one | (to == part.broadcast) if broadcast and part.broadcast is not None else one

    def _valid(self, data: Bytes, start: Places, end: Places, kind: Places) -> Mask:
        """Which frames a device judges to be valid; see `codec.judge`."""
        good = (kind >= 0) & constants_hold(self.layout, data, start, end)
        good &= checks_hold(self.layout, data, start, end)
        good &= self._to(data, start, broadcast=True)
        for place, spec in enumerate(self.specs):
            rows = np.flatnonzero(good & (kind == place))
            if len(rows):
                good[rows] = self._good_data(spec, data, start[rows], end[rows])
        return good

    def _good_data(self, spec: DataSpec, data: Bytes, start: Places, end: Places) -> Mask:
        """Which frames with such data have as many as are needed, all in their ranges."""
        at = start + self.layout.head
        size = end - self.layout.tail - at
        good = size >= spec.length
        rows = np.flatnonzero(good)
        at, size = at[rows], size[rows]
        right = np.ones(len(rows), np.bool_)
        if self.layout.part("length") is not None and not spec.takes_rest:
            right &= size == data_sizes(spec, data, at)
        for part in spec.fields:
            right &= in_range(part, data, at + part.offset, size - part.offset)
        good[rows] = right
        return good

    def numbers(self, data: Bytes, requests: Requests, kind: int) -> Mapping[str, Places]:
        """The parts and the fields of requests of one kind that are numbers, by name."""
        start, end = requests.offset, requests.end
        parts = {
            name: part_values(part, data, start, end) for name, part in self.layout.told.items()
        }
        at = start + self.layout.head
        fields = {
            part.name: number_values(part.number, data, at + part.offset)
            for part in self.specs[kind].fields
            if part.number is not None and part.size <= WIDEST
        }
        return {**parts, **fields}

    def numbers_of(self, spec: InstructionSpec) -> list[str]:
        """The names of those of an instruction."""
        narrow = [p.name for p in spec.fields if p.number is not None and p.size <= WIDEST]
        return [*self.layout.told, *narrow]


def _require_numbers(spec: DataSpec) -> None:
    """Raise OverflowError for data whose ranges do not fit into 64 bits."""
    for part in spec.fields:
        number = part.many.element if part.many else part.number
        if number is not None and number.size > WIDEST and not part.unlimited:
            raise OverflowError(f"{part.name} does not fit into 64 bits")


_BLOCK = 1 << 16  # bytes that are cut at once; the tables of a block fit into a cache
_DOUBLINGS = 5


def _followed(jumps: memoryview, at: int, end: int) -> list[int]:
    """Follow `jumps` from `at` until `end` is reached; that last place is in the list too."""
    walked = [at]
    while at < end:
        at = jumps[at]
        walked.append(at)
    return walked


@lru_cache(maxsize=8)
def request_tables(protocol: Protocol) -> RequestTables:
    """The tables of a protocol, made when they are first asked for. Raises OverflowError."""
    return RequestTables(protocol)
