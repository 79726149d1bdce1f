"""Learns a Mealy machine by queries: AALpy's KV algorithm, with an equivalence oracle of our own.

The algorithm of Kearns and Vazirani identifies the target of each transition by a classification
tree. Its hypothesis is compared with the machine that is expected, which gives the counterexamples:
where outputs differ, and where one state stands for several of the expected ones, the device is
asked who is right. What then is left is tried by seeded random sequences.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import chain
from typing import Any, Protocol

from bilprov.conformance.learning.comparison import (
    Difference,
    differences,
    distinguishing,
    joint_states,
)
from bilprov.conformance.learning.machine import Machine, Word, explored
from bilprov.conformance.learning.output import Output
from bilprov.spec.errors import UserError

WALKS, STRIDE = 200, 12
"""Random sequences that a final hypothesis must pass, and the number of inputs in each."""
MOST_DIFFERENCES = 12
"""Differences that are checked on the device."""


class NoAALpy(UserError):
    """AALpy is not installed. The message says how it comes."""


class Teacher(Protocol):
    """Whoever answers an output query."""

    def outputs(self, word: Word) -> list[Output]:
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

    `seed` makes the random sequences. `hypothesis` is called with the number of states of each
    hypothesis. Afterwards `differences` holds the differences that the teacher has confirmed, the
    shortest first, and `more` whether there are others beside them.
    """

    def __init__(
        self,
        teacher: Teacher,
        reference: Machine,
        *,
        seed: int = 1,
        hypothesis: Callable[[int], None] = lambda states: None,
    ) -> None:
        self._teacher = teacher
        self._reference = reference
        self._minimal = reference.minimal()
        self._apart = cache(partial(distinguishing, self._minimal))
        self._seed = seed
        self._told = hypothesis
        self._machine: Machine | None = None
        self.differences: list[Difference] = []
        self.more = False
        # What the library counts, and we do not read.
        self.num_queries = self.num_steps = self.num_cached_queries = 0

    def learn(self) -> Machine:
        """Learn the machine. Raises NoAALpy, and whatever the teacher raises."""
        run = require_aalpy()
        alphabet = list(self._reference.inputs)
        run(
            *(alphabet, self, self, "mealy"),
            cex_processing="rs",
            cache_and_non_det_check=False,
            print_level=0,
        )
        assert self._machine is not None
        return self._machine

    def query(self, word: Word) -> list[Output]:
        """Answer an output query of the algorithm."""
        return self._teacher.outputs(tuple(word))

    def find_cex(self, hypothesis: Any) -> Word | None:
        """A sequence for which the algorithm's hypothesis is wrong, None if none is found."""
        self._machine = machine = _machine_of(hypothesis, len(self._reference.inputs))
        self._told(len(machine.states))
        self.differences, self.more = [], False
        for difference in differences(self._reference, machine):
            if len(self.differences) == MOST_DIFFERENCES:
                self.more = True
                break
            wrong = self._wrong(machine, difference.word)
            if wrong:
                return wrong
            self.differences.append(difference)
        suspects = chain(self._several(machine), self._walks(machine))
        return next(filter(None, (self._wrong(machine, word) for word in suspects)), None)

    def _several(self, machine: Machine) -> Iterator[Word]:
        """Sequences that would tell the expected states apart which one state stands for."""
        first: dict[int, tuple[int, Word]] = {}
        for (due, given), word in joint_states(self._minimal, machine).items():
            other, access = first.setdefault(given, (due, word))
            if other != due:
                apart = self._apart(other, due)
                yield access + apart
                yield word + apart

    def _walks(self, machine: Machine) -> Iterator[Word]:
        draw = random.Random(f"walks {self._seed}")
        for _ in range(WALKS):
            yield tuple(draw.choices(machine.inputs, k=STRIDE))

    def _wrong(self, machine: Machine, word: Word) -> Word | None:
        """The sequence up to where the teacher's outputs are not the machine's, None if all are."""
        pairs = zip(machine.outputs(word), self._teacher.outputs(word), strict=True)
        place = next((i for i, (mine, theirs) in enumerate(pairs) if mine != theirs), None)
        return None if place is None else word[: place + 1]


def _machine_of(hypothesis: Any, inputs: int) -> Machine:
    """The library's machine as ours."""
    states = {state.state_id: state for state in hypothesis.states}

    def step(ident: str, letter: int) -> tuple[str, Output]:
        state = states[ident]
        return state.transitions[letter].state_id, state.output_fun[letter]

    return explored(hypothesis.initial_state.state_id, inputs, step)
