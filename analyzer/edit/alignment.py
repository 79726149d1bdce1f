"""Aligns two streams of exchanges by their frames, in memory that does not depend on their length.

Where frames differ, the fewest insertions and deletions after which 16 frames in a row are the same
again are looked for, by E. Myers' greedy algorithm (An O(ND) Difference Algorithm, 1986). If there
are none within a limit, what reaches furthest is taken, and the search goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

from bilprov.analyzer.edit.exchanges import Exchange

RUN: Final = 16  # frames that are the same, after which two streams count as aligned
WINDOW: Final = 1024  # exchanges of each stream that are looked at
_FEWEST, _MOST = 32, 256  # edits that are looked for; the less the more often in vain

Keys = Sequence[tuple[str, bytes]]
Pair = tuple[Exchange | None, Exchange | None]


def aligned(first: Iterator[Exchange], second: Iterator[Exchange]) -> Iterator[Pair]:
    """Yield all exchanges of both in order: pairs with the same frame, or one alone."""
    left, right = _Ahead(first), _Ahead(second)
    most = _MOST
    while True:
        one, other = left.next(), right.next()
        if one is None or other is None:
            break
        if one.key == other.key:
            yield left.taken(), right.taken()
            continue
        found, steps = _edits(left.window(), right.window(), most)
        most = min(_MOST, 2 * most) if found else max(_FEWEST, most // 2)
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

    def window(self) -> Keys:
        """The keys of the next exchanges."""
        del self._held[: self._at]
        self._at = 0
        self._held += islice(self._stream, WINDOW - len(self._held))
        return [one.key for one in self._held]


class _Reached(NamedTuple):
    """How far a path comes on a diagonal: the edit it comes by, and the equal keys behind that.

    `came` is the diagonal before the edit; `begin` and `end` are places on the left.
    """

    came: int
    begin: int
    end: int


def _edits(left: Keys, right: Keys, most: int) -> tuple[bool, list[tuple[bool, bool]]]:
    """The fewest edits up to where the streams are aligned again, and whether there are any.

    Each step says whether it takes from the left and from the right.
    """
    rounds: list[dict[int, _Reached]] = []
    best = (0, 0, 0)  # keys that are passed, with how many edits, on which diagonal
    for edits in range(most + 1):
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
                return True, _path(rounds, diagonal)
            best = max(best, (2 * x - diagonal, edits, diagonal))
    _, edits, diagonal = best
    return False, _path(rounds[: edits + 1], diagonal)


def _furthest(before: dict[int, _Reached], diagonal: int, most: int) -> tuple[int, int]:
    """Where one more edit leads on a diagonal, from which other one; below 0 for nowhere."""
    found = []
    if diagonal + 1 in before:
        found.append((before[diagonal + 1].end, diagonal + 1))
    if diagonal - 1 in before and before[diagonal - 1].end < most:
        found.append((before[diagonal - 1].end + 1, diagonal - 1))
    return max(found, default=(-1, 0))


def _path(rounds: list[dict[int, _Reached]], diagonal: int) -> list[tuple[bool, bool]]:
    """The steps of the path that has come to a diagonal in the last round."""
    steps: list[tuple[bool, bool]] = []
    for edits in range(len(rounds) - 1, -1, -1):
        came, begin, end = rounds[edits][diagonal]
        steps += [(True, True)] * (end - begin)
        if edits:
            steps.append((came < diagonal, came > diagonal))
        diagonal = came
    return steps[::-1]
