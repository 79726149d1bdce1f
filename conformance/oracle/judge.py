"""Judges one axis of a case from the answers or the look that came, and says it in words. Pure."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import replace

from bilprov.analyzer.client.operations import Received
from bilprov.captures.schemas import MS, Look
from bilprov.captures.text import quantity
from bilprov.conformance.oracle.profile import Timers
from bilprov.conformance.oracle.state_model import ExpectedState, FrameEffect, Model
from bilprov.conformance.oracle.verdicts import Accepted, Axis, Verdict
from bilprov.conformance.oracle.wheel_order import tolerance
from bilprov.spec.motion import Wheels, visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, STATE_POINTS
from bilprov.spec.state import State


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


def state_words(state: State) -> str:
    """A motion state in words."""
    seen = f"{'moving ' if state.moving else ''}{visible_motion(state)}"
    others = (name for name in state.variables if name != state.wheels.by)
    return ", ".join((seen, *(f"{name} {getattr(state, name)}" for name in others)))


def look_words(look: Look) -> str:
    """A look in words; facets that the probe does not report are left out."""
    moving = {True: "moving", False: "stopped", None: "moving unknown"}[look.moving]
    motion = look.car.drive(look).motion
    facets = [moving] if motion in (None, look.car.still) else [f"{moving} {motion}"]
    for name in look.variables:
        value = getattr(look, name)
        if value is not None and name != look.car.by:
            facets.append(f"{name} {value}")
    if look.left is not None and look.right is not None:
        facets.append(f"wheels {look.left}/{look.right}")
    return ", ".join(facets)


def judge_answers(
    protocol: Protocol,
    accepted: tuple[Accepted, ...],
    heard: Received,
    sent: int,
    *,
    timed: bool,
    timers: Timers,
) -> Axis:
    """The answer axis: the list of all answers until the line was quiet, and the first one's delay.

    `sent` is when the stimulus's last byte had gone (ns); `timed` is false where the answer waits
    for a time-out, so that its delay is not judged. `timers` are the run's timers: after `deadline`
    an answer is slow, after `longest` it fails.
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
        if late > timers.longest:
            return Axis(
                Verdict.FAIL,
                expected,
                actual,
                f"answered after {late / MS:.0f} ms, at most {timers.longest / MS:g} "
                "ms are allowed",
                "R-answer-deadline",
            )
        if late > timers.deadline:
            verdict = max(verdict, Verdict.NON_STRICT)
            reading = reading or "R-answer-deadline"
            reason = reason or (
                f"slow: answered after {late / MS:.0f} ms, expected within "
                f"{timers.deadline / MS:g} ms"
            )
    return Axis(verdict, expected, actual, reason, reading)


def matching(accepted: tuple[Accepted, ...], codes: tuple[int, ...]) -> Accepted | None:
    """The accepted list that equals these answers, None if none does."""
    return next((choice for choice in accepted if choice.codes == codes), None)


def _mismatch(protocol: Protocol, wanted: Accepted, heard: Received) -> str:
    codes = heard.codes
    unused = [code for code in codes if code not in protocol.codes]
    if not codes:
        return "no answer came"
    if unused:
        return f"answered {code_words(protocol, unused[0])}: a device never sends an unused code"
    if len(codes) > len(wanted.codes):
        due = f"{len(wanted.codes) or 'none'} {'were' if len(wanted.codes) > 1 else 'was'} due"
        return f"{quantity(len(codes), 'answer')} came, {due}"
    return (
        f"answered {answer_words(protocol, codes)} "
        f"instead of {answer_words(protocol, wanted.codes)}"
    )


def lost(answer: Axis) -> Axis:
    """The axis of an instruction that was lost after a fault, and taken again on an idle line."""
    if answer.verdict >= Verdict.NON_STRICT:
        return answer
    reason = "lost after a fault, and taken when the line had been idle"
    return Axis(Verdict.NON_STRICT, answer.expected, answer.actual, reason, "R-drain-known")


def facets_of_motion(protocol: Protocol) -> tuple[str, ...]:
    """The facets that the stop axis judges already."""
    return ("moving", protocol.car.by, "wheels")


def judge_state(
    model: Model, expected_state: ExpectedState, look: Look, ignore: Container[str] = ()
) -> Axis:
    """The state axis: each facet that the probe reports, compared with the expected state.

    An expected state that rests on a choice of the device other than the default gets that choice's
    verdict. `ignore` names facets that are judged elsewhere.
    """
    words = state_words(expected_state.state), look_words(look)
    for facet, wanted, actual in differences(model, expected_state, look):
        if facet not in ignore:
            return Axis(Verdict.FAIL, *words, deviation(facet, wanted, actual))
    if not expected_state.rests_on:
        return Axis(Verdict.PASS, *words)
    choices = model.choices
    worst = max(sorted(expected_state.rests_on), key=choices.verdict)
    reading = POINTS[worst].reading
    reason = f"{choices.word(worst)}: another reading of {reading}"
    return Axis(choices.verdict(worst), *words, reason, reading)


