"""Aligns two streams of exchanges by their frames, in memory that does not depend on their length.

Where frames differ, the fewest insertions and deletions after which 16 frames in a row are the same
again are looked for, by E. Myers' greedy algorithm (An O(ND) Difference Algorithm, 1986). If more
than 64 would be needed, the next 16 frames in a row that both streams have are taken, up to 20,000
frames ahead: so much may be missing at one place. Where there are none, all frames are told alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

from bilprov.analyzer.edit.exchanges import Exchange

RUN: Final = 16  # frames that are the same, after which two streams count as aligned
WINDOW: Final = 512  # exchanges of each stream that are looked at for few edits
FAR: Final = 20_000  # the same for many
_MOST = 64  # edits that are few

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
        steps = _edits(left.keys(WINDOW), right.keys(WINDOW))
        if steps is None:
            steps = _jump(left.keys(FAR), right.keys(FAR))
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
            self._held, self._at = list(islice(self._stream, WINDOW)), 0
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


class _Reached(NamedTuple):
    """How far a path comes on a diagonal: the edit it comes by, and the equal keys behind that.

    `came` is the diagonal before the edit; `begin` and `end` are places on the left.
    """

    came: int
    begin: int
    end: int


def _edits(left: Keys, right: Keys) -> list[Step] | None:
    """The steps with the fewest edits up to where the streams are aligned again; None for many."""
    rounds: list[dict[int, _Reached]] = []
    for edits in range(_MOST + 1):
        before = rounds[-1] if rounds else {}
        now: dict[int, _Reached] = {}
        rounds.append(now)
        for diagonal in range(-edits, edits + 1, 2):
            begin, came = (0, 0) if not edits else _furthest(before, diagonal, len(left))
            x = begin
            if not 0 <= x - diagonal <= len(right) or x < 0:
                continue
            most_x = min(len(left), len(right) + diagonal, begin + RUN)
            while x < most_x and left[x] == right[x - diagonal]:
                x += 1
            now[diagonal] = _Reached(came, begin, x)
            if x - begin == RUN or (x == len(left) and x - diagonal == len(right)):
                return _path(rounds, diagonal)
    return None


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


def _furthest(before: dict[int, _Reached], diagonal: int, most: int) -> tuple[int, int]:
    """The place that one more edit reaches on a diagonal, and the diagonal that it comes from.

    The place is below 0 if no edit leads there.
    """
    found = []
    if diagonal + 1 in before:
        found.append((before[diagonal + 1].end, diagonal + 1))
    if diagonal - 1 in before and before[diagonal - 1].end < most:
        found.append((before[diagonal - 1].end + 1, diagonal - 1))
    return max(found, default=(-1, 0))


def _path(rounds: list[dict[int, _Reached]], diagonal: int) -> list[Step]:
    """The steps of the path that has come to a diagonal in the last round."""
    steps: list[Step] = []
    for edits in range(len(rounds) - 1, -1, -1):
        came, begin, end = rounds[edits][diagonal]
        steps += [(True, True)] * (end - begin)
        if edits:
            steps.append((came < diagonal, came > diagonal))
        diagonal = came
    return steps[::-1]
