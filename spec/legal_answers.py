"""Answers that a device may give to a frame under a reading other than the default.

The generators of test cases state the same by rules of their own; a test checks that both agree.
"""

from __future__ import annotations

from typing import NamedTuple

from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

SILENCE_READING = "R-truncated-known"
"""The reading that lets a device stop at a truncated frame without an answer."""


class Choice(NamedTuple):
    """An answer that is legal under another reading; `code` is None for no answer at all."""

    code: int | None
    reading: str


def other_choices(protocol: Protocol, judgement: Judgement) -> tuple[Choice, ...]:
    """Return every answer, except the expected one, that some reading of the document allows."""
    if judgement.truncated:
        return (*_when_truncated(protocol, judgement), Choice(None, SILENCE_READING))
    spec = judgement.instruction
    if spec is None:
        outcomes = (Outcome.TOO_MANY, Outcome.TOO_FEW) if judgement.length else ()
        return _choices(protocol, "R-unused-length", *outcomes)
    if judgement.outcome is Outcome.TOO_MANY:
        data = judgement.frame[1:]
        values = ((f, f.parse(data[f.offset : f.offset + f.size])) for f in spec.fields)
        if any(not f.low <= value <= f.high for f, value in values):
            return _choices(protocol, "R-competing-errors", Outcome.BAD_DATA)
    return ()


def _when_truncated(protocol: Protocol, judgement: Judgement) -> tuple[Choice, ...]:
    spec = judgement.instruction
    if spec is None:
        return _choices(protocol, "R-truncated-unused", Outcome.TOO_FEW, Outcome.TOO_MANY)
    if judgement.length > spec.length:
        return _choices(protocol, "R-truncated-long", Outcome.TOO_MANY)
    return ()


def _choices(protocol: Protocol, reading: str, *outcomes: Outcome) -> tuple[Choice, ...]:
    return tuple(Choice(protocol.answers[outcome].code, reading) for outcome in outcomes)
