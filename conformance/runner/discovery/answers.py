"""Experiments on what a device answers where the document is silent: one exchange each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from bilprov.analyzer.client.operations import Procedure, Received, listen, send
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.adaptation import adapt_to_device, led_instruction
from bilprov.conformance.cases.steps import (
    TOO_FEW,
    FrameClass,
    Step,
    code_of,
    framed,
    one_of_each,
    open_frames,
    step_of,
)
from bilprov.conformance.oracle.judge import answer_words, matching
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import link_check
from bilprov.spec.codec import bad_data, build
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, Behaviour

# -- an experiment on an open point, and its finding ----------------------------------------------


@dataclass(frozen=True, slots=True)
class Finding:
    """What one experiment showed: (point, choice) pairs, "" for a choice that could not be told.

    `fault` says what no reading allows, "" for nothing; `coarse` why the link is too slow to tell.
    `actual` and `heard`, the answers as (time in ns, code), are for the report and do not count
    when two findings are compared.
    """

    words: tuple[tuple[str, str], ...]
    expected: str
    actual: str = field(compare=False)
    fault: str = ""
    heard: tuple[tuple[int, int], ...] = field(default=(), compare=False)
    coarse: str = ""

    def fits(self, other: Finding) -> bool:
        """Whether both show the same, as far as both could tell."""
        pairs = zip(self.words, other.words, strict=True)
        alike = all(a == b or (a[0] == b[0] and "" in (a[1], b[1])) for a, b in pairs)
        return alike and (self.fault, self.coarse) == (other.fault, other.coarse)

    @property
    def told(self) -> int:
        """How many choices could be told."""
        return sum(word != "" for _, word in self.words)


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment: the open points it is about, and the procedure, for a homed line.

    `sees` if it needs looks, `safety` if it is about the stop, `long` if it is repeated only where
    necessary, `timed` if it rests on pauses near the time-out, which in real time may come out
    longer at the device, `cut` if its frame is cut short, `option` the option of `--allow` without
    which it is not made.
    """

    name: str
    points: tuple[str, ...]
    requirement: str
    make: Callable[[Run], Procedure[Finding]]
    stimulus: bytes = b""
    sees: bool = False
    safety: bool = False
    long: bool = False
    timed: bool = False
    cut: bool = False
    option: str = ""