def deviation(facet: str, wanted: object, actual: object) -> str:
    """One of the `differences` in words."""
    return f"{facet} is {actual}, expected {wanted}"


def contradiction(
    model: Model, before: ExpectedState, frame_effect: FrameEffect, look: Look
) -> tuple[str, str]:
    """The choice that a look contradicts: its reading and a sentence, both "" if there is none.

    The robot contradicts a choice that it has shown where its state fits the point's other choice.
    """
    for point in STATE_POINTS:
        shown = model.choices.word(point)
        word = next(c.word for c in POINTS[point].choices if c.word != shown)
        other = replace(model, choices=model.choices.but(point, word))
        if not differences(model, other.after(before, frame_effect), look):
            reading = POINTS[point].reading
            return reading, f"{reading}: {word} here, {shown} before; a device keeps to one choice"
    return "", ""


def differences(
    model: Model, expected_state: ExpectedState, look: Look
) -> list[tuple[str, object, object]]:
    """(facet, expected, seen) for each facet that differs from the expected state."""
    return [
        (facet, wanted, actual)
        for facet, wanted, actual in _facets(model, expected_state, look)
        if actual is not None and wanted != actual
    ]


def _facets(
    model: Model, expected_state: ExpectedState, look: Look
) -> Iterator[tuple[str, object, object]]:
    """(facet, expected, seen) for each facet that the probe reports; wheels by sign and order."""
    car, expected, unknown = model.protocol.car, expected_state.state, expected_state.unknown
    # A look that does not show whether the robot moves shows no motion either.
    if look.moving is not None and (car.speed not in unknown or expected_state.still):
        yield "moving", expected.moving, look.moving
        if car.by not in unknown:
            yield from _direction(model, expected_state, look)
        elif unknown.isdisjoint((car.speed, "curve")) and expected.moving:
            yield car.by, "a curve", _curve(car, expected, look)
    for name in model.protocol.settings:
        seen = getattr(look, name)
        pending_speed = (
            name == car.speed
            and expected_state.pending_speed is not None
            and seen == expected_state.pending_speed
        )
        if name not in unknown and not pending_speed:
            yield name, getattr(expected, name), seen


def _direction(
    model: Model, expected_state: ExpectedState, look: Look
) -> Iterator[tuple[str, object, object]]:
    car, expected = model.protocol.car, expected_state.state
    motion, visible = car.drive(look).motion, visible_motion(expected)
    if motion is not None:
        # A probe may name the direction that is set although speed 0 keeps the wheels still.
        set_only = not look.moving and motion == car.drive(expected).motion
        yield car.by, visible, visible if set_only else motion
    if look.left is not None and look.right is not None:
        yield "wheels", *_wheels(model, expected, look.left, look.right, expected_state.unknown)


def _curve(car: Wheels, expected: State, look: Look) -> str:
    """Words for a look at a rotation that steering must turn into a curve, not on the spot."""
    motion = car.drive(expected).motion
    spot = car.drive(look).motion == motion
    if look.left is not None and look.right is not None:
        spot = look.left * look.right < 0
    return f"{motion} on the spot" if spot else "a curve"


def _wheels(
    model: Model, expected: State, left: int, right: int, unknown: Container[str]
) -> tuple[str, str]:
    """Words for how the wheels must turn and how they do, equal if they fit."""
    car, visible = model.protocol.car, visible_motion(expected)
    motion, speed, steering = car.drive(expected)
    # A speed below 0, which a grammar may allow, turns both wheels the other way.
    forward = -1 if speed < 0 else 1
    want_left, want_right = (forward * turn for turn in car.turn(visible))
    seen = f"left {left}, right {right}"
    if not expected.moving:
        return "both still", "both still" if left == right == 0 else seen
    if want_left != want_right:
        wanted = f"{visible} on the spot"
        return wanted, wanted if left * want_left > 0 and right * want_right > 0 else seen
    # No mixing law is given: the outer wheel drives on, the inner one is not faster, and slower
    # where the steering and the speed are large enough to show. What is measured varies a little.
    outer, inner = left * want_left, right * want_right
    if steering < 0:
        outer, inner = inner, outer
    alike = abs(outer - inner) <= tolerance(max(outer, inner))
    if car.steering in unknown:
        wanted, fits = motion, max(outer, inner) > 0
    elif steering == 0:
        wanted, fits = "both alike", alike and min(outer, inner) > 0
    else:
        wanted = "left ahead" if steering > 0 else "right ahead"
        fits = outer > 0 and (outer > inner or (alike and not model.shows(expected)))
    return wanted, wanted if fits else seen
