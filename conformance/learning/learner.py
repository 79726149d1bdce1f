"""Learns a device as a Mealy machine, and finds where it differs from the machine of the Protocol.

AALpy's KV algorithm, of Kearns and Vazirani, asks for the outputs of sequences of inputs. Its
hypothesis is compared with the machine that is expected, which gives the counterexamples: where
outputs differ, and where one state stands for several of the expected ones, the device is asked who
is right. What then is left is tried by seeded random sequences. AALpy's own comparison knows
neither a facet that nobody sees nor what is expected: it would ask a robot for hours what this asks
in seconds.

Before each sequence, which stands for a reset, the line is homed and the settings are brought to
rest. What was not expected is asked for again until two tries agree, so that a byte lost or changed
on the line does not end up in the machine.
"""

from __future__ import annotations

import random
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain, islice, zip_longest
from typing import Any, NamedTuple

from bilprov.analyzer.client.operations import (
    Link,
    LinkListener,
    Procedure,
    drive,
    listen,
    observe,
    send,
)
from bilprov.captures.schemas import MS, Look, look_class
from bilprov.conformance.api import run_suite
from bilprov.conformance.cases.levels import Options
from bilprov.conformance.cases.steps import Step, fill, framed, frames_of, open_frames, step_of
from bilprov.conformance.dut.target import Target
from bilprov.conformance.machines.wp_method import Mealy, explore, state_cover
from bilprov.conformance.oracle.judge import answer_words
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.conformance.oracle.verdicts import Verdict, exit_code
from bilprov.conformance.report.run_report import Report, send_words
from bilprov.conformance.runner.homing import home, set_up
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.by_effect import frames_to
from bilprov.spec.codec import bad_data, judge, spaced
from bilprov.spec.errors import UserError
from bilprov.spec.motion import Wheels, visible_motion
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State

# -- the machine of the Protocol over the inputs of learning --------------------------------------
# Inputs are every instruction with representative data and every kind of fault. An output of a
# device after one input is its answers, and what the probe then sees.


@lru_cache(maxsize=1 << 3)
def alphabet(protocol: Protocol) -> tuple[Step, ...]:
    """Every input that is learned, each frame once; a machine's inputs are their indices.

    An instruction with data comes with its first and its last, bits with names with the last but
    one; bad data are the first and the last out of range. Each instruction is also sent with a data
    byte too many and one too few. A truncated frame is a header without its data, followed by the
    time-out.
    """
    steps = [step for spec in protocol.instructions for step in _ends(protocol, spec)]
    for turn, spec in enumerate(protocol.instructions):
        for length in (spec.length - 1, spec.length + 1):
            if length in protocol.data_lengths:
                steps.append(framed(protocol, spec.id, length, fill(protocol, length, turn)))
        bad = list(bad_data(spec))
        steps += (framed(protocol, spec.id, spec.length, d) for d in (*bad[:1], *bad[-1:]))
    for turn, identity in enumerate((*protocol.unused_ids[:1], *protocol.unused_ids[-1:])):
        steps.append(framed(protocol, identity, turn, fill(protocol, turn, 1)))
    steps += open_frames(protocol).values()
    return tuple({step.frame: step for step in steps}.values())


def _ends(protocol: Protocol, spec: InstructionSpec) -> Iterator[Step]:
    """The instruction with its first and its last data."""
    steps = list(frames_of(protocol, spec.name))
    # Of bits with names not all are set: their order shows, and a bit that is stuck.
    bits = any(part.bits for part in spec.fields) and len(steps) > 2
    yield from (steps[0], steps[-2 if bits else -1])


def name_of(protocol: Protocol, step: Step) -> str:
    """An input in words: `Speed speed=255`, `unused 9, 2 data bytes (92 00 00)`."""
    words = judge(protocol, step.frame).describe()
    return f"{words} ({spaced(step.frame)})" if step.faulty and len(step.frame) > 1 else words


