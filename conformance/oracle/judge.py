"""Judges one axis of a case from what was heard or seen. Pure: values in, an Axis out."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import replace

from captures.schemas import Look
from conformance.cases.single_frames import Case
from conformance.cases.steps import Accepted, Class
from conformance.dut.operations import Heard
from conformance.oracle.choices import POINTS, STATE_POINTS
from conformance.oracle.state_model import Belief, Deed, Model
from conformance.oracle.verdicts import Axis, Verdict
from spec.motion import WHEELS, State
from spec.protocol import Protocol

MS = 1_000_000
NOT_OBSERVABLE = "not observable"


def code_words(protocol: Protocol, code: int) -> str:
    """A response code in hex and in words: `01 BAD_HEADER`."""
    known = protocol.codes.get(code)
    return f"{code:02x} {known.name if known else 'unused'}"


def answer_words(protocol: Protocol, codes: tuple[int, ...]) -> str:
    """A list of answers in hex and in words, long ones clipped."""
    if not codes:
        return "no answer"
    shown = ", ".join(code_words(protocol, code) for code in codes[:4])
    return f"{shown} and {len(codes) - 4} more" if len(codes) > 4 else shown


def judge_answers(
    protocol: Protocol,
    accepted: tuple[Accepted, ...],
    heard: Heard,
    sent: int,
    *,
    timed: bool,
) -> Axis:
    """The answer axis: the whole list of answers until quiet, and how soon the first came.

    `sent` is when the stimulus's last byte had gone (ns); `timed` is false where the answer waits
    for a time-out and its delay says nothing.
    """
    expected = answer_words(protocol, accepted[0].codes)
    actual = answer_words(protocol, heard.codes)
    match = matching(accepted, heard.codes)
    if match is None:
        return Axis(Verdict.FAIL, expected, actual, _mismatch(protocol, accepted[0], heard))
    verdict, reason, reading = match.verdict, "", match.reading
    if reading:
        reason = f"another reading of {reading}: {actual} instead of {expected}"
    if timed and heard.answers:
        late = heard.answers[0][0] - sent
        if late > protocol.timing.answer_longest * MS:
            return Axis(
                Verdict.FAIL,
                expected,
                actual,
                f"answered after {late / MS:.0f} ms, at most {protocol.timing.answer_longest:g} "
                "ms are allowed",
                "R-answer-deadline",
            )
        if late > protocol.timing.answer_deadline * MS:
            verdict = max(verdict, Verdict.NON_STRICT)
            reading = reading or "R-answer-deadline"
            reason = reason or (
                f"slow: answered after {late / MS:.0f} ms, "
                f"{protocol.timing.answer_deadline:g} ms are expected"
            )
    return Axis(verdict, expected, actual, reason, reading)


def matching(accepted: tuple[Accepted, ...], codes: tuple[int, ...]) -> Accepted | None:
    """The accepted list that these answers are, None if they are none of them."""
    return next((choice for choice in accepted if choice.codes == codes), None)


def _mismatch(protocol: Protocol, wanted: Accepted, heard: Heard) -> str:
    codes = heard.codes
    unused = [code for code in codes if code not in protocol.codes]
    if not codes:
        return "no answer came"
    if unused:
        return f"answered {code_words(protocol, unused[0])}: a device never sends an unused code"
    if len(codes) > len(wanted.codes):
        return f"{len(codes)} answers came, {len(wanted.codes) or 'none'} was due"
    return (
        f"answered {answer_words(protocol, codes)} "
        f"instead of {answer_words(protocol, wanted.codes)}"
    )


def lost(answer: Axis) -> Axis:
    """The axis of an instruction that was taken only the second time, when the line was idle."""
    if answer.verdict >= Verdict.NON_STRICT:
        return answer
    reason = "lost after a fault, and taken when the line had been idle"
    return Axis(Verdict.NON_STRICT, answer.expected, answer.actual, reason, "R-drain-known")


def state_words(state: State) -> str:
    """A motion state in words."""
    return (
        f"{'moving ' if state.moving else ''}{state.visible_motion.value}, speed {state.speed}, "
        f"steering {state.steering}, led {state.led}"
    )


def look_words(look: Look) -> str:
    """What the probe told, in words; what it cannot tell is left out."""
    moving = {True: "moving", False: "stopped", None: "moving unknown"}[look.moving]
    facets = [moving] if look.motion in (None, "stopped") else [f"{moving} {look.motion}"]
    for name in ("speed", "steering", "led"):
        value = getattr(look, name)
        if value is not None:
            facets.append(f"{name} {value}")
    if look.left is not None and look.right is not None:
        facets.append(f"wheels {look.left}/{look.right}")
    return ", ".join(facets)


# What the stop axis judges already.
MOVING = ("moving", "motion", "wheels")


def judge_belief(model: Model, belief: Belief, look: Look, ignore: Container[str] = ()) -> Axis:
    """The state axis: each facet that the probe tells, against what the robot must be like.

    A state that another choice of the device shaped gets that choice's verdict. `ignore` names
    facets that are judged elsewhere.
    """
    words = state_words(belief.state), look_words(look)
    for facet, wanted, actual in differences(model, belief, look):
        if facet not in ignore:
            return Axis(Verdict.FAIL, *words, f"{facet} is {actual}, expected is {wanted}")
    if not belief.rests:
        return Axis(Verdict.PASS, *words)
    choices = model.choices
    worst = max(sorted(belief.rests), key=choices.verdict)
    reading = POINTS[worst].reading
    reason = f"{choices.word(worst)}: another reading of {reading}"
    return Axis(choices.verdict(worst), *words, reason, reading)


def contradiction(model: Model, before: Belief, deed: Deed, look: Look) -> tuple[str, str]:
    """The reading, and a sentence, if the robot is as another choice than it has shown would be."""
    for point in STATE_POINTS:
        shown = model.choices.word(point)
        word = next(c.word for c in POINTS[point].choices if c.word != shown)
        other = replace(model, choices=model.choices.but(point, word))
        if not differences(model, other.after(before, deed), look):
            reading = POINTS[point].reading
            return reading, f"{reading}: {word} here, {shown} before; a device keeps to one choice"
    return "", ""


def differences(model: Model, belief: Belief, look: Look) -> list[tuple[str, object, object]]:
    """(facet, expected, seen) for each facet that is not as it must be."""
    return [
        (facet, wanted, actual)
        for facet, wanted, actual in _facets(model, belief, look)
        if actual is not None and wanted != actual
    ]


def _facets(model: Model, belief: Belief, look: Look) -> Iterator[tuple[str, object, object]]:
    """(facet, expected, seen) for whatever the probe tells; wheels by sign and by order only."""
    expected, loose = belief.state, belief.loose
    if "speed" not in loose or belief.still:
        yield "moving", expected.moving, look.moving
        if "motion" not in loose:
            yield from _direction(model, belief, look)
        elif "speed" not in loose and expected.moving:
            yield "motion", "a curve", _curve(expected, look)
    for name in ("speed", "steering", "led"):
        seen = getattr(look, name)
        waiting = name == "speed" and belief.waiting is not None and seen == belief.waiting
        if name not in loose and not waiting:
            yield name, getattr(expected, name), seen


def _direction(model: Model, belief: Belief, look: Look) -> Iterator[tuple[str, object, object]]:
    expected = belief.state
    if look.motion is not None:
        # A probe may name the direction that is set although speed 0 keeps the wheels still.
        set_only = not look.moving and look.motion == expected.motion
        shown = expected.visible_motion.value if set_only else look.motion
        yield "motion", expected.visible_motion.value, shown
    if look.left is not None and look.right is not None:
        yield "wheels", *_wheels(model, expected, look.left, look.right, belief.loose)


def _curve(expected: State, look: Look) -> str:
    """What a rotation is that steering makes a curve of: no longer on the spot."""
    spot = look.motion == expected.motion.value
    if look.left is not None and look.right is not None:
        spot = look.left * look.right < 0
    return f"{expected.motion.value} on the spot" if spot else "a curve"


def _wheels(
    model: Model, expected: State, left: int, right: int, loose: Container[str]
) -> tuple[str, str]:
    """How the wheels should turn and how they do, in comparable words."""
    want_left, want_right = WHEELS[expected.visible_motion]
    seen = f"left {left}, right {right}"
    if not expected.moving:
        return "both still", "both still" if left == right == 0 else seen
    if want_left != want_right:
        wanted = f"{expected.visible_motion.value} on the spot"
        return wanted, wanted if left * want_left > 0 and right * want_right > 0 else seen
    # No mixing law is given: the outer wheel drives on, the inner one is not faster, and slower
    # where the steering and the speed are large enough to show.
    outer, inner = left * want_left, right * want_right
    if expected.steering < 0:
        outer, inner = inner, outer
    if "steering" in loose:
        wanted, fits = expected.motion.value, max(outer, inner) > 0
    elif expected.steering == 0:
        wanted, fits = "both alike", outer == inner > 0
    else:
        wanted = "left ahead" if expected.steering > 0 else "right ahead"
        fits = outer > 0 and (outer > inner or (outer == inner and not model.shows(expected)))
    return wanted, wanted if fits else seen


def unseen(case: Case, look: Look) -> str:
    """What this case is about that the probe does not tell, "" if it tells enough."""
    if look.moving is None:
        return "the probe does not know whether the robot moves"
    if case.kind is not Class.VALID:
        return ""
    changed = [
        name
        for name in ("speed", "steering", "led")
        if getattr(case.expected, name) != getattr(case.setup, name)
    ]
    wheels = look.left is not None and look.right is not None
    blind = [n for n in changed if getattr(look, n) is None and (n == "led" or not wheels)]
    if case.expected.moving and look.motion is None and not wheels:
        blind.append("direction")
    return f"the probe does not tell {', '.join(blind)}" if blind else ""
