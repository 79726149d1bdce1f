"""Cuts and reads the answers in a buffer in arrays: each is the usual one to its request.

An answer in the layout of errors is not: what it is depends on all the ways to answer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.spec.arrays.checks import Checking
from bilprov.spec.arrays.layouts import (
    OUTCOMES,
    Bytes,
    Mask,
    Places,
    Requests,
    Told,
    checks_hold,
    constants_hold,
    data_sizes,
    part_values,
    require_narrow,
    size_by_byte,
    sizes_by_request,
)
from bilprov.spec.arrays.requests import RequestTables
from bilprov.spec.codec import judge
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import Way, asked_values, meaning, reply_size, usual_way

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


class CutAnswers(NamedTuple):
    """The answers in a buffer up to byte `end`.

    With `regular` what follows is the beginning of an answer, or waits for its request; without it,
    it is an answer that is damaged, or in the layout of errors.
    """

    answers: Answers
    end: int
    regular: bool


class _Pairs(NamedTuple):
    """Requests in `asked`, and their answers: from `start` to `end` in `data`, with a `code`."""

    asked: Bytes
    requests: Requests
    data: Bytes
    start: Places
    end: Places
    code: Places

    def rows(self, rows: slice | Places) -> _Pairs:
        """Some of the rows."""
        answers = self.start[rows], self.end[rows], self.code[rows]
        return _Pairs(self.asked, self.requests.rows(rows), self.data, *answers)


class AnswerTables:
    """Cuts answers and reads them. Raises OverflowError for what does not fit into 64 bits."""

    def __init__(self, protocol: Protocol, tables: RequestTables) -> None:
        self._protocol = protocol
        self._tables = tables
        self._ways = [usual_way(protocol, spec) for spec in protocol.instructions]
        self._told = [size_by_byte(way.layout, way.data) for way in self._ways]
        self._layouts: list[tuple[Layout, Mask]] = []
        for layout in (protocol.reply, protocol.acknowledgement):
            require_narrow(layout)
            code = layout.part("code")
            if code is not None and (code.size > 1 or code.number.signed):
                raise OverflowError("the code of an answer is more than one byte")
            with_it = np.array([way.layout is layout for way in self._ways], np.bool_)
            if all(layout is not other for other, _ in self._layouts):
                self._layouts.append((layout, with_it))
        told = [meaning(protocol, code) for code in (*range(NO_CODE), None)]
        # By code, and by NO_CODE: the response, the name, and the code that a record has.
        self.responses = known = [response for _, response in told]
        self.names = [
            " ".join(names) or (response.name if response else None) for names, response in told
        ]
        self.bytes = np.array([one.code if one else at for at, one in enumerate(known)], np.int64)
        self._expected = np.array(
            [max(0, protocol.answers[outcome].code) for outcome in OUTCOMES], np.uint8
        )
        self._known = np.array([one is not None for one in known], np.bool_)
        # Codes with which the answer may lack its data.
        self._fails = np.array(
            [one is not None and Outcome.VALID not in one.outcomes for one in known], np.bool_
        )

    def cut(self, asked: Bytes, requests: Requests, data: Bytes, reads: Places) -> CutAnswers:
        """The answers in `data` to the requests of `asked`, as far as they are right.

        `reads` are where the reads end in which the bytes came: mostly, each is one answer.
        """
        if self._protocol.plain:  # each byte is an answer, right or not
            count = min(len(data), len(requests.kind))
            size = np.broadcast_to(np.int64(1), count)
            return CutAnswers(Answers(np.arange(count), size, data[:count]), count, regular=True)
        raw = data.tobytes()
        sizes = self._sizes(asked, requests)
        bounds = self._whole_reads(data, sizes, requests.kind, reads)
        walked = self._walk(raw, int(bounds[-1]), len(bounds) - 1, sizes, asked, requests)
        bounds = np.concatenate([bounds[:-1], walked])
        offset, end = bounds[:-1], int(bounds[-1])
        size = np.diff(bounds)
        given = requests.rows(slice(len(offset)))
        code = np.full(len(offset), NO_CODE)
        good = self._right(_Pairs(asked, given, data, offset, offset + size, code))
        rows = len(good) if good.all() else int(np.argmin(good))
        regular = rows == len(good)
        if regular and end < len(raw) and rows < len(requests.offset):
            regular = self._is_open(raw[end:], self._request(asked, requests, rows))
        found = Answers(offset[:rows], size[:rows], code[:rows])
        return CutAnswers(found, int(found.end[-1]) if rows else 0, regular)

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
        around = np.array([(way.layout.head, way.layout.tail) for way in self._ways], np.int64)
        least = [way.data.length if way.data and way.data.fields else -1 for way in self._ways]
        head, tail = around.take(kind, axis=0).T
        size = answers.size - head - tail
        needed = np.array(least, np.int64).take(kind)
        by_request = [bool(way.data and _by_request(way.data)) for way in self._ways]
        refused = self._fails.take(answers.code) & (size == 0)
        lacking = refused & np.array(by_request, np.bool_).take(kind)
        there = (needed >= 0) & (size >= needed) & ~lacking
        return answers.offset + head, np.where(there, size, -1)

    def addresses(self, kind: Places, data: Bytes, answers: Answers) -> Places:
        """Whose the answers in `data` to requests of these kinds are; -1 where they do not say."""
        found = np.full(len(kind), -1, np.int64)
        for layout, kinds in self._layouts:
            part = layout.part("address")
            if part is not None:
                rows = np.flatnonzero(kinds.take(kind))
                found[rows] = part_values(part, data, answers.offset[rows], answers.end[rows])
        return found

    @staticmethod
    def _request(asked: Bytes, requests: Requests, row: int) -> bytes:
        start = int(requests.offset[row])
        return asked[start : start + int(requests.size[row])].tobytes()

    def _is_open(self, rest: bytes, request: bytes) -> bool:
        """Whether bytes are the beginning of an answer to a request that is not complete."""
        size = reply_size(self._protocol, rest, judge(self._protocol, request))
        return size is None or size > len(rest)

    def _sizes(self, asked: Bytes, requests: Requests) -> Places:
        """The size of the answer to each request; 0 where the answer itself tells it."""
        fixed = [told if isinstance(told, int) else 0 for told in self._told]
        sizes = np.array(fixed, np.int64).take(requests.kind)
        for kind, (way, told) in enumerate(zip(self._ways, self._told, strict=True)):
            if told is not None or way.data is None or way.layout.part("length") is not None:
                continue
            rows = np.flatnonzero(requests.kind == kind)
            if len(rows):
                numbers = self._tables.numbers(asked, requests.rows(rows), kind)
                found = sizes_by_request(way.data, numbers, len(rows))
                if found is not None:
                    sizes[rows] = way.layout.head + found + way.layout.tail
        return sizes

    def _whole_reads(self, data: Bytes, sizes: Places, kind: Places, reads: Places) -> Places:
        """Where the answers begin of which each is one read, and where the next one begins."""
        bounds = np.append(0, reads[: len(kind)])
        offset, size = bounds[:-1], sizes[: len(bounds) - 1].copy()
        for told in {told for told in self._told if isinstance(told, Told)}:
            of_it = np.array([one == told for one in self._told], np.bool_)
            rows = np.flatnonzero(of_it.take(kind[: len(size)]))
            size[rows] = told.at(data, offset[rows])
        whole = size == np.diff(bounds)
        return bounds[: 1 + (len(whole) if whole.all() else int(np.argmin(whole)))]

    def _walk(
        self, data: bytes, at: int, first: int, sizes: Places, asked: Bytes, requests: Requests
    ) -> list[int]:
        """Where the answers from `at` on begin that are whole, and where the next one begins.

        The one at `at` is to the request of row `first`.
        """
        walked, last = [at], len(data)
        kinds = requests.kind[first:].tolist() if at < last else []
        rows = zip(sizes[first:].tolist(), kinds, strict=False)
        for row, (size, kind) in enumerate(rows, first):
            told = self._told[kind]
            if not size:
                if isinstance(told, Told):
                    place = at + told.place
                    size = told.sizes[data[place]] if place < last else 0
                else:
                    request, way = self._request(asked, requests, row), self._ways[kind]
                    least = way.layout.head + (way.data.length if way.data else 0)
                    size = self._size(data[at : at + least], way, request)
            at += size
            if not size or at > last:
                return walked
            walked.append(at)
        return walked

    def _size(self, begun: bytes, way: Way, request: bytes) -> int:
        """The size of the answer that begins so; 0 if it is not known yet, or none."""
        values = asked_values(self._protocol, judge(self._protocol, request))
        return max(0, way.layout.size(begun, way.data, values) or 0)

    def _right(self, pairs: _Pairs) -> Mask:
        """Which answers are right; writes the codes of those that have one."""
        good = np.ones(len(pairs.start), np.bool_)
        for layout, kinds in self._layouts:
            mask = kinds.take(pairs.requests.kind)
            rows: slice | Places = slice(None) if mask.all() else np.flatnonzero(mask)
            these = pairs.rows(rows)
            where = these.data, these.start, these.end
            right = constants_hold(layout, *where)
            right &= checks_hold(layout, *where, self._counted(layout, these))
            part = layout.part("code")
            if part is not None:
                code = part_values(part, *where)
                pairs.code[rows] = code
                right &= self._known.take(code)
            good[rows] = right
        for kind, way in enumerate(self._ways):
            rows = np.flatnonzero(good & (pairs.requests.kind == kind))
            if len(rows):
                these = pairs.rows(rows)
                good[rows] = self._repeats(way.layout, these, kind) & self._whole(way, these, kind)
        return good

    def _counted(self, layout: Layout, pairs: _Pairs) -> Checking | None:
        """The check of what it covers of the requests, where it does."""
        if layout.check is None or not layout.check.asked:
            return None
        checking = Checking(layout.check.function, len(pairs.start))
        check = self._protocol.layout.check
        first, last = (check.first, check.last) if check else (0, 0)
        checking.take(pairs.asked, pairs.requests.offset + first, pairs.requests.end - last)
        return checking

    def _repeats(self, layout: Layout, pairs: _Pairs, kind: int) -> Mask:
        """Which answers to requests of one kind repeat what they must of them."""
        found = np.ones(len(pairs.start), np.bool_)
        parts = [part for part in layout.parts if part.same and part.offset >= 0]
        numbers = self._tables.numbers(pairs.asked, pairs.requests, kind) if parts else {}
        for part in parts:
            expected = numbers.get(part.same, np.int64(-1)) + part.plus
            found &= part_values(part, pairs.data, pairs.start, pairs.start) == expected
        return found

    def _whole(self, way: Way, pairs: _Pairs, kind: int) -> Mask:
        """Which answers to requests of one kind have all their data, or fail without any."""
        layout, spec = way.layout, way.data
        if not layout.has_data or spec is None or layout.part("length") is None:
            return np.ones(len(pairs.start), np.bool_)  # their size is made of their data
        size = pairs.end - pairs.start - layout.head - layout.tail
        good = size >= spec.length
        many = spec.counted
        if many is None or many.how != "rest":
            rows = np.flatnonzero(good)
            these = pairs.rows(rows)
            numbers = self._tables.numbers(these.asked, these.requests, kind)
            needed = sizes_by_request(spec, numbers, len(rows))
            if needed is None:
                at = these.start + layout.head
                needed = data_sizes(
                    spec, these.data, at, lambda row: self._measured(way, these, row)
                )
            good[rows] = size[rows] == needed
        refused: Mask = (size == 0) & self._fails.take(pairs.code)
        return good | refused

    def _measured(self, way: Way, pairs: _Pairs, row: int) -> int:
        """How many bytes the data of one answer must have."""
        assert way.data is not None
        judged = judge(self._protocol, self._request(pairs.asked, pairs.requests, row))
        at = pairs.start[row] + way.layout.head
        begun = pairs.data[at : at + way.data.length].tobytes()
        return way.data.measure(begun, asked_values(self._protocol, judged)) or 0


def _by_request(spec: DataSpec) -> bool:
    """Whether the request tells how many data an answer has."""
    return spec.counted is not None and spec.counted.how == "expression"