def item_of(protocol: Protocol, frame: bytes) -> str:
    """A frame as `bilprov send` takes it: an instruction with its values, else hex."""
    judged = judge(protocol, frame)
    if not judged.valid:
        return frame.hex()
    return " ".join((judged.name, *(str(value) for _, value in judged.fields)))


def rest_of(protocol: Protocol) -> State:
    """The state in which a sequence of inputs begins: stopped, each variable nearest to zero."""
    rest = {name: max(low, min(0, high)) for name, (low, high) in protocol.limits.items()}
    return protocol.state(**{protocol.car.by: protocol.car.still}, **rest)


def reset(protocol: Protocol) -> tuple[bytes, ...]:
    """The frames before each sequence of inputs. Homing keeps what a stop keeps."""
    return frames_to(protocol, rest_of(protocol))


FACETS = ("moving", "motion", "ahead", "lights")
"""What a look can show, each a facet of an output."""


def facet_words(protocol: Protocol, facet: str) -> str:
    """What a facet tells, in words."""
    known = {"moving": "whether it moves", "motion": "its motion", "ahead": "its wheels"}
    return known.get(facet, " and ".join(protocol.lights))


class Output(NamedTuple):
    """Answer codes, and the facets of a look; None is what is not seen or, if expected, not known.

    `motion` is the kind of motion, `ahead` the wheel that turns faster in a drive (`left`, `right`,
    or `alike`): no mixing law is given, so speeds count by sign and order only. `lights` are the
    values that do not change how it drives, by name.
    """

    codes: tuple[int, ...]
    moving: bool | None = None
    motion: str | None = None
    ahead: str | None = None
    lights: tuple[tuple[str, int], ...] | None = None

    def fits(self, other: Output) -> bool:
        """Whether both are equal in their answers and in every facet that both have."""
        return self == other or self.beside(other) == other.beside(self)

    def beside(self, other: Output) -> Output:
        """This output with only those facets that the other has too."""
        return self.without(name for name in FACETS if getattr(other, name) is None)

    def without(self, facets: Iterable[str]) -> Output:
        """This output with these facets not seen."""
        return self._replace(**dict.fromkeys(facets))  # type: ignore[arg-type]  # each may be None

    @property
    def motion_words(self) -> str:
        """The kind of motion, else whether it moves: `forward`, `moving`; "" where not seen."""
        if self.motion or self.moving is None:
            return self.motion or ""
        return "moving" if self.moving else "stopped"

    @property
    def look_words(self) -> str:
        """The look in few words: `forward, left wheel ahead, led 7`; "" where nothing is seen."""
        ahead = f"{self.ahead} wheel ahead" if self.ahead in ("left", "right") else ""
        lights = (f"{name} {value}" for name, value in self.lights or ())
        return ", ".join(filter(None, (self.motion_words, ahead, *lights)))

    def words(self, protocol: Protocol) -> str:
        """The whole output in words: `00 OK; forward, led 0`."""
        return "; ".join(filter(None, (answer_words(protocol, self.codes), self.look_words)))


def output_of(protocol: Protocol, codes: tuple[int, ...], look: Look | None) -> Output:
    """The output for these answers and this look; None where the robot was not looked at."""
    if look is None:
        return Output(codes)
    # A probe may name the direction that is set although speed 0 keeps the wheels still.
    car = protocol.car
    motion, ahead = car.drive(look).motion, None
    if look.moving is False and motion is not None:
        motion = car.still
    if look.left is not None and look.right is not None:
        turning, ahead = _turning(car, look.left, look.right)
        motion = turning if motion in (None, turning) else f"{motion}, by its wheels {turning}"
    lights = ((name, getattr(look, name)) for name in protocol.lights)
    shown = tuple((name, value) for name, value in lights if value is not None)
    return Output(codes, look.moving, motion, ahead, shown or None)


