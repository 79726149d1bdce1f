"""Runs two machines side by side: where they differ, and which states correspond."""

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
    does not go on; the same input with the same two outputs is told once, at its shortest. What
    is expected has the facets that are seen.
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
                expected = due.output.beside(given.output)
                kind = (letter, expected, given.output)
                if kind not in told:
                    told.add(kind)
                    yield Difference(word, expected, given.output)
                continue
            following = (due.target, given.target)
            if following not in words:
                words[following] = word
                queue.append(following)


def joint_states(one: Machine, other: Machine) -> dict[tuple[int, int], Word]:
    """A shortest sequence to each pair of states that both machines reach, whatever they put out.

    The pairs come in the order of the lengths.
    """
    words: dict[tuple[int, int], Word] = {(0, 0): ()}
    queue = deque(words)
    while queue:
        first, second = pair = queue.popleft()
        for letter in one.inputs:
            following = one.states[first][letter].target, other.states[second][letter].target
            if following not in words:
                words[following] = (*words[pair], letter)
                queue.append(following)
    return words


def distinguishing(machine: Machine, one: int, other: int) -> Word:
    """A shortest sequence for which two states have different outputs, () if there is none."""
    words: dict[tuple[int, int], Word] = {(one, other): ()}
    queue = deque(words)
    while queue:
        first, second = pair = queue.popleft()
        for letter in machine.inputs:
            mine, theirs = machine.states[first][letter], machine.states[second][letter]
            word = (*words[pair], letter)
            if mine.output != theirs.output:
                return word
            following = mine.target, theirs.target
            if following not in words:
                words[following] = word
                queue.append(following)
    return ()
