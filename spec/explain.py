"""Explains bytes: their meaning, what a conforming device answers and does, and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from bilprov.spec.bits import BitGroup, bit_groups
from bilprov.spec.codec import Judgement, judge, nearest, spaced
from bilprov.spec.errata import Finding, check
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framer
from bilprov.spec.motion import VARIABLES, Effect, Motion
from bilprov.spec.protocol import Protocol, ResponseSpec
from bilprov.spec.readings import READINGS, Erratum, Reading


@dataclass(frozen=True, slots=True)
class FrameExplanation:
    """One frame of the host: its bits, its judgement, and what a conforming device does.

    `offset` is the index of its first byte in the explained bytes, `missing` the number of data
    bytes that did not come. `answer` and `action` are sentences; `changes` pairs each state
    variable that is set with its new value in words, `keeps` names the others. `nearest` is the
    judgement of the nearest valid frame (None if this one is valid), `differences` how that
    differs from this frame.
    """

    offset: int
    judgement: Judgement
    groups: tuple[BitGroup, ...]
    missing: int
    answer: str
    action: str
    stops: bool
    changes: tuple[tuple[str, str], ...]
    keeps: tuple[str, ...]
    readings: tuple[Reading, ...]
    errata: tuple[Erratum, ...]
    nearest: Judgement | None
    differences: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ResponseExplanation:
    """One byte of the device; `response` is None for an unused code."""

    offset: int
    byte: int
    group: BitGroup
    response: ResponseSpec | None
    meaning: str
    clause: str


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of some bytes: `frames` if the host sent them, `responses` if the device did."""

    data: bytes
    frames: tuple[FrameExplanation, ...] = ()
    responses: tuple[ResponseExplanation, ...] = ()


def explain(protocol: Protocol, data: bytes) -> Explanation:
    """Explain bytes that the host sends, cut into frames as the device cuts them.

    An incomplete last frame counts as truncated by the time-out.
    """
    framer = Framer(protocol.lengths, timeout=None)
    findings = check(protocol)
    frames, offset = [], 0
    for framed in (*framer.feed(data, 0), *framer.drop(0, "truncated")):
        frames.append(_frame(protocol, data, offset, framed.data, findings))
        offset += len(framed.data)
    return Explanation(data, frames=tuple(frames))


def explain_responses(protocol: Protocol, data: bytes) -> Explanation:
    """Explain bytes that the device sends: one response each."""
    responses = tuple(_response(protocol, offset, byte) for offset, byte in enumerate(data))
    return Explanation(data, responses=responses)


def _response(protocol: Protocol, offset: int, byte: int) -> ResponseExplanation:
    response = protocol.codes.get(byte)
    if response is None:
        meaning = "unused: a device that sends one does not conform"
    else:
        meaning = response.prose
        if response.outcome is not Outcome.VALID:
            meaning += f"; the robot stops ({protocol.clauses.safety})"
    name = response.name if response else "unused"
    group = BitGroup(0, 1, 7, 0, f"{byte:08b}", "code", byte, name, fault=response is None)
    return ResponseExplanation(offset, byte, group, response, meaning, protocol.clauses.responses)


def _frame(
    protocol: Protocol, data: bytes, offset: int, frame: bytes, findings: Iterable[Finding]
) -> FrameExplanation:
    judgement = judge(protocol, frame)
    rest = data[offset:]
    effect, instruction = protocol.on_fault, judgement.instruction
    action = f"stops at once, as after any faulty instruction ({protocol.clauses.safety})"
    if judgement.valid and instruction:
        effect, action = instruction.effect, instruction.prose
    answer = f"{judgement.response.name}, code {judgement.response.code:02x}"
    if judgement.truncated:
        answer += f", once {protocol.timing.truncation_timeout:g} ms have passed without a byte"
    errata = tuple(
        finding.erratum
        for finding in findings
        if finding.erratum and rest.startswith(finding.sent) and len(frame) <= len(finding.sent)
    )
    meant = (
        None if judgement.valid else judge(protocol, nearest(protocol, frame, rest[len(frame) :]))
    )
    return FrameExplanation(
        offset=offset,
        judgement=judgement,
        groups=bit_groups(protocol, judgement),
        missing=1 + judgement.length - len(frame),
        answer=answer,
        action=action,
        stops=effect.motion is Motion.STOPPED,
        changes=tuple(_changes(effect, dict(judgement.fields))),
        keeps=tuple(name for name in VARIABLES if not effect.sets(name)),
        readings=_readings(judgement, errata),
        errata=errata,
        nearest=meant,
        differences=tuple(_differences(judgement, meant, rest[len(frame) :])) if meant else (),
    )


def _changes(effect: Effect, fields: dict[str, int]) -> Iterator[tuple[str, str]]:
    for variable, value in effect.assignments:
        known = fields[value[0]] * value[1] if isinstance(value, tuple) else value
        yield variable, str(known)


def _readings(judgement: Judgement, errata: Iterable[Erratum]) -> tuple[Reading, ...]:
    """Return the readings that the judgement rests on, in the order of the document."""
    ids = {judgement.reading}
    if judgement.truncated:
        ids.add("R-truncation-timeout")
    elif judgement.outcome is Outcome.UNKNOWN_ID and judgement.length:
        ids.add("R-drain-unused")
    elif judgement.outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW) and judgement.length:
        ids.add("R-drain-known")
    places = {erratum.clause for erratum in errata}
    return tuple(r for r in READINGS if r.id in ids or r.clause in places)


def _differences(judgement: Judgement, meant: Judgement, following: bytes) -> Iterator[str]:
    """Yield how the nearest valid frame differs, part by part, each in words."""
    if meant.id != judgement.id:
        yield f"id {judgement.id} becomes {meant.id}"
    if meant.length != judgement.length:
        yield f"length {judgement.length} becomes {meant.length}"
    came, right = judgement.frame[1:], meant.frame[1:]
    for index, (old, new) in enumerate(zip(came, right, strict=False), 1):
        if old != new:
            yield f"byte {index} {old:02x} becomes {new:02x}"
    if len(came) > len(right):
        yield f"{spaced(came[len(right) :])} is left out"
    elif len(right) > len(came):
        added = right[len(came) :]
        where = "what follows" if following.startswith(added) else "added"
        yield f"{spaced(added)} is {'taken from ' if where != 'added' else ''}{where}"
