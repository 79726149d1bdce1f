"""Cuts and judges the requests in a buffer in arrays, as far as they are whole and valid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from bilprov.spec.arrays.layouts import (
    Bytes,
    Mask,
    Places,
    Told,
    checks_hold,
    constants_hold,
    data_sizes,
    in_range,
    part_values,
    require_narrow,
    size_by_byte,
)
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import frame_size
from bilprov.spec.protocol import NO_ANSWER, InstructionSpec, Protocol
from bilprov.spec.state import Assigned, assigned
from bilprov.spec.tables import WIDEST, number_values


class Requests(NamedTuple):
    """Valid frames of a buffer, one row each.

    `offset` is where a frame begins, `size` its bytes, `kind` the place of its instruction in
    `Protocol.instructions`, and `due` tells whether a conforming device answers it.
    """

    offset: Places
    size: Places
    kind: Places
    due: Mask

    def rows(self, rows: slice | Mask | Places) -> Requests:
        """Some of the rows."""
        return Requests(self.offset[rows], self.size[rows], self.kind[rows], self.due[rows])

    def and_then(self, other: Requests) -> Requests:
        """These rows and those of `other`, of the same buffer."""
        return Requests(*(np.concatenate(both) for both in zip(self, other, strict=True)))

    @property
    def end(self) -> Places:
        """Where each frame ends."""
        return self.offset + self.size


class CutRequests(NamedTuple):
    """The requests of a buffer up to byte `end`.

    With `regular` what follows is the beginning of a frame, or nothing; without it, it is a frame
    that is not valid, or none.
    """

    requests: Requests
    end: int
    regular: bool


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
            _require_numbers(spec.data)
        self.keys = np.array([protocol.key_of(spec.id) for spec in self.specs], np.uint8)
        self._ids = np.array([spec.id for spec in self.specs], np.int64)
        answered = protocol.answers[Outcome.VALID] is not NO_ANSWER
        self._answered = np.array(
            [answered and spec.answer is not None for spec in self.specs], np.bool_
        )
        # The size of a frame by the byte at a place in it, 0 where it takes more to tell.
        self._place = identity.offset
        self._sizes: tuple[int, ...] = (0,) * 256
        self._counted: dict[int, Told | InstructionSpec] = {}  # those by the byte of the ID
        told = size_by_byte(layout, None)
        by_id = identity.size == 1 and layout.part("length") is None
        self._by_byte = by_id or isinstance(told, Told)
        if by_id:
            self._sizes = tuple(map(self._by_id_byte, range(256)))
        elif isinstance(told, Told):
            self._place, self._sizes = told

    def _by_id_byte(self, byte: int) -> int:
        """The size of the frames with this byte in the place of the ID; 0 if more decides."""
        spec = self._protocol.by_id.get(self._id.read(bytes(self._id.offset) + bytes([byte])))
        if spec is None:
            return 0
        size = size_by_byte(self.layout, spec.data)
        if isinstance(size, int):
            return size
        self._counted[byte] = size or spec
        return 0

    @cached_property
    def has_effects(self) -> bool:
        """Whether any frame sets a state variable."""
        effects = [self._protocol.on_fault, *(spec.effect for spec in self.specs)]
        return any(effect.assignments for effect in effects)

    def cut(self, data: Bytes, begun: int, reads: Places | None = None) -> CutRequests:
        """The requests of `data` from byte `begun` on, as far as they are whole and valid.

        `reads` are where the reads end in which the bytes came: mostly, each is one frame.
        """
        raw = data.tobytes()
        bounds = np.array([begun]) if reads is None else self._whole_reads(data, begun, reads)
        bounds = np.concatenate([bounds[:-1], self._walk(raw, int(bounds[-1]))])
        offset, end = bounds[:-1], int(bounds[-1])
        size = np.diff(bounds)
        kind = self._kinds(data, offset)
        good = self._valid(data, offset, offset + size, kind)
        rows = len(good) if good.all() else int(np.argmin(good))
        regular = rows == len(good) and self._is_open(raw[end:])
        offset, size, kind = offset[:rows], size[:rows], kind[:rows]
        found = Requests(offset, size, kind, self._due(data, offset, kind))
        return CutRequests(found, int(offset[-1] + size[-1]) if rows else begun, regular)

    def _whole_reads(self, data: Bytes, begun: int, reads: Places) -> Places:
        """Where the frames begin of which each is one read, and where the next one begins."""
        bounds = np.append(begun, reads[np.searchsorted(reads, begun, "right") :])
        whole = self._sizes_at(data, bounds[:-1]) == np.diff(bounds)
        return bounds[: 1 + (len(whole) if whole.all() else int(np.argmin(whole)))]

    def _sizes_at(self, data: Bytes, offset: Places) -> Places:
        """The sizes of the frames at these places; 0 for what only all their fields tell.

        A size that reaches beyond the data may be wrong.
        """
        byte = data.take(offset + self._place, mode="clip")
        size = np.array(self._sizes, np.int64).take(byte)
        for known, told in self._counted.items():
            if isinstance(told, Told):
                rows = np.flatnonzero(byte == known)
                size[rows] = told.at(data, offset[rows])
        return size

    def _walk(self, data: bytes, at: int) -> list[int]:
        """Where the frames from `at` on begin that are whole, and where the next one begins."""
        place, sizes = self._place, self._sizes
        walked, last = [at], len(data) - place
        while at < last:
            size = sizes[data[at + place]] or self._size(data, at)
            if not size:
                return walked
            at += size
            walked.append(at)
        if at > len(data):
            walked.pop()
        return walked

    def _size(self, data: bytes, at: int) -> int:
        """The size of the frame at this place; 0 if it is not known yet, or none."""
        found = self._counted.get(data[at + self._place])
        head = self.layout.head
        if isinstance(found, Told):
            place = at + found.place
            return found.sizes[data[place]] if place < len(data) else 0
        if found is not None:
            count = found.data.measure(data[at + head : at + head + found.length])
            return 0 if count is None else head + count + self.layout.tail
        if self._by_byte:
            return 0
        spec = self._protocol.by_id.get(self.layout.id_of(data[at : at + head]) or 0)
        size = frame_size(self._protocol, data[at : at + head + (spec.length if spec else 0)])
        return max(0, size or 0)

    def _is_open(self, rest: bytes) -> bool:
        """Whether bytes are the beginning of a frame that is not complete, or none."""
        size = frame_size(self._protocol, rest) if rest else None
        return size is None or size > len(rest)

    def _kinds(self, data: Bytes, offset: Places) -> Places:
        """The place of each frame's instruction; -1 for an unused ID."""
        identity = part_values(self._id, data, offset, offset)
        place = np.minimum(np.searchsorted(self._ids, identity), len(self._ids) - 1)
        return np.where(self._ids.take(place) == identity, place, -1)

    def _due(self, data: Bytes, offset: Places, kind: Places) -> Mask:
        due = self._answered.take(kind)
        return due & self._to(data, offset, broadcast=False)

    def _to(self, data: Bytes, offset: Places, *, broadcast: bool) -> Mask:
        """Which frames are for one device that there can be, or with `broadcast` for all."""
        part = self.layout.part("address")
        if part is None:
            return np.ones(len(offset), np.bool_)
        to = part_values(part, data, offset, offset)
        one = (to >= part.low) & (to <= part.high)
        return one | (to == part.broadcast) if broadcast and part.broadcast is not None else one

    def _valid(self, data: Bytes, start: Places, end: Places, kind: Places) -> Mask:
        """Which frames a device judges to be valid; see `codec.judge_framed`."""
        good = (kind >= 0) & constants_hold(self.layout, data, start, end)
        good &= checks_hold(self.layout, data, start, end)
        good &= self._to(data, start, broadcast=True)
        for place, spec in enumerate(self.specs):
            rows = np.flatnonzero(good & (kind == place))
            if len(rows):
                good[rows] = self._good_data(spec.data, data, start[rows], end[rows])
        return good

    def _good_data(self, spec: DataSpec, data: Bytes, start: Places, end: Places) -> Mask:
        """Which frames with such data have as many as are needed, all in their ranges."""
        at = start + self.layout.head
        size = end - self.layout.tail - at
        good = size >= spec.length
        rows = np.flatnonzero(good)
        at, size = at[rows], size[rows]
        right = np.ones(len(rows), np.bool_)
        many = spec.counted
        if self.layout.part("length") is not None and (many is None or many.how != "rest"):
            right &= size == data_sizes(spec, data, at, self._measured(spec, data, at, size))
        for part in spec.fields:
            right &= in_range(part, data, at + part.offset, size - part.offset)
        good[rows] = right
        return good

    @staticmethod
    def _measured(spec: DataSpec, data: Bytes, at: Places, size: Places) -> Callable[[int], int]:
        """How many bytes the data of a row need."""

        def measured(row: int) -> int:
            begun = data[at[row] : at[row] + size[row]].tobytes()
            return spec.measure(begun) or 0

        return measured

    def sets(self, data: Bytes, requests: Requests) -> list[Assigned]:
        """The state variables that each request sets, with their new values."""
        found: list[Assigned] = [()] * len(requests.kind)
        for kind in np.unique(requests.kind).tolist():
            effect = self.specs[kind].effect
            if effect.assignments:
                rows = np.flatnonzero(requests.kind == kind)
                numbers = self.numbers(data, requests.rows(rows), kind)
                columns = {name: column.tolist() for name, column in numbers.items()}
                for place, row in enumerate(rows.tolist()):
                    fields = {name: column[place] for name, column in columns.items()}
                    found[row] = assigned(effect, fields)
        return found

    def addresses(self, data: Bytes, requests: Requests) -> list[int] | None:
        """The address in each request; None where they have none."""
        part = self.layout.part("address")
        if part is None:
            return None
        found: list[int] = part_values(part, data, requests.offset, requests.end).tolist()
        return found

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


def _require_numbers(spec: DataSpec) -> None:
    """Raise OverflowError for data whose ranges do not fit into 64 bits."""
    for part in spec.fields:
        if part.number is not None and part.size > WIDEST and not part.unlimited:
            raise OverflowError(f"{part.name} does not fit into 64 bits")


@lru_cache(maxsize=8)
def request_tables(protocol: Protocol) -> RequestTables:
    """The tables of a protocol, made when they are first asked for. Raises OverflowError."""
    return RequestTables(protocol)