def _turning(car: Wheels, left: int, right: int) -> tuple[str, str | None]:
    """The kind of motion that the wheels' speeds show, and in a drive the wheel that is ahead."""
    motions = {both: motion for motion, both in car.turns.items()}
    slow, fast = sorted((abs(left), abs(right)))
    if not fast:
        return car.still, None
    turning, onward = (_sign(left), _sign(right)), (_sign(left + right),) * 2
    if left * right < 0 and 2 * slow >= fast:
        return motions.get(turning, "moving"), None
    ahead = "alike" if slow == fast else "left" if abs(left) == fast else "right"
    return motions.get(onward, "moving"), ahead


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


def _shows(protocol: Protocol, variable: str) -> tuple[str, ...]:
    """The facets that depend on a variable; a robot that stands still shows no speed."""
    car = protocol.car
    depend = {car.speed: ("moving", "motion", "ahead"), car.by: ("motion", "ahead")}
    return {**depend, car.steering: ("ahead",)}.get(variable, ("lights",))


def reference_machine(model: Model, steps: Sequence[Step]) -> Mealy[Output]:
    """The machine that a device must be which makes the model's choices; it may not be minimal.

    Facets of an output that the model does not know are None.
    """
    protocol = model.protocol
    start = model.homed(model.found())
    for frame in reset(protocol):
        start = model.after(start, step_of(protocol, frame).frame_effect)

    def step(before: ExpectedState, letter: int) -> tuple[ExpectedState, Output]:
        one = steps[letter]
        after = replace(model.after(before, one.frame_effect), rests_on=frozenset())
        return after, _expected(model, one, after)

    return explore(replace(start, rests_on=frozenset()), len(steps), step)


def _expected(model: Model, step: Step, after: ExpectedState) -> Output:
    word = model.choices.word(step.point) if step.point else ""
    accepted = next((one for one in step.accepted if one.word == word), step.accepted[0])
    state, protocol = after.state, model.protocol
    left, right = protocol.car.wheels(state, protocol.full_steering)
    values = {name: getattr(state, name) for name in protocol.lights}
    values[protocol.car.by] = visible_motion(state)
    looks = look_class(protocol.state_type)
    look = looks(t=0, moving=state.moving, left=left, right=right, **values)
    unknown = after.unknown - {protocol.car.speed} if after.still else after.unknown
    hidden = (facet for variable in unknown for facet in _shows(protocol, variable))
    return output_of(protocol, accepted.codes, look).without(hidden)


MOST_FRAMES = 400_000
"""Inputs sent until a device counts as having too many states to learn."""
MOST_DIFFERENCES = 12
"""Differences that are checked on the device."""
WALKS, STRIDE = 200, 12
"""Random sequences that a final hypothesis must pass, and the number of inputs in each."""
_TRIES = 6  # of a sequence, until two agree
_PAUSE = 2 * MS  # between two looks
_OPENING = "link/*"  # the cases of a run that does nothing but learn
_Outputs = tuple[Output, ...]


class NotLearned(Exception):
    """The device cannot be learned; the message says why, in one sentence."""


class Difference(NamedTuple):
    """A sequence of inputs after whose last one the outputs differ for the first time."""

    word: bytes
    expected: Output
    actual: Output


@dataclass(slots=True)
class Sent:
    """How many inputs learning has sent, and how many outcomes came once and not again."""

    frames: int = 0
    flaky: int = 0