def answer_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Every experiment that needs no look, in order: first those on which others depend."""
    yield from _led_experiments(protocol)
    fill = bytes([protocol.pad_byte])
    some, frames = step_of(protocol, link_check(protocol).setting), open_frames(protocol)
    length = min(2, protocol.data_lengths[-1])
    many = framed(protocol, protocol.stop.id, length, fill * length)
    yield _burst("R-drain-known", (many, some))
    faults = one_of_each(protocol)
    if protocol.unused_ids:
        drained = frames.pop("R-unused-length")
        yield _burst("R-drain-unused", (drained, some))
        yield _burst("R-pipelining unused-id", (faults[FrameClass.UNUSED_ID], some, some))
        yield _chosen(drained)
    for kind in (TOO_FEW, FrameClass.BAD_DATA):
        if kind in faults:
            yield _burst(f"R-pipelining {kind}", (faults[kind], some, some))
    yield from map(_chosen, frames.values())
    if protocol.data_lengths[-1] > 2:
        slow = framed(protocol, protocol.stop.id, 3, fill * 3)
        yield Experiment(
            "answer-point",
            ("R-answer-point",),
            "a faulty frame is answered after its data, a frame that may be valid not before",
            lambda run: _answer_point(run, many, some),
            many.frame,
        )
        # After it: a device that answers at the header ends no frame by answering early.
        yield Experiment(
            "truncation-timeout",
            ("R-truncation-timeout",),
            "the time-out counts between two bytes",
            lambda run: _whole_frame(run, slow),
            slow.frame,
            timed=True,
        )


def _exchange(run: Run, data: bytes, due: int, patience: int = 0) -> Procedure[Received]:
    """Send bytes and receive answers, `due` of them and any more, until the line is silent."""
    yield from send(data)
    heard = yield from run.waiting.all_answers(due, patience)
    heard += yield from listen(None, run.timers.silence)
    return heard


def _burst(ident: str, steps: tuple[Step, ...]) -> Experiment:
    """An experiment: are frames sent right behind a faulty one run, or discarded?"""
    point = POINTS[ident]
    data = b"".join(step.frame for step in steps)

    def make(run: Run) -> Procedure[Finding]:
        chosen = (adapt_to_device(run.protocol, run.profile.choices, step) for step in steps)
        data = b"".join(step.frame for step in chosen)
        heard = yield from _exchange(run, data, len(steps))
        ok = code_of(run.protocol, Outcome.VALID)
        expected = f"{len(steps)} answers"
        actual = answer_words(run.protocol, heard.codes)
        behind = (ok,) * (len(steps) - 1)
        word, fault = point.default, ""
        if heard.codes[1:] == ():
            word = point.word_of(Behaviour.DISCARDED) if heard.codes else ""
            if heard.codes:
                run.profile.flushes = True
                yield from _find_idle(run, data)
            fault = "" if heard.codes else "no answer came"
        elif heard.codes[1:] != behind:
            word = "run"
            if not point.choice(word) or "unused-length" not in run.profile.choices.allowed:
                fault = "the data of a faulty frame are run as instructions, or answers are lost"
        return Finding(((ident, word),), expected, actual, fault, heard.answers)

    requirement = "what follows a faulty instruction is run, each instruction answered once"
    return Experiment(_name(ident), (ident,), requirement, make, data)


def _find_idle(run: Run, burst: bytes) -> Procedure[None]:
    """Find out how long the line must be silent until what follows the burst is taken again.

    It is no more than twice what is needed, and at most the longest time allowed for an answer.
    """
    while run.waiting.idle < run.timers.longest:
        yield from home(run)
        yield from send(burst)
        heard = yield from listen(None, run.waiting.idle)
        yield from send(bytes([run.protocol.pad_byte]))
        # One answer is that to the fault.
        more = yield from run.waiting.all_answers(max(1, 2 - len(heard.answers)))
        if len(heard.answers) + len(more.answers) > 1:
            return
        run.profile.flushes_for = min(2 * run.waiting.idle, run.timers.longest)


def _name(point: str) -> str:
    """The name of the experiment on an open point."""
    return point.removeprefix("R-").replace(" ", "-")


def _chosen(one: Step) -> Experiment:
    """An experiment: which of the answers that are open for this frame does the device give?"""

    def make(run: Run) -> Procedure[Finding]:
        step = adapt_to_device(run.protocol, run.profile.choices, one)
        patience = run.waiting.silence + run.waiting.usual if one.truncated else 0
        heard = yield from _exchange(run, step.frame, 1, patience)
        run.waiting.timeouts += run.waiting.timeout if step.truncated and heard.answers else 0
        expected = answer_words(run.protocol, step.accepted[0].codes)
        actual = answer_words(run.protocol, heard.codes)
        match = matching(step.accepted, heard.codes)
        if match is None:
            words = ((step.point, ""),)
            return Finding(words, expected, actual, f"answered {actual}", heard.answers)
        word = match.word or POINTS[step.point].default
        return Finding(((step.point, word),), expected, actual, "", heard.answers)

    requirement = "answers in one way throughout"
    ident, points = _name(one.point), (one.point,)
    return Experiment(ident, points, requirement, make, one.frame, cut=one.truncated)


def _answer_point(run: Run, many: Step, some: Step) -> Procedure[Finding]:
    """Send data after their header, within the time-out, and find out when the answer comes."""
    expected, point = "after the data", "R-answer-point"
    wait = min(run.waiting.timeout * 6 // 10, max(5 * MS, 3 * run.profile.slowest))
    if 2 * run.profile.slowest > wait:
        reason = f"answers take {run.profile.slowest / MS:.0f} ms, too long for the time-out"
        return Finding(((point, ""),), expected, "", coarse=reason)
    heard: tuple[tuple[int, int], ...] = ()
    early = []
    for step in (some, many):
        yield from send(step.frame[:1])
        first = yield from listen(1, wait) if len(step.frame) > 1 else listen(0, 0)
        yield from send(step.frame[1:])
        rest = yield from listen(1 - len(first.answers), run.waiting.usual)
        more = yield from listen(None, run.timers.silence)
        early.append(len(first.answers) if len(step.frame) > 1 else 0)
        heard += first.answers + rest.answers + more.answers
    actual = "at the header" if early[1] else "after the data"
    fault = ""
    if early[0]:
        fault = "answered at the header of a frame that may still be valid"
    elif len(heard) != 2:
        fault = f"{len(heard)} answers to 2 instructions whose data came apart"
    word = "at-header" if early[1] else "after-data"
    return Finding(((point, word),), expected, actual, fault, heard)


def _whole_frame(run: Run, step: Step) -> Procedure[Finding]:
    """Find out whether the time-out counts from the header or between two bytes.

    Each pause inside the frame is shorter than the time-out, all together are longer. Where the
    frame was truncated, its other bytes are answered as instructions of their own.
    """
    pause, point, early = run.waiting.timeout * 6 // 10, "R-truncation-timeout", 0
    usable = (run.profile.jitter or 0) < run.waiting.timeout - pause
    got: tuple[tuple[int, int], ...] = ()
    for byte in step.frame[:-1]:
        sent = yield from send(bytes([byte]))
        heard = yield from listen(None, pause)
        got += heard.answers
        usable = usable and heard.now - sent < run.waiting.timeout * 9 // 10
    early = len(got)
    yield from send(step.frame[-1:])
    rest = yield from run.waiting.all_answers(1)
    # A slow device answers what is left over one by one.
    patience = max(run.timers.silence, 2 * run.profile.slowest)
    patience = run.waiting.timeout + run.waiting.usual if early else patience
    more = yield from run.waiting.all_answers(len(step.frame), patience)
    heard_all = got + rest.answers + more.answers
    expected = "between two bytes"
    if not usable:
        reason = "the time-out is too short for pauses inside it on this link"
        return Finding(((point, ""),), expected, "", coarse=reason)
    left_over = code_of(run.protocol, Outcome.VALID) in [code for _, code in heard_all]
    apart = early > 0 or left_over
    run.profile.whole_frame = apart and not run.profile.choices.differs("R-answer-point")
    word = "whole-frame" if run.profile.whole_frame else "between-bytes"
    fault = "" if heard_all else "no answer came"
    return Finding(((point, word),), expected, word, fault, heard_all)


def _led_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Experiments on the choices that options allow for the LED's instruction; only with them."""
    led = led_instruction(protocol)
    if led is None:
        return
    step = step_of(protocol, build(protocol, led.name, {f.name: f.high for f in led.fields}))
    ok, refused = code_of(protocol, Outcome.VALID), code_of(protocol, Outcome.UNKNOWN_ID)

    def moved(run: Run) -> Procedure[Finding]:
        choices = run.profile.choices
        other = int(choices.allowed["led-id"])
        own = yield from _exchange(run, step.frame, 1)
        header = bytes([protocol.header_bytes[other, led.length]])
        there = yield from _exchange(run, header + step.frame[1:], 1)
        codes = own.codes + there.codes
        words: dict[tuple[int, ...], str] = {(ok, refused): "table", (refused, ok): "example"}
        word = words.get(codes, "")
        choices.led_id = other
        fault = "" if word else f"takes neither just the ID {led.id} nor just the ID {other}"
        actual = answer_words(run.protocol, codes)
        return Finding((("R-led-id", word),), "one ID", actual, fault, own.answers + there.answers)

    requirement = f"the {led.name} has one ID"
    fault = "neither this version of the protocol nor the one before"
    yield _allowed("R-version", step, requirement, "known, or unused", fault)
    yield Experiment("led-id", ("R-led-id",), requirement, moved, step.frame, option="led-id")
    data = next(iter(bad_data(led)), None)
    if data is not None:
        wrong = framed(protocol, led.id, led.length, data)
        yield _allowed("R-led-upper-bits", wrong, requirement, "refused, or ignored")


def _allowed(
    ident: str, step: Step, requirement: str, expected: str, otherwise: str = ""
) -> Experiment:
    """An experiment, made only with an option: which choice's answer comes to this frame?"""
    choices = POINTS[ident].choices
    outcomes = {c.does: c.word for c in choices if isinstance(c.does, Outcome)}

    def make(run: Run) -> Procedure[Finding]:
        heard = yield from _exchange(run, step.frame, 1)
        actual = answer_words(run.protocol, heard.codes)
        match = (word for o, word in outcomes.items() if heard.codes == (code_of(run.protocol, o),))
        word = next(match, "")
        fault = "" if word else otherwise or f"answered {actual}"
        return Finding(((ident, word),), expected, actual, fault, heard.answers)

    option, _, _ = choices[1].option.partition("=")
    return Experiment(_name(ident), (ident,), requirement, make, step.frame, option=option)
