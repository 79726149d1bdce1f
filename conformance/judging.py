"""Judges one axis of a case from what was heard or seen. Pure: values in, an Axis out."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

from captures.schemas import Look
from conformance.asks import Heard
from conformance.cases import Accepted, Case, Class
from conformance.verdicts import Axis, Verdict
from spec.motion import WHEELS, Motion, State
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
    match = next((choice for choice in accepted if choice.codes == heard.codes), None)
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


# What else the document leaves open about the state after an instruction, by what is judged:
# (facet, reading, verdict, how the facet then is).
_KEPT, _RESET = "kept", "reset"
_LEGAL = {
    "fault": (
        ("speed", "R-fault-state", Verdict.INFORMATIONAL, _RESET),
        ("steering", "R-fault-state", Verdict.INFORMATIONAL, _KEPT),
        ("led", "R-led-state", Verdict.INFORMATIONAL, _RESET),
    ),
    "stop": (
        ("speed", "R-stop-speed", Verdict.NON_STRICT, _RESET),
        ("steering", "R-stop-steering", Verdict.NON_STRICT, _KEPT),
        ("led", "R-led-state", Verdict.INFORMATIONAL, _RESET),
    ),
    "drive": (("steering", "R-drive-steering", Verdict.INFORMATIONAL, _RESET),),
    "set": (("speed", "R-speed-moving", Verdict.NON_STRICT, _KEPT),),
}


# What the stop axis judges already.
MOVING = ("moving", "motion", "wheels")


def judge_state(
    expected: State, before: State, look: Look, when: str, ignore: Container[str] = ()
) -> Axis:
    """The state axis: each facet that the probe tells, against the predicted state.

    `when` is `fault`, `stop`, `drive` or `set`; it says which other choices the document leaves
    open. `ignore` names facets that are judged elsewhere.
    """
    words = state_words(expected), look_words(look)
    verdict, reason, reading = Verdict.PASS, "", ""
    for facet, wanted, actual in _facets(expected, look):
        if actual is None or wanted == actual or facet in ignore:
            continue
        legal = _legal(facet, look, expected, before, when)
        found = legal[1] if legal else Verdict.FAIL
        if found > verdict:
            verdict = found
            reading = legal[0] if legal else ""
            reason = f"{facet} is {actual}, expected is {wanted}"
            if legal:
                reason += f" (another reading of {reading})"
    return Axis(verdict, *words, reason, reading)


def _legal(
    facet: str, look: Look, expected: State, before: State, when: str
) -> tuple[str, Verdict] | None:
    """The reading under which what was seen is legal, with its verdict; None if it never is."""
    for name, reading, verdict, how in _LEGAL[when]:
        other = getattr(before, name) if how is _KEPT else 0
        if name == facet and getattr(look, name) == other:
            return reading, verdict
        if facet == "wheels" and _turn_as(_with(expected, name, other), look):
            return reading, verdict
    if facet in ("moving", "motion", "wheels"):
        slow_start = when == "set" and before.speed != expected.speed
        if slow_start and look.moving == before.moving:
            return "R-speed-moving", Verdict.NON_STRICT
        curve = expected.motion in (Motion.ROTATE_RIGHT, Motion.ROTATE_LEFT) and look.moving
        if when == "set" and before.steering != expected.steering and curve and facet != "moving":
            return "R-steer-rotating", Verdict.INFORMATIONAL
    return None


def _with(state: State, name: str, value: int) -> State:
    return replace(state, **{name: value})  # type: ignore[arg-type]  # motion is never one of them


def _turn_as(state: State, look: Look) -> bool:
    """Whether the wheels are seen to turn as in this state."""
    if look.left is None or look.right is None:
        return False
    wanted, seen = _wheels(state, look.left, look.right)
    return wanted == seen


def _facets(expected: State, look: Look) -> list[tuple[str, object, object]]:
    """(facet, expected, seen) for whatever the probe tells; wheels by sign and by order only."""
    facets: list[tuple[str, object, object]] = [("moving", expected.moving, look.moving)]
    if look.motion is not None:
        # A probe may name the direction that is set although speed 0 keeps the wheels still.
        set_only = not look.moving and look.motion == expected.motion
        shown = expected.visible_motion.value if set_only else look.motion
        facets.append(("motion", expected.visible_motion.value, shown))
    facets += [
        (name, getattr(expected, name), getattr(look, name))
        for name in ("speed", "steering", "led")
    ]
    if look.left is not None and look.right is not None:
        facets.append(("wheels", *_wheels(expected, look.left, look.right)))
    return facets


def _wheels(expected: State, left: int, right: int) -> tuple[str, str]:
    """How the wheels should turn and how they do, in comparable words."""
    want_left, want_right = WHEELS[expected.visible_motion]
    seen = f"left {left}, right {right}"
    if not expected.moving:
        return "both still", "both still" if left == right == 0 else seen
    if want_left != want_right:
        wanted = f"{expected.visible_motion.value} on the spot"
        return wanted, wanted if left * want_left > 0 and right * want_right > 0 else seen
    # No mixing law is given: the outer wheel drives on, the inner one is not faster.
    forward_left, forward_right = left * want_left, right * want_right
    if expected.steering == 0:
        wanted, fits = "both alike", forward_left == forward_right > 0
    elif expected.steering > 0:
        wanted, fits = "left ahead", forward_left > 0 and forward_left >= forward_right
    else:
        wanted, fits = "right ahead", forward_right > 0 and forward_right >= forward_left
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
