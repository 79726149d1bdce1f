"""The system under learning: gives the outputs of a device for sequences of inputs, by voting.

The line is homed before each sequence, which stands for a reset, and the settings are brought to
rest. What was not expected is asked for again until two tries agree, so that a byte lost or changed
on the line does not end up in the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from bilprov.analyzer.client.link import Link, drive
from bilprov.analyzer.client.operations import Procedure, listen, observe, send
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance.cases.steps import Step
from bilprov.conformance.learning.alphabet import reset
from bilprov.conformance.learning.comparison import Difference
from bilprov.conformance.learning.machine import Machine, Word
from bilprov.conformance.learning.output import Output, output_of
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.run import Run

MOST_FRAMES = 400_000
"""Inputs sent until a device counts as having too many states to learn."""
_TRIES = 6  # of a sequence, until two agree
_PAUSE = 2 * MS  # between two looks


class NotLearned(Exception):
    """The device cannot be learned; the message says why, in one sentence."""


@dataclass(slots=True)
class _Node:
    """What is known after a sequence of inputs: its last output, and what follows."""

    output: Output
    following: dict[int, _Node] = field(default_factory=dict)


class System:
    """A device as a function from sequences of inputs to outputs; known ones are not asked again.

    `reference` is the machine that is expected, `steps` are its inputs. `sent` is called with the
    number of inputs sent so far. `deviation` is the shortest difference from the reference that was
    seen twice, `flaky` counts the outcomes that were seen once and not again.
    """

    def __init__(
        self,
        run: Run,
        link: Link,
        interrupted: Callable[[], bool | str],
        steps: Sequence[Step],
        reference: Machine,
        sent: Callable[[int], None] = lambda frames: None,
    ) -> None:
        self._run = run
        self._link = link
        self._interrupted = interrupted
        self._steps = steps
        self._reference = reference
        self._told = sent
        # In real time a look takes as long as an answer that follows another at once.
        looks = run.config.observable and not run.config.virtual
        self._settle = 0 if looks else run.timers.settle
        self._root = _Node(Output(()))
        self.frames = self.sequences = self.repeated = self.flaky = 0
        self.deviation: Difference | None = None

    def outputs(self, word: Word) -> list[Output]:
        """The outputs of the device for a sequence of inputs.

        Raises NotLearned where its tries do not agree, or contradict what was seen before; Ended
        and GaveUp where link or device end the run.
        """
        known = self._known(word)
        if len(known) == len(word):
            return known
        due = self._reference.outputs(word)
        got = self._asked(word, known, due)
        node = self._root
        for letter, output in zip(word, got, strict=True):
            node = node.following.setdefault(letter, _Node(output))
        return got

    def _known(self, word: Word) -> list[Output]:
        """The outputs that are known already, of the first inputs of a sequence."""
        node, found = self._root, []
        for letter in word:
            following = node.following.get(letter)
            if following is None:
                break
            node = following
            found.append(node.output)
        return found

    def _asked(self, word: Word, known: list[Output], due: list[Output]) -> list[Output]:
        tries: list[list[Output]] = []
        # Behind a difference that is known nobody knows what to expect.
        in_step = _first_difference(due[: len(known)], known) is None
        later: list[Output | None] = [*due] if in_step else [None] * len(word)
        expectations = [*known, *later[len(known) :]]
        for _ in range(_TRIES):
            got = self._attempt(word, expectations)
            expected = got[: len(known)] == known and _first_difference(due, got) is None
            if expected or got in tries:
                break
            tries.append(got)
            self.repeated += 1
        else:
            self.flaky += len(tries)
            self._note(word, due, _seen_twice(due, tries))
            raise NotLearned(f"{_TRIES} tries of one sequence gave {_TRIES} different outcomes")
        self.flaky += sum(one != got for one in tries)
        self._note(word, due, got)
        if got[: len(known)] != known:
            self.flaky += 1  # what was known came once and not again
            raise NotLearned("the same sequence gave one outcome first and then, twice, another")
        return got

    def _note(self, word: Word, due: list[Output], got: list[Output]) -> None:
        """Keep the first difference of these outputs, if no shorter one is known."""
        place = _first_difference(due[: len(got)], got)
        if place is not None and (not self.deviation or place + 1 < len(self.deviation.word)):
            expected = due[place].beside(got[place])
            self.deviation = Difference(word[: place + 1], expected, got[place])

    def _attempt(self, word: Word, due: list[Output | None]) -> list[Output]:
        self.sequences += 1
        self.frames += len(word)
        self._told(self.frames)
        if self.frames > MOST_FRAMES:
            raise NotLearned(
                f"it is not learned after {MOST_FRAMES:,} frames: it has too many states"
            )
        return drive(self._sequence(word, due), self._link, self._interrupted)

    def _sequence(self, word: Word, due: list[Output | None]) -> Procedure[list[Output]]:
        run = self._run
        frames, answers, lost = reset(run.protocol), -1, 0
        for _ in range(_TRIES):
            yield from home(run)
            before, answers = answers, (yield from self._reset(frames))
            if answers in (len(frames), before):  # twice the same is the device's way, and no noise
                break
            lost += max(0, len(frames) - answers)
            run.waiting.require_budget()
        else:
            words = f"{quantity(answers, 'answer')} to {quantity(len(frames), 'setting')}"
            raise NotLearned(f"what comes before a sequence is refused: {words}")
        if answers == len(frames):
            run.strays.missing(lost)
        got: list[Output] = []
        last: Output | None = None
        in_step = True
        for letter, expected in zip(word, due, strict=True):
            expected = expected if in_step else None
            codes = yield from self._exchange(self._steps[letter], expected)
            last = yield from self._seen(codes, last, expected)
            effect = self._steps[letter].frame_effect
            if run.profile.stop_latency and (effect.effect is None or effect.stops):
                # A frame that comes before it has stopped may find it moving.
                late = yield from listen(None, 2 * run.profile.stop_latency)
                last = last._replace(codes=last.codes + late.codes)
            got.append(last)
            in_step = expected is not None and expected.fits(last)
        return got

    def _reset(self, frames: Sequence[bytes]) -> Procedure[int]:
        """Bring every variable of a homed robot to rest, see `reset`; returns the answers."""
        answers = 0
        for frame in frames:
            yield from send(frame)
            answers += len((yield from self._run.waiting.answers(1)).answers)
        return answers

    def _exchange(self, step: Step, expected: Output | None) -> Procedure[tuple[int, ...]]:
        """Send a frame and receive its answers, and those that follow them at once."""
        run = self._run
        sent = yield from send(step.frame)
        patience = run.waiting.usual
        if step.truncated:
            patience = run.waiting.silence + (0 if expected and not expected.codes else patience)
        heard = yield from listen(1, patience)
        if step.truncated:
            heard = yield from run.waiting.left_alone(heard, sent)
        # One that discards what follows a fault does so until the line is idle.
        idle = step.faulty and not run.keeps_all
        more = yield from listen(None, run.waiting.silence if idle else self._settle)
        return heard.codes + more.codes

    def _seen(
        self, codes: tuple[int, ...], before: Output | None, expected: Output | None
    ) -> Procedure[Output]:
        """Look at the robot; again while what is seen is not expected, for as long as a stop takes.

        Link and probe are two lines: a look right after an answer may be older than it. Where it is
        not known what to expect (None), only a look that shows the same as before is repeated.
        """
        run = self._run
        if not run.config.observable:
            return output_of(codes, None)
        patience = run.timers.grace if expected is None else run.timers.deadline
        start: int | None = None
        while True:
            seen = yield from observe()
            start = seen.asked if start is None else start
            output = output_of(codes, seen.look)
            if expected is None:
                settled = before is not None and output.look != before.look
            else:
                settled = expected.fits(output)
            done = settled or seen.now - start >= patience
            late = yield from listen(None, 0 if done else _PAUSE)
            codes += late.codes
            if done:
                return output._replace(codes=codes)


def _seen_twice(due: list[Output], tries: list[list[Output]]) -> list[Output]:
    """The outputs up to the first difference that two of the tries agree on, [] if none do."""
    places = ((_first_difference(due, got), got) for got in tries)
    heads = [got[: place + 1] for place, got in places if place is not None]
    return next((head for head in heads if heads.count(head) > 1), [])


def _first_difference(due: Sequence[Output], got: Sequence[Output]) -> int | None:
    """The index of the first output that is not as expected, None if there is none."""
    pairs = enumerate(zip(due, got, strict=True))
    return next((place for place, (wanted, given) in pairs if not wanted.fits(given)), None)
