"""Test steps: single frames with their bytes, accepted answers and effects.

Each function that makes a step states the rule that it stands for (table 1, table 2, the safety
rule) and the other readings that the document leaves open; it never calls `spec.codec.judge`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache

from bilprov.conformance.oracle.choices import verdict_of
from bilprov.conformance.oracle.state_model import FAULT, FrameEffect
from bilprov.conformance.oracle.verdicts import Accepted
from bilprov.spec.codec import all_data, bad_data, build, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.open_points import other_answers
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.readings import POINTS


class FrameClass(StrEnum):
    """The classes of frames; the id of a case of single frames begins with it."""

    VALID = "valid"
    UNUSED_ID = "unused-id"
    WRONG_LENGTH = "wrong-length"
    BAD_DATA = "bad-data"
    TRUNCATED = "truncated"
    RECOVERY = "recovery"


@dataclass(frozen=True, slots=True)
class Step:
    """One frame: its bytes, class, accepted answers (the expected first) and effect.

    `point` is the open point that decides between the answers, `reading` the one that the frame is
    about; `clause` is where its rule stands. Of a `truncated` frame some bytes never come.
    """

    frame: bytes
    kind: FrameClass
    accepted: tuple[Accepted, ...]
    frame_effect: FrameEffect
    clause: str
    point: str = ""
    reading: str = ""
    truncated: bool = field(default=False)

    @property
    def faulty(self) -> bool:
        """Whether the frame is a faulty instruction, which stops the robot."""
        return self.frame_effect.effect is None


def code_of(protocol: Protocol, outcome: Outcome) -> int:
    """The response code of an outcome."""
    return protocol.answers[outcome].code


@lru_cache(maxsize=1 << 6)
def _others(protocol: Protocol, point: str) -> tuple[Accepted, ...]:
    """The answers that other choices of an open point allow; none for "", no point."""
    return tuple(
        Accepted(() if code is None else (code,), verdict_of(point, word), reading, word)
        for code, reading, word in (other_answers(protocol, point) if point else ())
    )


def valid_frame(protocol: Protocol, spec: InstructionSpec, values: Mapping[str, int]) -> Step:
    """A valid instruction with these field values."""
    frame = build(protocol, spec.name, values)
    accepted = (Accepted((code_of(protocol, Outcome.VALID),)),)
    clause = protocol.clauses.instructions
    return Step(frame, FrameClass.VALID, accepted, FrameEffect(spec.effect, dict(values)), clause)


@lru_cache(maxsize=1 << 6)
def valid_frames(protocol: Protocol, name: str) -> tuple[Step, ...]:
    """The instruction with valid data, over the whole range of each field."""
    spec = protocol.by_name[name]
    return tuple(valid_frame(protocol, spec, spec.decode(data)) for data in all_data(spec))


@lru_cache(maxsize=1 << 6)
def bad_data_frames(protocol: Protocol, name: str) -> tuple[Step, ...]:
    """The instruction with data of the right length, one field of which is out of its range."""
    spec = protocol.by_name[name]
    return tuple(bad_data_frame(protocol, spec, data) for data in bad_data(spec))


@lru_cache(maxsize=1 << 12)
def unused_id_frame(protocol: Protocol, identity: int, length: int, data: bytes) -> Step:
    """An unused ID with `length` data bytes, all of which follow."""
    point = "R-unused-length" if length else ""
    return Step(
        raw_frame(protocol, identity, length, data),
        FrameClass.UNUSED_ID,
        (Accepted((code_of(protocol, Outcome.UNKNOWN_ID),)), *_others(protocol, point)),
        FAULT,
        protocol.clauses.instructions,
        point,
        point,
    )


@lru_cache(maxsize=1 << 12)
def wrong_length_frame(protocol: Protocol, spec: InstructionSpec, length: int, data: bytes) -> Step:
    """A known instruction that announces another length than its own; all `length` bytes follow."""
    many = length > spec.length
    outcome = Outcome.TOO_MANY if many else Outcome.TOO_FEW
    # Data out of range *and* too many: judging the data first is a legal other reading.
    point = "R-competing-errors" if many and not spec.in_range(data) else ""
    return Step(
        raw_frame(protocol, spec.id, length, data),
        FrameClass.WRONG_LENGTH,
        (Accepted((code_of(protocol, outcome),)), *_others(protocol, point)),
        FAULT,
        protocol.clauses.responses,
        point,
        point or "R-known-length",
    )


def bad_data_frame(protocol: Protocol, spec: InstructionSpec, data: bytes) -> Step:
    """A known instruction of the right length with data out of range."""
    reading = next((f.reading for f in spec.fields if f.reading), "")
    return Step(
        raw_frame(protocol, spec.id, spec.length, data),
        FrameClass.BAD_DATA,
        (Accepted((code_of(protocol, Outcome.BAD_DATA),)),),
        FAULT,
        protocol.clauses.instructions,
        reading if reading in POINTS else "",
        reading,
    )


@lru_cache(maxsize=1 << 13)
def truncated_frame(protocol: Protocol, identity: int, length: int, data: bytes) -> Step:
    """A frame of which only `data` arrive, fewer bytes than the `length` it announces."""
    spec = protocol.by_id.get(identity)
    if spec is None:
        outcome, point = Outcome.UNKNOWN_ID, "R-truncated-unused"
    elif length > spec.length:
        outcome, point = Outcome.TOO_FEW, "R-truncated-long"
    else:
        outcome, point = Outcome.TOO_FEW, "R-truncated-known"
    return Step(
        raw_frame(protocol, identity, length, data),
        FrameClass.TRUNCATED,
        (Accepted((code_of(protocol, outcome),)), *_others(protocol, point)),
        FAULT,
        protocol.clauses.responses if spec else protocol.clauses.instructions,
        point,
        point,
        truncated=True,
    )


def open_frames(protocol: Protocol) -> dict[str, Step]:
    """A frame for each open point about the answer to a single frame, by the point's id."""
    fill = bytes([protocol.pad_byte])
    steps: list[Step] = []
    longest = protocol.data_lengths[-1]
    if protocol.unused_ids:
        length = min(2, longest)
        steps.append(unused_id_frame(protocol, protocol.unused_ids[0], length, fill * length))
    shorter = (s for s in protocol.instructions if s.length < longest)
    first_bad = next(((s, d) for s in shorter for d in bad_data(s)), None)
    if first_bad:
        spec, data = first_bad
        steps.append(wrong_length_frame(protocol, spec, spec.length + 1, data + fill))
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        steps.append(truncated_frame(protocol, carrying.id, carrying.length, b""))
        if carrying.length < longest:
            steps.append(truncated_frame(protocol, carrying.id, carrying.length + 1, b""))
    if protocol.unused_ids:
        steps.append(truncated_frame(protocol, protocol.unused_ids[0], 1, b""))
    return {step.point: step for step in steps}


@lru_cache(maxsize=1 << 14)
def complete_frame(protocol: Protocol, header: int, data: bytes) -> Step:
    """A header byte with all the data that it announces, as a step of whatever class it is."""
    identity, length = protocol.headers[header]
    spec = protocol.by_id.get(identity)
    if spec is None:
        return unused_id_frame(protocol, identity, length, data)
    if length != spec.length:
        return wrong_length_frame(protocol, spec, length, data)
    if spec.in_range(data):
        return valid_frame(protocol, spec, spec.decode(data))
    return bad_data_frame(protocol, spec, data)
