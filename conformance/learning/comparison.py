"""Finds the shortest sequences of inputs at which two machines differ."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from bilprov.conformance.learning.machine import Machine, Word
from bilprov.conformance.learning.output import Output


class Difference(NamedTuple):
    """A sequence of inputs after whose last one the outputs differ for the first time."""

    word: Word
    expected: Output
    actual: Output


def differences(reference: Machine, learned: Machine) -> Iterator[Difference]:
    """Yield where the machines differ, the shortest sequences first.

    Both run side by side, breadth first over their joint states. Behind a difference the search
    does not go on; the same input with the same two outputs is told once, at its shortest.
    """
    start = (0, 0)
    words: dict[tuple[int, int], Word] = {start: ()}
    told: set[tuple[int, Output, Output]] = set()
    queue = deque([start])
    while queue:
        pair = queue.popleft()
        rows = zip(reference.states[pair[0]], learned.states[pair[1]], strict=True)
        for letter, (due, given) in enumerate(rows):
            word = (*words[pair], letter)
            if not due.output.fits(given.output):
                kind = (letter, due.output, given.output)
                if kind not in told:
                    told.add(kind)
                    yield Difference(word, due.output, given.output)
                continue
            following = (due.target, given.target)
            if following not in words:
                words[following] = word
                queue.append(following)
