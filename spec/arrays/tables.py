"""Cuts and judges the requests and the answers in buffers in arrays, as far as they are right.

Requests are whole and valid; those with one header byte may be faulty, too: their headers tell
where they end. Each answer is the usual one to its request: one in the layout of errors is not, as
what it is depends on all the ways to answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.arrays import layouts
from bilprov.spec.arrays.layouts import Bytes, Cut, Mask, Numbers, Places, Requests
from bilprov.spec.arrays.states import StateTables
from bilprov.spec.codec import Step, Steps, judge
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import is_open
from bilprov.spec.layout import Layout
from bilprov.spec.protocol import NO_ANSWER, InstructionSpec, Protocol
from bilprov.spec.replies import meaning, reply_size, usual_way


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
        layouts.require_narrow(layout)
        for spec in self.specs:
            layouts.require_arrays(spec)
            for part in spec.fields:
                if part.element and part.element.size > layouts.WIDEST and not part.unlimited:
                    raise OverflowError(f"{part.name} does not fit into 64 bits")
        self._ids = np.array([spec.id for spec in self.specs], np.int64)
        every = np.arange(256)  # each byte, for an ID of one
        self._by_byte = self._kinds_of(
            layouts.part_values(identity, every.astype(np.uint8), every - identity.offset, every)
        )
        self._sizes = layouts.Sizes([(layout.of(spec.id), spec) for spec in self.specs])
        # By kind, -1 for an unused ID.
        self._checked = np.array([*(spec.id not in layout.unchecked for spec in self.specs), True])
        silent = protocol.answers[Outcome.VALID] is NO_ANSWER
        self._answered = np.array([not silent and spec.answer is not None for spec in self.specs])
        self.keys = np.array([protocol.key_of(spec.id) for spec in self.specs], np.uint8)
        self._verdict = np.zeros(0, np.uint8)  # by kind, of frames with one header byte
        # Of these the instructions with more than one data byte, which are judged field by field.
        self._long: dict[int, InstructionSpec] = {}
        self._size_of = np.array([1 + length for length in protocol.lengths], np.int64)
        if protocol.plain:
            self._fill()
        else:
            self.states = StateTables(protocol, len(self.specs))
            for place, spec in enumerate(self.specs):
                self.states.add(place, spec.effect.assignments, spec.fields)
        self._every = bool(self._answered.all()) and layout.part("address") is None

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
                self._verdict[kind | 1] = layouts.BAD_DATA
                self.states.add(kind | 1, protocol.on_fault.assignments)

    def _add(self, kinds: int | slice, step: Step) -> None:
        self._verdict[kinds] = layouts.OUTCOMES.index(step.judgement.outcome)
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
        rows = layouts.leading(good)
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
        return bounds[: 1 + layouts.leading(whole)]

    def _sizes_at(self, data: Bytes, offset: Places) -> Places:
        """The sizes of the frames at these places, 0 for none; see `frame_sizes`."""
        if self.layout.part("length") is None:
            return self._sizes.at(self._kinds(data, offset), data, offset)
        size = layouts.frame_sizes(self.layout, DataSpec(), data, offset)
        if self.layout.unchecked:
            checked = self._checked.take(self._kinds(data, offset))
            size[~checked & (size > 0)] -= self.layout.tail
        return size

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
        return self._kinds_of(layouts.part_values(self._id, data, offset, offset))

    def _kinds_of(self, identity: Places) -> Places:
        """The places of the instructions with these IDs; -1 for an unused one."""
        place = np.minimum(np.searchsorted(self._ids, identity), len(self._ids) - 1)
        return np.where(self._ids.take(place) == identity, place, -1)

    def due(self, data: Bytes, requests: Requests) -> Mask | None:
        """To which requests a conforming device gives an answer; None: to each."""
        if self._every:
            return None
        due: Mask = self._answered.take(requests.kind)
        return due & self._to(data, requests.offset, None)

    def _to(self, data: Bytes, offset: Places, broadcast: int | None) -> Mask:
        """Which frames are for one device that there can be, or for all."""
        part = self.layout.part("address")
        if part is None:
            return np.ones(len(offset), np.bool_)
        to = layouts.part_values(part, data, offset, offset)
        one = (to >= part.low) & (to <= part.high)
        return one if broadcast is None else one | (to == broadcast)

    def _valid(self, data: Bytes, start: Places, end: Places, kind: Places) -> Mask:
        """Which frames a device judges to be valid; see `codec.judge`."""
        good = (kind >= 0) & layouts.constants_hold(self.layout, data, start, end)
        checked = self._checked.take(kind)
        rows: slice | Places = slice(None) if checked.all() else np.flatnonzero(checked)
        good[rows] &= layouts.checks_hold(self.layout, data, start[rows], end[rows])
        to = self.layout.part("address")
        good &= self._to(data, start, to.broadcast if to else None)
        for place, spec in enumerate(self.specs):
            rows = np.flatnonzero(good & (kind == place))
            if len(rows):
                good[rows] = self._good_data(spec, data, start[rows], end[rows])
        return good

    def _good_data(self, spec: InstructionSpec, data: Bytes, start: Places, end: Places) -> Mask:
        """Which frames with such data have as many as are needed, all in their ranges."""
        layout = self.layout.of(spec.id)
        good = layouts.sized(layout, spec, data, start, end)
        rows = np.flatnonzero(good)
        at = start[rows] + layout.head
        size, right = end[rows] - layout.tail - at, np.ones(len(rows), np.bool_)
        for part in spec.fields:
            right &= layouts.in_range(part, data, at + part.offset, size - part.offset)
        good[rows] = right
        return good

    def covered(self, requests: Requests) -> tuple[Places, Places]:
        """Where what the check of each request covers begins and ends; see `Layout.covered_in`."""
        check = self.layout.check
        if check is None:
            return requests.offset, requests.end
        behind = np.where(self._checked.take(requests.kind), check.last, 0)
        return requests.offset + check.first, requests.end - behind

    def numbers(self, data: Bytes, requests: Requests, kind: int) -> Mapping[str, Places]:
        """The parts and the fields of requests of one kind that are numbers, by name."""
        start, end = requests.offset, requests.end
        parts = {
            name: layouts.part_values(part, data, start, end)
            for name, part in self.layout.told.items()
        }
        return parts | layouts.field_numbers(self.specs[kind], data, start + self.layout.head)


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


NO_CODE = 256
"""The place of the name of answers without a code; that of a code is the code."""


class Answers(NamedTuple):
    """Answers in a buffer, one row each, in the order of the requests.

    `offset` is where an answer begins, `size` its bytes, `code` its code, NO_CODE where it has
    none.
    """

    offset: Places
    size: Places
    code: NDArray[Any]

    def rows(self, rows: slice | Places) -> Answers:
        """Some of the rows."""
        return Answers(*(column[rows] for column in self))

    @property
    def end(self) -> Places:
        """Where each answer ends."""
        return self.offset + self.size


class AnswerTables:
    """Cuts answers and reads them.

    Raises OverflowError for what does not fit into 64 bits, and for an answer whose size only its
    request tells.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._tables = request_tables(protocol)
        usual = (usual_way(protocol, spec) for spec in protocol.instructions)
        self._ways = [(way.layout, way.data or DataSpec()) for way in usual]
        two = np.zeros(2, np.int64)
        for kind, (layout, data) in enumerate(self._ways):
            # Without a length an answer must tell its size by itself.
            asked = self._tables.numbers(np.zeros(1, np.uint8), Requests(two, two, two, two), kind)
            layouts.require_arrays(data, asked if layout.part("length") else {})
        # For each kind the first one whose answers have their sizes in the same way.
        told = [(own, own.part("length") is None and spec) for own, spec in self._ways]
        self._alike = np.array([told.index(way) for way in told], np.int64)
        self._sizes = layouts.Sizes(self._ways)
        self._layouts: list[tuple[Layout, Mask]] = []
        for layout in (protocol.reply, protocol.acknowledgement):
            layouts.require_narrow(layout)
            code = layout.part("code")
            if code is not None and (code.size > 1 or code.number.signed):
                raise OverflowError("the code of an answer is more than one byte")
            with_it = np.array([own is layout for own, _ in self._ways], np.bool_)
            if all(layout is not other for other, _ in self._layouts):
                self._layouts.append((layout, with_it))
        meanings = [meaning(protocol, code) for code in (*range(NO_CODE), None)]
        # By code, and by NO_CODE: the response, the name, and the code that a record has.
        self.responses = known = [response for _, response in meanings]
        self.names = [
            " ".join(names) or (response.name if response else None) for names, response in meanings
        ]
        self.bytes = np.array([one.code if one else at for at, one in enumerate(known)], np.int64)
        self._expected = np.array(
            [max(0, protocol.answers[outcome].code) for outcome in layouts.OUTCOMES], np.uint8
        )
        self.known = np.array([one is not None for one in known], np.bool_)
        # Codes with which the answer may lack its data.
        self._fails = np.array(
            [one is not None and Outcome.VALID not in one.outcomes for one in known], np.bool_
        )

    def cut(self, asked: Bytes, requests: Requests, data: Bytes, reads: Places) -> Cut[Answers]:
        """The answers in `data` to the requests of `asked`, as far as they are right.

        `reads` are where the reads end in which the bytes came: mostly, each is one answer.
        """
        if self._protocol.plain:  # each byte is an answer, right or not
            count = min(len(data), len(requests.kind))
            size = np.broadcast_to(np.int64(1), count)
            return Cut(Answers(np.arange(count), size, data[:count]), count, regular=True)
        bounds = self._whole_reads(requests, data, reads)
        if bounds[-1] < len(data):
            left = requests.rows(slice(len(bounds) - 1, len(bounds) - 1 + len(data)))
            bounds = np.append(bounds[:-1], self._walk(left, data, int(bounds[-1])))
        end, code = int(bounds[-1]), np.full(len(bounds) - 1, NO_CODE)
        found = Answers(bounds[:-1], np.diff(bounds), code)
        good = self._right(asked, requests.rows(slice(len(code))), data, found)
        rows = layouts.leading(good)
        regular = rows == len(good)
        if regular and end < len(data) and rows < len(requests.kind):
            request = asked[requests.offset[rows] : requests.end[rows]].tobytes()
            rest = data[end:].tobytes()
            due = reply_size(self._protocol, rest, judge(self._protocol, request))
            regular = due is None or due > len(rest)
        return Cut(found.rows(slice(rows)), int(bounds[rows]), regular)

    def agree(self, requests: Requests, answers: Answers) -> Mask:
        """Which answers are those that a conforming device gives to these requests."""
        if self._protocol.plain:
            right: Mask = self._expected.take(requests.verdict) == answers.code
            return right
        return np.broadcast_to(True, len(answers.code))

    def fields(self, kind: Places, answers: Answers) -> tuple[Places, Places]:
        """Where the fields of answers to requests of these kinds are: their places and bytes.

        The size is -1 where an answer has no fields.
        """
        if self._protocol.plain:
            return answers.offset, np.broadcast_to(np.int64(-1), len(kind))
        around = np.array([(layout.head, layout.tail) for layout, _ in self._ways], np.int64)
        least = [spec.length if spec.fields else -1 for _, spec in self._ways]
        head, tail = around.take(kind, axis=0).T
        size = answers.size - head - tail
        needed = np.array(least, np.int64).take(kind)
        lacking = self._fails.take(answers.code) & (size == 0)
        there = (needed >= 0) & (size >= needed) & ~lacking
        return answers.offset + head, np.where(there, size, -1)

    def addresses(self, kind: Places, data: Bytes, answers: Answers) -> Places:
        """Whose the answers in `data` to requests of these kinds are; -1 where they do not say."""
        found = np.broadcast_to(np.int64(-1), len(kind))
        for layout, kinds in self._layouts:
            part = layout.part("address")
            if part is not None:
                found = found if found.flags.writeable else found.copy()
                rows = np.flatnonzero(kinds.take(kind))
                value = layouts.part_values(part, data, answers.offset[rows], answers.end[rows])
                found[rows] = part.repeated(value)
        return found

    def _whole_reads(self, requests: Requests, data: Bytes, reads: Places) -> Places:
        """Where the answers begin of which each is one read, and where the next one begins."""
        bounds = np.append(0, reads[: len(requests.kind)])
        begun = requests.rows(slice(len(bounds) - 1))
        whole = self._sizes.at(begun.kind, data, bounds[:-1]) == np.diff(bounds)
        return bounds[: 1 + layouts.leading(whole)]

    def _walk(self, requests: Requests, data: Bytes, first: int) -> list[int]:
        """Where the answers from byte `first` on begin that are whole, and where the next one does.

        They are to these requests.
        """
        places = np.arange(first, len(data) + 1)
        fixed, alike = self._sizes.fixed.take(requests.kind), self._alike.take(requests.kind)
        by_place = {
            kind: layouts.frame_sizes(*self._ways[kind], data, places).data
            for kind in self._sizes.varied
            if kind in alike
        }
        walked, at, last = [first], first, len(data)
        for kind, size in zip(alike.tolist(), fixed.tolist(), strict=True):
            at += by_place[kind][at - first] if kind in by_place else size
            if at == walked[-1] or at > last:
                break
            walked.append(at)
        return walked

    def _right(self, asked: Bytes, requests: Requests, data: Bytes, answers: Answers) -> Mask:
        """Which answers to the requests are right; writes the codes of those that have one."""
        good = np.ones(len(answers.code), np.bool_)
        for layout, kinds in self._layouts:
            mask = kinds.take(requests.kind)
            rows: slice | Places = slice(None) if mask.all() else np.flatnonzero(mask)
            these, to = answers.rows(rows), requests.rows(rows)
            where = data, these.offset, these.end
            before = None
            if layout.check and layout.check.asked:
                before = layouts.Checking(layout.check.function, len(to.kind))
                before.take(asked, *self._tables.covered(to))
            right = layouts.constants_hold(layout, *where) & layouts.checks_hold(
                layout, *where, before
            )
            part = layout.part("code")
            if part is not None:
                code = layouts.part_values(part, *where)
                answers.code[rows] = code
                right &= self.known.take(code)
            good[rows] = right
        for kind, (layout, spec) in enumerate(self._ways):
            rows = np.flatnonzero(good & (requests.kind == kind))
            if len(rows):
                numbers = self._tables.numbers(asked, requests.rows(rows), kind)
                these = answers.rows(rows)
                right = _repeats(layout, numbers, data, these.offset)
                if layout.has_data and layout.part("length"):  # else data make the size
                    size = these.size - layout.head - layout.tail
                    whole = layouts.sized(layout, spec, data, these.offset, these.end, numbers)
                    right &= whole | ((size == 0) & self._fails.take(these.code))
                good[rows] = right
        return good


def _repeats(layout: Layout, asked: Numbers, data: Bytes, start: Places) -> Mask:
    """Which answers that begin there repeat what they must of their requests' numbers."""
    found = np.ones(len(start), np.bool_)
    for part in layout.parts:
        if part.same and part.offset >= 0:
            value = asked.get(part.same, np.int64(-1))
            right = layouts.part_values(part, data, start, start) == part.repeating(value)
            found &= right & (value >= 0)
    return found


@lru_cache(maxsize=8)
def answer_tables(protocol: Protocol) -> AnswerTables:
    """The tables of a protocol, made when they are first asked for. Raises OverflowError."""
    return AnswerTables(protocol)
