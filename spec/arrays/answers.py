"""Cuts and reads the answers in a buffer in arrays: each is the usual one to its request.

An answer in the layout of errors is not: what it is depends on all the ways to answer.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.arrays.layouts import (
    OUTCOMES,
    Bytes,
    Checking,
    Cut,
    Mask,
    Numbers,
    Places,
    Requests,
    checks_hold,
    constants_hold,
    data_sizes,
    fixed_size,
    frame_sizes,
    leading,
    part_values,
    require_arrays,
    require_narrow,
)
from bilprov.spec.arrays.requests import request_tables
from bilprov.spec.codec import judge
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import meaning, reply_size, usual_way

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
        for (layout, data), spec in zip(self._ways, protocol.instructions, strict=True):
            # Without a length an answer must tell its size by itself.
            require_arrays(data, self._tables.numbers_of(spec) if layout.part("length") else ())
        # For each kind the first one whose answers have their sizes in the same way.
        told = [(own, own.part("length") is None and spec) for own, spec in self._ways]
        self._alike = np.array([told.index(way) for way in told], np.int64)
        sizes = [fixed_size(*way) for way in self._ways]
        self._varied = [kind for kind, size in enumerate(sizes) if not size]
        self._fixed = np.array(sizes, np.int64)
        self._layouts: list[tuple[Layout, Mask]] = []
        for layout in (protocol.reply, protocol.acknowledgement):
            require_narrow(layout)
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
            [max(0, protocol.answers[outcome].code) for outcome in OUTCOMES], np.uint8
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
        rows = leading(good)
        regular = rows == len(good)
        if regular and end < len(data) and rows < len(requests.kind):
            left = requests.rows(slice(rows, rows + 1))
            regular = self._is_open(data[end:].tobytes(), asked, left)
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
                value = part_values(part, data, answers.offset[rows], answers.end[rows])
                found[rows] = part.repeated(value)
        return found

    def _is_open(self, rest: bytes, asked: Bytes, request: Requests) -> bool:
        """Whether bytes are the beginning of an answer to a request that is not complete."""
        frame = asked[int(request.offset[0]) : int(request.end[0])].tobytes()
        size = reply_size(self._protocol, rest, judge(self._protocol, frame))
        return size is None or size > len(rest)

    def _sizes(self, requests: Requests, data: Bytes, start: Places) -> Places:
        """The sizes of the answers to some requests that begin at these places."""
        found = self._fixed.take(requests.kind)
        for kind in self._varied:
            rows = np.flatnonzero(requests.kind == kind)
            if len(rows):
                found[rows] = frame_sizes(*self._ways[kind], data, start[rows])
        return found

    def _whole_reads(self, requests: Requests, data: Bytes, reads: Places) -> Places:
        """Where the answers begin of which each is one read, and where the next one begins."""
        bounds = np.append(0, reads[: len(requests.kind)])
        begun = requests.rows(slice(len(bounds) - 1))
        whole = self._sizes(begun, data, bounds[:-1]) == np.diff(bounds)
        return bounds[: 1 + leading(whole)]

    def _walk(self, requests: Requests, data: Bytes, first: int) -> list[int]:
        """Where the answers from byte `first` on begin that are whole, and where the next one does.

        They are to these requests.
        """
        places = np.arange(first, len(data) + 1)
        fixed, alike = self._fixed.take(requests.kind), self._alike.take(requests.kind)
        by_place = {
            kind: frame_sizes(*self._ways[kind], data, places).data
            for kind in self._varied
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
            these = answers.rows(rows)
            where = data, these.offset, these.end
            right = constants_hold(layout, *where)
            right &= checks_hold(layout, *where, self._counted(layout, asked, requests.rows(rows)))
            part = layout.part("code")
            if part is not None:
                code = part_values(part, *where)
                answers.code[rows] = code
                right &= self.known.take(code)
            good[rows] = right
        for kind, (layout, spec) in enumerate(self._ways):
            rows = np.flatnonzero(good & (requests.kind == kind))
            if len(rows):
                numbers = self._tables.numbers(asked, requests.rows(rows), kind)
                these = answers.rows(rows)
                good[rows] = _repeats(layout, numbers, data, these.offset)
                good[rows] &= self._whole(layout, spec, numbers, data, these)
        return good

    def _counted(self, layout: Layout, asked: Bytes, requests: Requests) -> Checking | None:
        """The check of what it covers of the requests, where it does."""
        if layout.check is None or not layout.check.asked:
            return None
        checking = Checking(layout.check.function, len(requests.kind))
        check = self._protocol.layout.check
        first, last = (check.first, check.last) if check else (0, 0)
        checking.take(asked, requests.offset + first, requests.end - last)
        return checking

    def _whole(
        self, layout: Layout, spec: DataSpec, asked: Numbers, data: Bytes, answers: Answers
    ) -> Mask:
        """Which answers to requests of one kind have all their data, or fail without any."""
        if not layout.has_data or layout.part("length") is None:
            return np.ones(len(answers.code), np.bool_)  # their size is made of their data
        size = answers.size - layout.head - layout.tail
        good = size >= spec.length
        if not spec.takes_rest:
            good &= size == data_sizes(spec, data, answers.offset + layout.head, asked)
        refused: Mask = (size == 0) & self._fails.take(answers.code)
        return good | refused


def _repeats(layout: Layout, asked: Numbers, data: Bytes, start: Places) -> Mask:
    """Which answers that begin there repeat what they must of their requests' numbers."""
    found = np.ones(len(start), np.bool_)
    for part in layout.parts:
        if part.same and part.offset >= 0:
            value = asked.get(part.same, np.int64(-1))
            right = part_values(part, data, start, start) == part.repeating(value)
            found &= right & (value >= 0)
    return found


@lru_cache(maxsize=8)
def answer_tables(protocol: Protocol) -> AnswerTables:
    """The tables of a protocol, made when they are first asked for. Raises OverflowError."""
    return AnswerTables(protocol)
