"""Makes the result of a case from its axes and answers."""

from __future__ import annotations

from collections.abc import Iterable

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, worst
from bilprov.spec.codec import spaced


def result_of(
    case: Case | SequenceCase,
    axes: dict[str, Axis],
    heard: Iterable[tuple[int, int]] = (),
    sent: int = 0,
) -> CaseResult:
    """The result of a case with these axes; `heard` are its answers as (time in ns, code).

    `sent` is the time (ns) when its stimulus had been sent.
    """
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=worst(axis.verdict for axis in axes.values()),
        axes=axes,
        reading=next((a.reading for a in axes.values() if a.reading), case.reading),
        sent=tuple(spaced(frame) for frame in case.sent if frame),
        received=tuple(AnswerByte(f"{code:02x}", t - sent) for t, code in heard),
    )
