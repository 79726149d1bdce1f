"""Aligns two streams of exchanges by their frames, in memory that does not depend on their length.

Where frames differ, difflib looks for insertions and deletions after which 16 frames in a row are
the same again, among the next 64 frames and then among 512. Where there are none, the next 16
frames in a row that both streams have are taken, up to 20,000 frames ahead: so much may be missing
at one place. Where there are none either, all frames are listed alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher
from itertools import islice
from typing import Final

from bilprov.analyzer.edit.exchanges import Exchange

RUN: Final = 16  # frames that are the same, after which two streams count as aligned
WINDOWS: Final = (64, 512)  # exchanges of each stream that are looked at for few edits
FAR: Final = 20_000  # the same for many
_AT_ONCE: Final = 512  # exchanges that are read

Keys = Sequence[tuple[str, bytes]]
Step = tuple[bool, bool]
"""Whether an exchange is taken from the left, and whether one is from the right."""

Pair = tuple[Exchange | None, Exchange | None]


def aligned(first: Iterator[Exchange], second: Iterator[Exchange]) -> Iterator[Pair]:
    """Yield all exchanges of both in order: pairs with the same frame, or one alone."""
    left, right = _Ahead(first), _Ahead(second)
    while True:
        one, other = left.next(), right.next()
        if one is None or other is None:
            break
        if one.key == other.key:
            yield left.taken(), right.taken()
            continue
        edits = (_edits(left.keys(few), right.keys(few), few) for few in WINDOWS)
        steps = next(filter(None, edits), None) or _jump(left.keys(FAR), right.keys(FAR))
        for to_left, to_right in steps:
            yield left.taken() if to_left else None, right.taken() if to_right else None
    while left.next() is not None:
        yield left.taken(), None
    while right.next() is not None:
        yield None, right.taken()


class _Ahead:
    """A stream of which some of what comes next can be looked at."""

    def __init__(self, stream: Iterator[Exchange]) -> None:
        self._stream = stream
        self._held: list[Exchange] = []
        self._at = 0

    def next(self) -> Exchange | None:
        """What `taken` gives next, None at the end."""
        if self._at == len(self._held):
            self._held, self._at = list(islice(self._stream, _AT_ONCE)), 0
        return self._held[self._at] if self._held else None

    def taken(self) -> Exchange:
        """The next exchange, which is gone from the stream then."""
        self._at += 1
        return self._held[self._at - 1]

    def keys(self, count: int) -> Keys:
        """The keys of so many next exchanges, of fewer at the end."""
        del self._held[: self._at]
        self._at = 0
        self._held += islice(self._stream, max(0, count - len(self._held)))
        return [one.key for one in self._held[:count]]


def _edits(left: Keys, right: Keys, window: int) -> list[Step] | None:
    """The steps up to where the streams are aligned again; None where they are not in the window.

    A stream with fewer keys than the window ends with them.
    """
    steps: list[Step] = []
    matcher = SequenceMatcher(None, left, right, autojunk=False)
    for _, begin, end, first, last in matcher.get_opcodes():
        if left[begin:end] == right[first:last]:
            steps += [(True, True)] * (end - begin)
            if end - begin >= RUN:
                return steps
        else:
            steps += [(True, False)] * (end - begin) + [(False, True)] * (last - first)
    return steps if max(len(left), len(right)) < window else None


def _jump(left: Keys, right: Keys) -> list[Step]:
    """The steps to the next run that both streams have; half of all steps where there is none."""
    places: dict[tuple[tuple[str, bytes], ...], int] = {}
    for x in range(len(left) - RUN + 1):
        places.setdefault(tuple(left[x : x + RUN]), x)
    best: tuple[int, int] | None = None
    for y in range(len(right) - RUN + 1):
        if best and y >= sum(best):
            break
        found = places.get(tuple(right[y : y + RUN]))
        if found is not None and (best is None or found + y < sum(best)):
            best = found, y
    to_left, to_right = best or ((len(left) + 1) // 2, (len(right) + 1) // 2)
    return [(True, False)] * to_left + [(False, True)] * to_right
