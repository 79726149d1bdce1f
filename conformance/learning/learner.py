"""Learns a Mealy machine by queries: AALpy's KV algorithm, with an equivalence oracle of our own.

The algorithm of Kearns and Vazirani identifies the target of each transition by a classification
tree. Its hypothesis is compared with the machine that is expected, which gives the counterexamples:
where outputs differ, and where one state stands for several of the expected ones, the device is
asked who is right. What then is left is tried by seeded random sequences.

AALpy's own comparison (`bisimilar`) and its oracles know neither a facet that nobody sees nor what
is expected: they would ask a robot for hours what this asks in seconds.

The device answers by voting. The line is homed before each sequence, which stands for a reset, and
the settings are brought to rest. What was not expected is asked for again until two tries agree, so
that a byte lost or changed on the line does not end up in the machine.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from typing import Any, NamedTuple

from bilprov.analyzer.client.operations import Link, Procedure, drive, listen, observe, send
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance.cases.steps import Step
from bilprov.conformance.learning.reference import Output, output_of, reset
from bilprov.conformance.machines.wp_method import (
    Characterisation,
    Mealy,
    explore,
    minimal,
    state_cover,
)
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.run import Run
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


@dataclass(slots=True)
class Sent:
    """What learning has sent: inputs, sequences of them, and how many of these were sent again.

    `flaky` counts outcomes that came once and not again.
    """

    frames: int = 0
    sequences: int = 0
    repeated: int = 0
    flaky: int = 0


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

    def __init__(self, teacher: System, reference: Mealy[Output], *, seed: int = 1) -> None:
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


MOST_FRAMES = 400_000
"""Inputs sent until a device counts as having too many states to learn."""
_TRIES = 6  # of a sequence, until two agree
_PAUSE = 2 * MS  # between two looks
_Outputs = tuple[Output, ...]


class NotLearned(Exception):
    """The device cannot be learned; the message says why, in one sentence."""


@dataclass(slots=True)
class System:
    """A device as a function from sequences of inputs to outputs; known ones are not asked again.

    `reference` is the machine that is expected, `steps` are its inputs. `progress` is called with
    the number of inputs sent so far. `deviation` is the shortest difference from the reference that
    was seen twice.
    """

    run: Run
    link: Link
    interrupted: Callable[[], bool | str]
    steps: Sequence[Step]
    reference: Mealy[Output]
    sent: Sent = field(default_factory=Sent)
    progress: Callable[[int], None] = lambda frames: None
    deviation: Difference | None = None
    _known: dict[bytes, Output] = field(default_factory=dict)

    def outputs(self, word: bytes) -> _Outputs:
        """The outputs of the device for a sequence of inputs.

        Raises NotLearned where its tries do not agree, or contradict what was seen before; Ended
        and GaveUp where link or device end the run.
        """
        beginnings = [word[: end + 1] for end in range(len(word))]
        known = tuple(self._known[one] for one in beginnings if one in self._known)
        if len(known) < len(word):
            known = self._asked(word, known)
            self._known.update(zip(beginnings, known, strict=True))
        return known

    def _asked(self, word: bytes, known: _Outputs) -> _Outputs:
        due = self.reference.run(word)
        # Behind a difference that is known nobody knows what to expect.
        in_step = _first_difference(due, known) is None
        expected = (*known, *due[len(known) :]) if in_step else known
        tries: list[_Outputs] = []
        while (got := self._attempt(word, expected)) not in tries:
            if got[: len(known)] == known and _first_difference(due, got) is None:
                break
            tries.append(got)
            self.sent.repeated += 1
            if len(tries) == _TRIES:
                self.sent.flaky += _TRIES
                raise NotLearned(f"{_TRIES} tries of one sequence gave {_TRIES} different outcomes")
        self.sent.flaky += sum(one != got for one in tries)
        place = _first_difference(due, got)
        if place is not None and (not self.deviation or place + 1 < len(self.deviation.word)):
            expected_there = due[place].beside(got[place])
            self.deviation = Difference(word[: place + 1], expected_there, got[place])
        if got[: len(known)] != known:
            self.sent.flaky += 1  # what was known came once and not again
            raise NotLearned("the same sequence gave one outcome first and then, twice, another")
        return got

    def _attempt(self, word: bytes, expected: _Outputs) -> _Outputs:
        self.sent.sequences += 1
        self.sent.frames += len(word)
        self.progress(self.sent.frames)
        if self.sent.frames > MOST_FRAMES:
            raise NotLearned(
                f"it is not learned after {MOST_FRAMES:,} frames: it has too many states"
            )
        return drive(self._sequence(word, expected), self.link, self.interrupted)

    def _sequence(self, word: bytes, due: _Outputs) -> Procedure[_Outputs]:
        yield from self._begin()
        got: list[Output] = []
        in_step = True
        for letter, output in zip_longest(word, due):
            expected = output if in_step else None
            codes = yield from self._exchange(self.steps[letter], expected)
            got.append((yield from self._seen(codes, got[-1] if got else None, expected)))
            effect, late = self.steps[letter].frame_effect.effect, self.run.profile.stop_latency
            if late and self.run.protocol.stops(effect or self.run.protocol.on_fault):
                # A frame that comes before it has stopped may find it moving.
                heard = yield from listen(None, 2 * late)
                got[-1] = got[-1]._replace(codes=got[-1].codes + heard.codes)
            in_step = expected is not None and expected.fits(got[-1])
        return tuple(got)

    def _begin(self) -> Procedure[None]:
        """Home the robot and bring every variable to rest, see `reset`."""
        run, frames = self.run, reset(self.run.protocol)
        answers, lost = -1, 0
        for _ in range(_TRIES):
            yield from home(run)
            before, answers = answers, 0
            for frame in frames:
                yield from send(frame)
                answers += len((yield from run.waiting.answers(1)).answers)
            if answers in (len(frames), before):  # twice the same is the device's way, and no noise
                break
            lost += max(0, len(frames) - answers)
            run.waiting.require_budget()
        else:
            words = f"{quantity(answers, 'answer')} to {quantity(len(frames), 'setting')}"
            raise NotLearned(f"what comes before a sequence is refused: {words}")
        if answers == len(frames):
            run.strays.missing(lost)

    def _exchange(self, step: Step, expected: Output | None) -> Procedure[tuple[int, ...]]:
        """Send a frame and receive its answers, and those that follow them at once."""
        run = self.run
        sent = yield from send(step.frame)
        patience = run.waiting.usual
        if step.truncated:
            patience = run.waiting.silence + (0 if expected and not expected.codes else patience)
        heard = yield from listen(1, patience)
        if step.truncated:
            heard = yield from run.waiting.left_alone(heard, sent)
        # In real time a look takes as long as an answer that follows another at once.
        looks = run.config.observable and not run.config.virtual
        settle = 0 if looks else run.timers.settle
        # One that discards what follows a fault does so until the line is idle.
        idle = step.faulty and not run.keeps_all
        more = yield from listen(None, run.waiting.silence if idle else settle)
        return heard.codes + more.codes

    def _seen(
        self, codes: tuple[int, ...], before: Output | None, expected: Output | None
    ) -> Procedure[Output]:
        """Look at the robot; again while what is seen is not expected, for as long as a stop takes.

        Link and probe are two lines: a look right after an answer may be older than it. Where it is
        not known what to expect (None), only a look that shows the same as before is repeated.
        """
        run = self.run
        if not run.config.observable:
            return output_of(run.protocol, codes, None)
        patience = run.timers.grace if expected is None else run.timers.deadline
        start: int | None = None
        while True:
            seen = yield from observe()
            start = seen.asked if start is None else start
            output = output_of(run.protocol, codes, seen.look)
            if expected is None:
                settled = before is not None and output[1:] != before[1:]
            else:
                settled = expected.fits(output)
            done = settled or seen.now - start >= patience
            late = yield from listen(None, 0 if done else _PAUSE)
            codes += late.codes
            if done:
                return output._replace(codes=codes)


def _first_difference(due: _Outputs, got: _Outputs) -> int | None:
    """The index of the first output that is not as expected, None if there is none."""
    pairs = enumerate(zip(due, got, strict=False))
    return next((place for place, (wanted, given) in pairs if not wanted.fits(given)), None)
