"""One frame as the suite sends it: its bytes, the answers that may come, what it does.

Each maker states the rule that it stands for (table 1, table 2, the safety rule) and the other
readings that the document leaves open; it never asks the judge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from conformance.oracle.choices import POINTS
from conformance.oracle.state_model import FAULT, Deed
from conformance.oracle.verdicts import Verdict
from spec.codec import build, lying
from spec.fields import Outcome
from spec.protocol import InstructionSpec, Protocol


class Class(StrEnum):
    """The classes of frames; the id of a case of single frames begins with it."""

    VALID = "valid"
    UNUSED_ID = "unused-id"
    WRONG_LENGTH = "wrong-length"
    BAD_DATA = "bad-data"
    TRUNCATED = "truncated"
    RECOVERY = "recovery"


@dataclass(frozen=True, slots=True)
class Accepted:
    """A list of answers that may come, the verdict it earns and the reading it rests on.

    `word` is the choice of the case's point that it shows, "" for the default.
    """

    codes: tuple[int, ...]
    verdict: Verdict = Verdict.PASS
    reading: str = ""
    word: str = ""


@dataclass(frozen=True, slots=True)
class Step:
    """One frame: its bytes, class, accepted answers (the expected first) and deed.

    `point` is what the choice between the answers is about, `reading` what the frame is about;
    `clause` is where its rule stands. A cut frame is one of which some bytes never come.
    """

    frame: bytes
    kind: Class
    accepted: tuple[Accepted, ...]
    deed: Deed
    clause: str
    point: str = ""
    reading: str = ""
    cut: bool = field(default=False)

    @property
    def faulty(self) -> bool:
        """Whether the frame is a faulty instruction, which stops the robot."""
        return self.deed.effect is None


def code_of(protocol: Protocol, outcome: Outcome) -> int:
    """The response code of an outcome."""
    return protocol.answers[outcome].code


_WORDS = {Outcome.TOO_MANY: "too-many", Outcome.TOO_FEW: "too-few", Outcome.BAD_DATA: "data"}


def _others(protocol: Protocol, reading: str, *outcomes: Outcome) -> tuple[Accepted, ...]:
    return tuple(
        Accepted((code_of(protocol, o),), Verdict.NON_STRICT, reading, _WORDS[o]) for o in outcomes
    )


def valid(protocol: Protocol, spec: InstructionSpec, values: Mapping[str, int]) -> Step:
    """A valid instruction with these field values."""
    frame = build(protocol, spec.name, values)
    accepted = (Accepted((code_of(protocol, Outcome.VALID),)),)
    clause = protocol.clauses.instructions
    return Step(frame, Class.VALID, accepted, Deed(spec.effect, dict(values)), clause)


def unused(protocol: Protocol, identity: int, length: int, data: bytes) -> Step:
    """An unused ID with `length` data bytes, all of which follow."""
    others = _others(protocol, "R-unused-length", Outcome.TOO_MANY, Outcome.TOO_FEW)
    reading = "R-unused-length" if length else ""
    return Step(
        lying(protocol, identity, length, data),
        Class.UNUSED_ID,
        (Accepted((code_of(protocol, Outcome.UNKNOWN_ID),)), *(others if length else ())),
        FAULT,
        protocol.clauses.instructions,
        reading,
        reading,
    )


def wrong_length(protocol: Protocol, spec: InstructionSpec, length: int, data: bytes) -> Step:
    """A known instruction that announces, and brings, another length than its own."""
    many = length > spec.length
    outcome = Outcome.TOO_MANY if many else Outcome.TOO_FEW
    others: tuple[Accepted, ...] = ()
    if many and _out_of_range(spec, data):
        # Data out of range *and* too many: judging the data first is a legal other reading.
        others = _others(protocol, "R-competing-errors", Outcome.BAD_DATA)
    return Step(
        lying(protocol, spec.id, length, data),
        Class.WRONG_LENGTH,
        (Accepted((code_of(protocol, outcome),)), *others),
        FAULT,
        protocol.clauses.responses,
        "R-competing-errors" if others else "",
        "R-competing-errors" if others else "R-known-length",
    )


def _out_of_range(spec: InstructionSpec, data: bytes) -> bool:
    """Whether the data that the instruction would take hold a value that it does not."""
    parts = ((part, data[part.offset : part.offset + part.size]) for part in spec.fields)
    return any(not part.low <= part.parse(coded) <= part.high for part, coded in parts)


def bad(protocol: Protocol, spec: InstructionSpec, data: bytes) -> Step:
    """A known instruction of the right length with data out of range."""
    reading = next((f.reading for f in spec.fields if f.reading), "")
    return Step(
        lying(protocol, spec.id, spec.length, data),
        Class.BAD_DATA,
        (Accepted((code_of(protocol, Outcome.BAD_DATA),)),),
        FAULT,
        protocol.clauses.instructions,
        reading if reading in POINTS else "",
        reading,
    )


def cut(protocol: Protocol, identity: int, length: int, data: bytes) -> Step:
    """A frame of which only `data` arrive, fewer bytes than the `length` it announces."""
    spec = protocol.by_id.get(identity)
    silent = Accepted((), Verdict.NON_STRICT, "R-truncated-known", "silent")
    others: tuple[Accepted, ...] = ()
    if spec is None:
        outcome, reading = Outcome.UNKNOWN_ID, "R-truncated-unused"
        others = _others(protocol, reading, Outcome.TOO_FEW, Outcome.TOO_MANY)
    elif length > spec.length:
        outcome, reading = Outcome.TOO_FEW, "R-truncated-long"
        others = _others(protocol, reading, Outcome.TOO_MANY)
    else:
        outcome, reading = Outcome.TOO_FEW, "R-truncated-known"
    return Step(
        lying(protocol, identity, length, data),
        Class.TRUNCATED,
        (Accepted((code_of(protocol, outcome),)), *others, silent),
        FAULT,
        protocol.clauses.responses if spec else protocol.clauses.instructions,
        reading,
        reading,
        cut=True,
    )


def whole(protocol: Protocol, header: int, data: bytes) -> Step:
    """A header byte with all the data that it announces, whatever comes of it."""
    identity, length = protocol.headers[header]
    spec = protocol.by_id.get(identity)
    if spec is None:
        return unused(protocol, identity, length, data)
    if length != spec.length:
        return wrong_length(protocol, spec, length, data)
    values = {f.name: f.parse(data[f.offset : f.offset + f.size]) for f in spec.fields}
    if all(f.low <= values[f.name] <= f.high for f in spec.fields):
        return valid(protocol, spec, values)
    return bad(protocol, spec, data)
