"""Experiments on what a device answers where the document is silent: one exchange each."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.adaptation import adapt_to_device, led_instruction
from bilprov.conformance.cases.steps import (
    Step,
    bad_data_frame,
    code_of,
    truncated_frame,
    unused_id_frame,
    valid_frame,
    wrong_length_frame,
)
from bilprov.conformance.dut.operations import Procedure, Received, listen, send
from bilprov.conformance.oracle.wording import answer_words
from bilprov.conformance.runner.discovery.experiment import Experiment, Finding
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import setting
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol


def answer_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Every experiment that needs no look, in order: first those on which others depend."""
    yield from _led_experiments(protocol)
    fill = bytes([protocol.pad_byte])
    some = _setting(protocol)
    many = wrong_length_frame(protocol, protocol.stop, 2, fill * 2)
    yield _burst("drain-known", ("R-drain-known",), (many, some), "flushed", "consumed")
    if protocol.unused_ids:
        nobody = protocol.unused_ids[0]
        drained = unused_id_frame(protocol, nobody, 2, fill * 2)
        yield _burst("drain-unused", ("R-drain-unused",), (drained, some), "flushed", "consumed")
        lone = unused_id_frame(protocol, nobody, 0, b"")
        yield _ahead("unused-id", (lone, some, some))
        yield _chosen("unused-length", drained)
    first_bad = next(((s, d) for s in protocol.instructions for d in bad_data(s)), None)
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        few = wrong_length_frame(
            protocol, carrying, carrying.length - 1, fill * (carrying.length - 1)
        )
        yield _ahead("too-few", (few, some, some))
    if first_bad:
        spec, data = first_bad
        yield _ahead("bad-data", (bad_data_frame(protocol, spec, data), some, some))
        both = wrong_length_frame(protocol, spec, spec.length + 1, data + fill)
        yield _chosen("competing-errors", both)
    yield from _cuts(protocol)
    if protocol.data_lengths[-1] > 2:
        slow = wrong_length_frame(protocol, protocol.stop, 3, fill * 3)
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
        )


