"""Learns a Mealy machine by queries: AALpy's KV algorithm, with an equivalence oracle of our own.

The algorithm of Kearns and Vazirani identifies the target of each transition by a classification
tree. Its hypothesis is compared with the machine that is expected, which gives the counterexamples:
where outputs differ, and where one state stands for several of the expected ones, the device is
asked who is right. What then is left is tried by seeded random sequences.

AALpy's own comparison (`bisimilar`) and its oracles know neither a facet that nobody sees nor what
is expected: they would ask a robot for hours what this asks in seconds.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple, Protocol

from bilprov.conformance.learning.output import Output
from bilprov.conformance.machines.mealy import Mealy, explore, minimal
from bilprov.conformance.machines.wp_method import Characterisation, state_cover
from bilprov.spec.errors import UserError

WALKS, STRIDE = 200, 12
"""Random sequences that a final hypothesis must pass, and the number of inputs in each."""
MOST_DIFFERENCES = 12
"""Differences that are checked on the device."""


class Difference(NamedTuple):
    """A sequence of inputs after whose last one the outputs differ for the first time."""

    word: bytes
    expected: Output
    actual: Output


class NoAALpy(UserError):
    """AALpy is not installed. The message says how it comes."""


class Teacher(Protocol):
    """Whoever answers an output query."""

    def outputs(self, word: bytes) -> tuple[Output, ...]:
        """The outputs for a sequence of inputs."""


def require_aalpy() -> Callable[..., Any]:
    """The learning algorithm. Raises NoAALpy, in one sentence, where the library is missing."""
    try:
        from aalpy.learning_algs import run_KV
    except ImportError as error:
        raise NoAALpy(
            "learn needs AALpy, which is not installed: pip install 'bilprov[learn]'"
        ) from error
    algorithm: Callable[..., Any] = run_KV
    return algorithm


class Learner:
    """Learns the machine of a teacher, and finds where it differs from `reference`.

    `seed` makes the random sequences. `states` is how many the last hypothesis has. Afterwards
    `differences` holds the differences that the teacher has confirmed, the shortest first, and
    `more` whether there are others beside them.
    """

    def __init__(self, teacher: Teacher, reference: Mealy[Output], *, seed: int = 1) -> None:
        self._teacher, self._reference = teacher, reference
        self._minimal = minimal(reference)
        self._apart = Characterisation(self._minimal)
        self._seed = seed
        self._machine = reference
        self.states = 0
        self.differences: list[Difference] = []
        self.more = False
        # What the library counts, and we do not read.
        self.num_queries = self.num_steps = self.num_cached_queries = 0

    def learn(self) -> Mealy[Output]:
        """Learn the machine. Raises NoAALpy, and whatever the teacher raises."""
        settings = {"cex_processing": "rs", "cache_and_non_det_check": False, "print_level": 0}
        require_aalpy()(list(self._reference.inputs), self, self, "mealy", **settings)
        return self._machine

    def query(self, word: tuple[int, ...]) -> list[Output]:
        """Answer an output query of the algorithm."""
        return list(self._teacher.outputs(bytes(word)))

    def find_cex(self, hypothesis: Any) -> bytes | None:
        """A sequence for which the algorithm's hypothesis is wrong, None if none is found."""
        self._machine = explore(
            hypothesis.initial_state,
            len(self._reference.inputs),
            lambda state, letter: (state.transitions[letter], state.output_fun[letter]),
        )
        self.states = len(self._machine)
        self.differences, self.more = [], False
        for difference in differences(self._reference, self._machine):
            if len(self.differences) == MOST_DIFFERENCES:
                self.more = True
                break
            wrong = self._wrong(difference.word)
            if wrong:
                return wrong
            self.differences.append(difference)
        return next(filter(None, map(self._wrong, chain(self._several(), self._walks()))), None)

    def _several(self) -> Iterator[bytes]:
        """Sequences that would tell the expected states apart which one state stands for."""
        first: dict[int, tuple[int, bytes]] = {}
        both = side_by_side(self._minimal, self._machine, past_differences=True)
        for word in state_cover(both):
            due = self._minimal.after(word)
            other, access = first.setdefault(self._machine.after(word), (due, word))
            if other != due:
                apart = self._apart.separating(other, due)
                yield access + apart
                yield word + apart

    def _walks(self) -> Iterator[bytes]:
        draw = random.Random(f"walks {self._seed}")
        for _ in range(WALKS):
            yield bytes(draw.choices(self._machine.inputs, k=STRIDE))

    def _wrong(self, word: bytes) -> bytes | None:
        """The sequence up to where the teacher's outputs are not the machine's, None if all are."""
        pairs = zip(self._machine.run(word), self._teacher.outputs(word), strict=True)
        place = next((i for i, (mine, theirs) in enumerate(pairs) if mine != theirs), None)
        return None if place is None else word[: place + 1]


def differences(reference: Mealy[Output], learned: Mealy[Output]) -> Iterator[Difference]:
    """Yield where the machines differ, the shortest sequences first.

    Behind a difference the search does not go on; the same input with the same two outputs is
    yielded once, at its shortest. What is expected has the facets that are seen.
    """
    both = side_by_side(reference, learned, past_differences=False)
    kinds: set[tuple[int, Output, Output]] = set()
    for word, outputs in zip(state_cover(both), both.outputs, strict=True):
        for letter, (due, given) in enumerate(outputs):
            expected = due.beside(given)
            if not due.fits(given) and (letter, expected, given) not in kinds:
                kinds.add((letter, expected, given))
                yield Difference(word + bytes([letter]), expected, given)


def side_by_side(
    one: Mealy[Output], other: Mealy[Output], *, past_differences: bool
) -> Mealy[tuple[Output, Output]]:
    """The machine of the pairs of states that both reach; its outputs are those of both.

    Unless `past_differences`, outputs that do not fit lead back to the first state.
    """

    def step(pair: tuple[int, int], letter: int) -> tuple[tuple[int, int], tuple[Output, Output]]:
        outputs = one.outputs[pair[0]][letter], other.outputs[pair[1]][letter]
        targets = one.targets[pair[0]][letter], other.targets[pair[1]][letter]
        follows = past_differences or outputs[0].fits(outputs[1])
        return (targets if follows else (0, 0)), outputs

    return explore((0, 0), len(one.inputs), step)
