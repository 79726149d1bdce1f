"""Probes of what a device answers where the document is silent: one short exchange each."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from conformance.cases.adaptation import as_chosen, led_instruction
from conformance.cases.preamble import setting
from conformance.cases.steps import Step, bad, code_of, cut, unused, valid, wrong_length
from conformance.dut.operations import Heard, Script, listen, send
from conformance.oracle.judge import MS, answer_words
from conformance.runner.discovery.experiment import Probe, Shown
from conformance.runner.run import Run
from spec.codec import bad_data
from spec.fields import Outcome
from spec.protocol import Protocol


def answer_probes(protocol: Protocol) -> Iterator[Probe]:
    """Every probe that needs no look, in order: what later probes rest on comes first."""
    yield from _led_probes(protocol)
    fill = bytes([protocol.filler])
    some = _setting(protocol)
    many = wrong_length(protocol, protocol.stop, 2, fill * 2)
    yield _burst("drain-known", ("R-drain-known",), (many, some), "flushed", "consumed")
    if protocol.unused_ids:
        nobody = protocol.unused_ids[0]
        drained = unused(protocol, nobody, 2, fill * 2)
        yield _burst("drain-unused", ("R-drain-unused",), (drained, some), "flushed", "consumed")
        lone = unused(protocol, nobody, 0, b"")
        yield _ahead("unused-id", (lone, some, some))
        yield _chosen("unused-length", drained)
    first_bad = next(((s, d) for s in protocol.instructions for d in bad_data(s)), None)
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        few = wrong_length(protocol, carrying, carrying.length - 1, fill * (carrying.length - 1))
        yield _ahead("too-few", (few, some, some))
    if first_bad:
        spec, data = first_bad
        yield _ahead("bad-data", (bad(protocol, spec, data), some, some))
        both = wrong_length(protocol, spec, spec.length + 1, data + fill)
        yield _chosen("competing-errors", both)
    yield from _cuts(protocol)
    if protocol.data_lengths[-1] > 2:
        slow = wrong_length(protocol, protocol.stop, 3, fill * 3)
        yield Probe(
            "answer-point",
            ("R-answer-point",),
            "a faulty frame is answered after its data, a frame that may be valid not before",
            lambda run: _answer_point(run, many, some),
            many.frame,
        )
        # After it: a device that answers at the header ends no frame by answering early.
        yield Probe(
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
    return valid(protocol, spec, values)


def _exchange(run: Run, data: bytes, due: int, patience: int = 0) -> Script[Heard]:
    """Send, and hear all that comes back until the line is silent."""
    yield from send(data)
    heard = yield from run.all_answers(due, patience)
    more = yield from listen(None, run.limits.silence)
    return Heard(heard.answers + more.answers, more.now)


def _burst(
    name: str, points: tuple[str, ...], steps: tuple[Step, ...], lost: str, kept: str
) -> Probe:
    """Frames in one go, the first of them faulty: are those after it run, or lost?"""
    data = b"".join(step.frame for step in steps)

    def make(run: Run) -> Script[Shown]:
        chosen = (as_chosen(run.protocol, run.profile.choices, step) for step in steps)
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
        return Shown(((points[0], word),), expected, actual, fault, heard.answers)

    requirement = "what follows a faulty instruction is run, each instruction answered once"
    return Probe(name, points, requirement, make, data)


POINT_RUN = "R-drain-unused"


def _ahead(kind: str, steps: tuple[Step, ...]) -> Probe:
    """Valid frames sent ahead behind a fault without data that are left over."""
    name, point = f"pipelining-{kind}", f"R-pipelining {kind}"
    return _burst(name, (point,), steps, "lost-after-fault", "in-order")


def _chosen(name: str, one: Step, patience: Callable[[Run], int] = lambda run: 0) -> Probe:
    """A frame whose answers are open: which of them does it give?"""

    def make(run: Run) -> Script[Shown]:
        step = as_chosen(run.protocol, run.profile.choices, one)
        heard = yield from _exchange(run, step.frame, 1, patience(run))
        run.timeouts += run.timeout if step.cut and heard.answers else 0
        expected = answer_words(run.protocol, step.accepted[0].codes)
        actual = answer_words(run.protocol, heard.codes)
        match = next((a for a in step.accepted if a.codes == heard.codes), None)
        default = step.accepted[0]
        if match is None:
            words = ((step.point, ""),)
            return Shown(words, expected, actual, f"answered {actual}", heard.answers)
        word = DEFAULT if match is default else match.word
        return Shown(((step.point, word),), expected, actual, "", heard.answers)

    return Probe(name, (one.point,), "answers in one way throughout", make, one.frame)


DEFAULT = "default"


def _cuts(protocol: Protocol) -> Iterator[Probe]:
    """Frames that are cut short: of a known ID, of an unused one, and of a too long one."""

    def patience(run: Run) -> int:
        return run.timeout + run.timeout // 4 + run.limits.settle + run.usual

    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        known = cut(protocol, carrying.id, carrying.length, b"")
        yield _chosen("truncated-known", known, patience)
        if carrying.length < protocol.data_lengths[-1]:
            long = cut(protocol, carrying.id, carrying.length + 1, b"")
            yield _chosen("truncated-long", long, patience)
    if protocol.unused_ids:
        nobody = cut(protocol, protocol.unused_ids[0], 1, b"")
        yield _chosen("truncated-unused", nobody, patience)


def _answer_point(run: Run, many: Step, some: Step) -> Script[Shown]:
    """Header and data apart, nearer than the time-out: when does the answer come?"""
    expected, point = "after the data", "R-answer-point"
    wait = min(run.timeout * 6 // 10, max(5 * MS, 3 * run.profile.slowest))
    if 2 * run.profile.slowest > wait:
        reason = f"answers take {run.profile.slowest / MS:.0f} ms, too long for the time-out"
        return Shown(((point, ""),), expected, "", coarse=reason)
    heard: tuple[tuple[int, int], ...] = ()
    early = []
    for step in (some, many):
        yield from send(step.frame[:1])
        first = yield from listen(1, wait) if len(step.frame) > 1 else listen(0, 0)
        yield from send(step.frame[1:])
        rest = yield from listen(1 - len(first.answers), run.usual)
        more = yield from listen(None, run.limits.silence)
        early.append(len(first.answers))
        heard += first.answers + rest.answers + more.answers
    actual = "at the header" if early[1] else "after the data"
    fault = ""
    if early[0]:
        fault = "answered at the header of a frame that may still be valid"
    elif len(heard) != 2:
        fault = f"{len(heard)} answers to 2 instructions whose data came apart"
    word = "at-header" if early[1] else "after-data"
    return Shown(((point, word),), expected, actual, fault, heard)


def _whole_frame(run: Run, step: Step) -> Script[Shown]:
    """A frame of several data bytes, each within the time-out, all of them not."""
    pause, point, early = run.timeout * 6 // 10, "R-truncation-timeout", 0
    usable = (run.profile.jitter or 0) < run.timeout - pause
    codes: list[tuple[int, int]] = []
    for index in range(len(step.frame)):
        sent = yield from send(step.frame[index : index + 1])
        last = index == len(step.frame) - 1
        heard = yield from listen(None if not last else 1, run.usual if last else pause)
        codes += heard.answers
        early += 0 if last else len(heard.answers)
        usable = usable and (last or heard.now - sent < run.timeout * 9 // 10)
    # A frame that was cut leaves bytes behind that are headers of their own, answered later.
    more = yield from listen(None, run.timeout + run.usual if early else run.limits.silence)
    heard_all = (*codes, *more.answers)
    expected = "between two bytes"
    if not usable:
        reason = "the time-out is too short for pauses inside it on this link"
        return Shown(((point, ""),), expected, "", coarse=reason)
    run.profile.whole_frame = early > 0 and not run.profile.choices.is_other("R-answer-point")
    word = "whole-frame" if run.profile.whole_frame else "between-bytes"
    fault = "" if heard_all else "no answer came"
    return Shown(((point, word),), expected, word, fault, heard_all)


def _led_probes(protocol: Protocol) -> Iterator[Probe]:
    """What the options allow of the LED's instruction; made only where they are given."""
    led = led_instruction(protocol)
    if led is None:
        return
    step = valid(protocol, led, {f.name: f.high for f in led.fields})
    ok, refused = code_of(protocol, Outcome.VALID), code_of(protocol, Outcome.UNKNOWN_ID)

    def version(run: Run) -> Script[Shown]:
        heard = yield from _exchange(run, step.frame, 1)
        words: dict[tuple[int, ...], str] = {(ok,): "current", (refused,): "older"}
        word = words.get(heard.codes, "")
        fault = "" if word else "neither this version of the protocol nor the one before"
        actual = answer_words(run.protocol, heard.codes)
        return Shown((("R-version", word),), "known, or unused", actual, fault, heard.answers)

    def moved(run: Run) -> Script[Shown]:
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
        return Shown((("R-led-id", word),), "one ID", actual, fault, own.answers + there.answers)

    requirement = f"the {led.name} has one ID"
    yield Probe("version", ("R-version",), requirement, version, step.frame, option="version")
    yield Probe("led-id", ("R-led-id",), requirement, moved, step.frame, option="led-id")
    data = next(iter(bad_data(led)), None)
    if data is not None:
        wrong = bad(protocol, led, data)

        def upper(run: Run) -> Script[Shown]:
            heard = yield from _exchange(run, wrong.frame, 1)
            word = {(ok,): "ignored", wrong.accepted[0].codes: "refused"}.get(heard.codes, "")
            actual = answer_words(run.protocol, heard.codes)
            fault = "" if word else f"answered {actual}"
            words = (("R-led-upper-bits", word),)
            return Shown(words, "refused, or ignored", actual, fault, heard.answers)

        name, points = "led-upper-bits", ("R-led-upper-bits",)
        yield Probe(name, points, requirement, upper, wrong.frame, option="led-upper")