def _setting(protocol: Protocol) -> Step:
    """A valid instruction that moves nothing: a setting, else the stop."""
    low, high = protocol.limits.get("speed", (0, 0))
    frame = setting(protocol, "speed", (low + high) // 2)
    spec = protocol.by_id[protocol.headers[frame[0]][0]] if frame else protocol.stop
    data = frame[1:]
    values = {f.name: f.parse(data[f.offset :][: f.size]) for f in spec.fields}
    return valid_frame(protocol, spec, values)


def _exchange(run: Run, data: bytes, due: int, patience: int = 0) -> Procedure[Received]:
    """Send bytes and receive answers, `due` of them and any more, until the line is silent."""
    yield from send(data)
    heard = yield from run.waiting.all_answers(due, patience)
    more = yield from listen(None, run.timers.silence)
    return Received(heard.answers + more.answers, more.now)


def _burst(
    name: str, points: tuple[str, ...], steps: tuple[Step, ...], lost: str, kept: str
) -> Experiment:
    """An experiment: are frames sent right behind a faulty one run (`kept`), or `lost`?"""
    data = b"".join(step.frame for step in steps)

    def make(run: Run) -> Procedure[Finding]:
        chosen = (adapt_to_device(run.protocol, run.profile.choices, step) for step in steps)
        data = b"".join(step.frame for step in chosen)
        heard = yield from _exchange(run, data, len(steps))
        ok = code_of(run.protocol, Outcome.VALID)
        expected = f"{len(steps)} answers"
        actual = answer_words(run.protocol, heard.codes)
        behind = (ok,) * (len(steps) - 1)
        word, fault = kept, ""
        if heard.codes[1:] == ():
            word = lost if heard.codes else ""
            run.profile.flushes = run.profile.flushes or bool(heard.codes)
            fault = "" if heard.codes else "no answer came"
        elif heard.codes[1:] != behind:
            word = "run"
            if POINT_RUN not in points or "unused-length" not in run.profile.choices.allowed:
                fault = "the data of a faulty frame are run as instructions, or answers are lost"
        return Finding(((points[0], word),), expected, actual, fault, heard.answers)

    requirement = "what follows a faulty instruction is run, each instruction answered once"
    return Experiment(name, points, requirement, make, data)


POINT_RUN = "R-drain-unused"


def _ahead(kind: str, steps: tuple[Step, ...]) -> Experiment:
    """An experiment: valid frames sent ahead behind a fault that leaves no data over."""
    name, point = f"pipelining-{kind}", f"R-pipelining {kind}"
    return _burst(name, (point,), steps, "lost-after-fault", "in-order")


def _chosen(name: str, one: Step, patience: Callable[[Run], int] = lambda run: 0) -> Experiment:
    """An experiment: which of the answers that are open for this frame does the device give?"""

    def make(run: Run) -> Procedure[Finding]:
        step = adapt_to_device(run.protocol, run.profile.choices, one)
        heard = yield from _exchange(run, step.frame, 1, patience(run))
        run.waiting.timeouts += run.waiting.timeout if step.truncated and heard.answers else 0
        expected = answer_words(run.protocol, step.accepted[0].codes)
        actual = answer_words(run.protocol, heard.codes)
        match = next((a for a in step.accepted if a.codes == heard.codes), None)
        default = step.accepted[0]
        if match is None:
            words = ((step.point, ""),)
            return Finding(words, expected, actual, f"answered {actual}", heard.answers)
        word = DEFAULT if match is default else match.word
        return Finding(((step.point, word),), expected, actual, "", heard.answers)

    return Experiment(name, (one.point,), "answers in one way throughout", make, one.frame)


DEFAULT = "default"


def _cuts(protocol: Protocol) -> Iterator[Experiment]:
    """Experiments with truncated frames: a known ID, a length too long for it, an unused ID."""

    def patience(run: Run) -> int:
        timeout = run.waiting.timeout
        return timeout + timeout // 4 + run.timers.settle + run.waiting.usual

    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        known = truncated_frame(protocol, carrying.id, carrying.length, b"")
        yield _chosen("truncated-known", known, patience)
        if carrying.length < protocol.data_lengths[-1]:
            long = truncated_frame(protocol, carrying.id, carrying.length + 1, b"")
            yield _chosen("truncated-long", long, patience)
    if protocol.unused_ids:
        nobody = truncated_frame(protocol, protocol.unused_ids[0], 1, b"")
        yield _chosen("truncated-unused", nobody, patience)


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
        early.append(len(first.answers))
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

    Each pause inside the frame is shorter than the time-out, all together are longer.
    """
    pause, point, early = run.waiting.timeout * 6 // 10, "R-truncation-timeout", 0
    usable = (run.profile.jitter or 0) < run.waiting.timeout - pause
    codes: list[tuple[int, int]] = []
    for index in range(len(step.frame)):
        sent = yield from send(step.frame[index : index + 1])
        last = index == len(step.frame) - 1
        heard = yield from listen(None if not last else 1, run.waiting.usual if last else pause)
        codes += heard.answers
        early += 0 if last else len(heard.answers)
        usable = usable and (last or heard.now - sent < run.waiting.timeout * 9 // 10)
    # A truncated frame leaves bytes over that are headers of their own, answered later.
    rest = run.waiting.timeout + run.waiting.usual
    more = yield from listen(None, rest if early else run.timers.silence)
    heard_all = (*codes, *more.answers)
    expected = "between two bytes"
    if not usable:
        reason = "the time-out is too short for pauses inside it on this link"
        return Finding(((point, ""),), expected, "", coarse=reason)
    run.profile.whole_frame = early > 0 and not run.profile.choices.differs("R-answer-point")
    word = "whole-frame" if run.profile.whole_frame else "between-bytes"
    fault = "" if heard_all else "no answer came"
    return Finding(((point, word),), expected, word, fault, heard_all)


def _led_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Experiments on the choices that options allow for the LED's instruction; only with them."""
    led = led_instruction(protocol)
    if led is None:
        return
    step = valid_frame(protocol, led, {f.name: f.high for f in led.fields})
    ok, refused = code_of(protocol, Outcome.VALID), code_of(protocol, Outcome.UNKNOWN_ID)

    def version(run: Run) -> Procedure[Finding]:
        heard = yield from _exchange(run, step.frame, 1)
        words: dict[tuple[int, ...], str] = {(ok,): "current", (refused,): "older"}
        word = words.get(heard.codes, "")
        fault = "" if word else "neither this version of the protocol nor the one before"
        actual = answer_words(run.protocol, heard.codes)
        return Finding((("R-version", word),), "known, or unused", actual, fault, heard.answers)

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
    yield Experiment("version", ("R-version",), requirement, version, step.frame, option="version")
    yield Experiment("led-id", ("R-led-id",), requirement, moved, step.frame, option="led-id")
    data = next(iter(bad_data(led)), None)
    if data is not None:
        wrong = bad_data_frame(protocol, led, data)

        def upper(run: Run) -> Procedure[Finding]:
            heard = yield from _exchange(run, wrong.frame, 1)
            word = {(ok,): "ignored", wrong.accepted[0].codes: "refused"}.get(heard.codes, "")
            actual = answer_words(run.protocol, heard.codes)
            fault = "" if word else f"answered {actual}"
            words = (("R-led-upper-bits", word),)
            return Finding(words, "refused, or ignored", actual, fault, heard.answers)

        name, points = "led-upper-bits", ("R-led-upper-bits",)
        yield Experiment(name, points, requirement, upper, wrong.frame, option="led-upper")