@dataclass(slots=True)
class Learned:
    """What came of learning a target.

    `steps` are the inputs, `machine` is the device's, None where it was not learned, and then
    `trouble` says why in a sentence. `differences` were each seen on the device, the
    shortest first; a device may have more than MOST_DIFFERENCES. `report` is that of the run in
    which it was learned, whose failures were found beside the sequences. `seen` are facets of the
    look, in words. Of `sent`, `flaky` also counts what came between the sequences; on a line that
    loses nothing (`lossless`) it is the device's.
    """

    protocol: Protocol
    lossless: bool
    steps: tuple[Step, ...]
    machine: Mealy[Output] | None = None
    differences: tuple[Difference, ...] = ()
    trouble: str = ""
    seen: tuple[str, ...] = ()
    sent: Sent = field(default_factory=Sent)
    report: Report = field(init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The inputs in words."""
        return tuple(name_of(self.protocol, step) for step in self.steps)

    @property
    def beside(self) -> tuple[tuple[str, str], ...]:
        """The failures before, between and after the sequences, as case and reason."""
        failed = (one for one in self.report.results if one.verdict is Verdict.FAIL)
        return tuple((one.id, one.reason) for one in failed)

    @property
    def verdict(self) -> Verdict:
        """The verdict, from what was found. What was never seen is no pass."""
        if self.differences or self.beside or (self.sent.flaky and self.lossless):
            return Verdict.FAIL
        if self.report.ended_by == "error":
            return Verdict.ERROR
        unsure = self.trouble or self.sent.flaky or not self.seen
        return Verdict.INCONCLUSIVE if unsure else Verdict.PASS

    @property
    def exit(self) -> int:
        """The exit code: 0 the same machine, 1 another, 2 the kit failed, 3 not all is known."""
        return exit_code([self.verdict])

    def send_line(self, difference: Difference) -> str:
        """The command that sends the sequence of a difference, from rest.

        The frames for the simulator or an emulated board go to `PORT`, where it is served.
        """
        protocol, report = self.protocol, self.report
        frames = (*reset(protocol), *self.frames_of(difference.word))
        items = [item_of(protocol, frame) for frame in frames]
        return shlex.join([*send_words(protocol.origin, report.device, report.link), *items])

    def frames_of(self, word: bytes) -> tuple[bytes, ...]:
        """The frames of a sequence of inputs."""
        return tuple(self.steps[letter].frame for letter in word)


def learn_target(
    target: Target,
    *,
    seed: int = 1,
    progress: Callable[[int], None] = lambda frames: None,
) -> Learned:
    """Learn a target and compare it with the Protocol's machine; the robot is stopped at the end.

    It is learned in a run of the suite that has no other cases. `seed` makes the random sequences
    that the machine must pass. `progress` is called with the frames sent so far. Raises UserError
    where AALpy is missing or the line cannot be used at all.
    """
    links: list[Link] = []

    def connect(listener: LinkListener | None) -> Link:
        links.append(target.connect(listener))
        return links[0]

    def ask(procedure: Procedure[_Outputs]) -> _Outputs:
        progress(learned.sent.frames)
        return drive(procedure, links[0], target.interrupted)

    protocol = target.protocol
    learned = Learned(protocol, target.environment.lossless, alphabet(protocol))
    learned.report = report = run_suite(
        replace(target, connect=connect),
        Options(only=(_OPENING,)),
        logged=False,
        explainer=lambda run, *_: _Learning(run, ask, learned, seed),
    )
    if report.unusable:
        raise UserError(report.unusable)
    if (
        report.ended
        and not learned.trouble
        and (learned.machine is None or report.ended_by == "error")
    ):
        learned.trouble = report.ended
    return learned


class _Learning:
    """Learns the device once the run has found out its choices, and fills in what came of it."""

    def __init__(
        self, run: Run, ask: Callable[[Procedure[_Outputs]], _Outputs], learned: Learned, seed: int
    ) -> None:
        self._run, self._ask, self._learned, self._seed = run, ask, learned, seed

    def causes(self) -> tuple[()]:
        """What a run explains: nothing here."""
        return ()

    def try_again(self) -> Procedure[None]:
        """Learn, however it ends."""
        run, learned, begun = self._run, self._learned, len(self._run.results)
        model = Model(run.protocol, run.profile.choices)
        reference = reference_machine(model, learned.steps)
        system = System(run, self._ask, learned.steps, reference, learned.sent)
        learner = Learner(system, reference, seed=self._seed)
        try:
            yield from home(run)
            learned.machine = machine = learner.learn()
            learned.differences = tuple(learner.differences)
            outputs = [output for row in machine.outputs for output in row]
            seen = (one for one in FACETS if any(getattr(o, one) is not None for o in outputs))
            learned.seen = tuple(facet_words(run.protocol, one) for one in seen)
        except (GaveUp, NotLearned) as why:
            learned.trouble = str(why)
        finally:
            if learned.machine is None:
                learned.differences = system.deviations[:1]
            run.strays.close(keeps_all=run.keeps_all)
            if not learned.lossless:
                # In so many sequences noise makes as many strays as fail a run of the suite.
                learned.sent.flaky += len(run.results) - begun
                del run.results[begun:]


class Learner:
    """Learns the machine of a teacher, and finds where it differs from `reference`.

    `seed` makes the random sequences. Afterwards `differences` holds the differences that the
    teacher has confirmed, the shortest first.
    """

    def __init__(self, teacher: System, reference: Mealy[Output], *, seed: int = 1) -> None:
        self._teacher, self._reference, self._seed = teacher, reference, seed
        self._machine = reference
        self.differences: list[Difference] = []
        # What the library counts, and we do not read.
        self.num_queries = self.num_steps = self.num_cached_queries = 0

    def learn(self) -> Mealy[Output]:
        """Learn the machine. Raises UserError without AALpy, and what the teacher raises."""
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
        found = differences(self._reference, self._machine)
        self.differences = list(islice(found, MOST_DIFFERENCES))
        asked = chain((one.word for one in self.differences), self._walks())
        return next(filter(None, map(self._wrong, asked)), None)

    def _walks(self) -> Iterator[bytes]:
        draw = random.Random(f"walks {self._seed}")
        for _ in range(WALKS):
            yield bytes(draw.choices(self._machine.inputs, k=STRIDE))

    def _wrong(self, word: bytes) -> bytes | None:
        """The sequence up to where the teacher's outputs are not the machine's, None if all are."""
        pairs = zip(self._machine.run(word), self._teacher.outputs(word), strict=True)
        place = next((i for i, (mine, theirs) in enumerate(pairs) if mine != theirs), None)
        return None if place is None else word[: place + 1]


def require_aalpy() -> Callable[..., Any]:
    """The learning algorithm. Raises UserError where the library is missing."""
    try:
        from aalpy.learning_algs import run_KV
    except ImportError as error:
        raise UserError(
            "learn needs AALpy, which is not installed: pip install 'bilprov[learn]'"
        ) from error
    algorithm: Callable[..., Any] = run_KV
    return algorithm


def differences(reference: Mealy[Output], learned: Mealy[Output]) -> Iterator[Difference]:
    """Yield where the machines differ, the shortest sequences first.

    Behind a difference the search does not go on; the same input with the same two outputs is
    yielded once, at its shortest. What is expected has the facets that are seen.
    """
    both = _side_by_side(reference, learned)
    kinds: set[tuple[int, Output, Output]] = set()
    for word, outputs in zip(state_cover(both), both.outputs, strict=True):
        for letter, (due, given) in enumerate(outputs):
            expected = due.beside(given)
            if not due.fits(given) and (letter, expected, given) not in kinds:
                kinds.add((letter, expected, given))
                yield Difference(word + bytes([letter]), expected, given)


def _side_by_side(one: Mealy[Output], other: Mealy[Output]) -> Mealy[tuple[Output, Output]]:
    """The machine of the pairs of states that both reach; its outputs are those of both.

    Outputs that do not fit lead back to the first state.
    """

    def step(pair: tuple[int, int], letter: int) -> tuple[tuple[int, int], tuple[Output, Output]]:
        outputs = one.outputs[pair[0]][letter], other.outputs[pair[1]][letter]
        targets = one.targets[pair[0]][letter], other.targets[pair[1]][letter]
        return (targets if outputs[0].fits(outputs[1]) else (0, 0)), outputs

    return explore((0, 0), len(one.inputs), step)


@dataclass(slots=True)
class System:
    """A device as a function from sequences of inputs to outputs; known ones are not asked again.

    `ask` has a procedure done by the device, `reference` is the machine that is expected, `steps`
    are its inputs.
    """

    run: Run
    ask: Callable[[Procedure[_Outputs]], _Outputs]
    steps: Sequence[Step]
    reference: Mealy[Output]
    sent: Sent = field(default_factory=Sent)
    _known: dict[bytes, Output] = field(default_factory=dict)

    @property
    def deviations(self) -> tuple[Difference, ...]:
        """Where what is known differs from the reference, the shortest sequences first."""
        found = []
        for word in sorted(self._known, key=len):
            due, given = self.reference.run(word)[-1], self._known[word]
            if not due.fits(given):
                found.append(Difference(word, due.beside(given), given))
        return tuple(found)

    def outputs(self, word: bytes) -> _Outputs:
        """The outputs of the device for a sequence of inputs.

        Raises NotLearned where its tries do not agree, or contradict what was seen before; Ended
        and GaveUp where link or device end the run.
        """
        beginnings = [word[: end + 1] for end in range(len(word))]
        known = tuple(self._known[one] for one in beginnings if one in self._known)
        if len(known) < len(word):
            got = self._asked(word, known)
            self._known.update(zip(beginnings, got, strict=True))
            if got[: len(known)] != known:
                self.sent.flaky += 1  # what was known came once and not again
                raise NotLearned(
                    "the same sequence gave one outcome first and then, twice, another"
                )
            return got
        return known

    def _asked(self, word: bytes, known: _Outputs) -> _Outputs:
        """What the device gives, twice where that is not expected."""
        due = self.reference.run(word)
        # Behind a difference that is known nobody knows what to expect.
        expected = (*known, *due[len(known) :]) if _fit(due, known) else known
        tries: list[_Outputs] = []
        while (got := self._attempt(word, expected)) not in tries:
            if got[: len(known)] == known and _fit(due, got):
                break
            tries.append(got)
            if len(tries) == _TRIES:
                self.sent.flaky += _TRIES
                raise NotLearned(f"{_TRIES} tries of one sequence gave {_TRIES} different outcomes")
        self.sent.flaky += sum(one != got for one in tries)
        return got

    def _attempt(self, word: bytes, expected: _Outputs) -> _Outputs:
        self.sent.frames += len(word)
        if self.sent.frames > MOST_FRAMES:
            raise NotLearned(
                f"it is not learned after {MOST_FRAMES:,} frames: it has too many states"
            )
        return self.ask(self._sequence(word, expected))

    def _sequence(self, word: bytes, due: _Outputs) -> Procedure[_Outputs]:
        yield from self._begin()
        got: list[Output] = []
        in_step = True
        for letter, output in zip_longest(word, due):
            expected = output if in_step else None
            codes = yield from self._exchange(self.steps[letter], expected)
            got.append((yield from self._seen(codes, expected)))
            in_step = expected is not None and expected.fits(got[-1])
        return tuple(got)

    def _begin(self) -> Procedure[None]:
        """Home the robot and bring every variable to rest.

        What is twice the same is the device's way, and no noise.
        """
        missing: str | None = None
        for _ in range(_TRIES):
            yield from home(self.run)
            before, ready = missing, (yield from set_up(self.run, rest_of(self.run.protocol)))
            missing = ready.missing
            if missing in ("", before):
                return
            self.run.waiting.require_budget()
        raise NotLearned(f"what comes before a sequence is refused: {missing}")

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

    def _seen(self, codes: tuple[int, ...], expected: Output | None) -> Procedure[Output]:
        """Look at the robot; again while what is seen is not expected, for as long as a stop takes.

        Link and probe are two lines: a look right after an answer may be older than it. So is one
        where it is not known what to expect (None).
        """
        run = self.run
        if not run.config.observable:
            return output_of(run.protocol, codes, None)
        late = yield from listen(None, run.timers.grace if expected is None else 0)
        start: int | None = None
        while True:
            codes += late.codes
            seen = yield from observe()
            start = seen.asked if start is None else start
            output = output_of(run.protocol, codes, seen.look)
            waited = seen.now - start >= run.timers.deadline
            if expected is None or expected.fits(output) or waited:
                return output
            late = yield from listen(None, _PAUSE)


def _fit(due: _Outputs, got: _Outputs) -> bool:
    """Whether the outputs are as expected, as far as both go."""
    return all(wanted.fits(given) for wanted, given in zip(due, got, strict=False))
