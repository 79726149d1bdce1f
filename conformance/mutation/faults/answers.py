"""Faults in the answers: wrong codes, too many or too few answers, late or early answers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, Reaction
from bilprov.conformance.dut.fault import answers as answered
from bilprov.conformance.mutation.faults.vocabulary import (
    ALL_FAULTY,
    CASES,
    CUT,
    EVERYTHING,
    WHOLE_FAULTS,
    answers_with,
    faults_only,
    is_outcome,
    is_truncated,
    slug,
    when,
)
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol


def answer_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the code, number and time of answers."""
    family = "answer"
    ok = protocol.answers[Outcome.VALID].code
    unused = next(code for code in range(256) if code not in protocol.codes)
    for outcome, spec in protocol.answers.items():
        if outcome is Outcome.VALID:
            continue
        others = [s for s in protocol.responses if s.code not in (spec.code, ok)]
        # The competing-errors and unused-length readings allow some others: take one they forbid.
        other = (
            others[0] if outcome is not Outcome.UNKNOWN_ID else protocol.answers[Outcome.BAD_DATA]
        )
        name = slug(outcome)
        yield Fault(
            f"ok-to-{name}",
            family,
            f"answers {protocol.answers[Outcome.VALID].name} to {outcome.value}, but stops",
            CASES[outcome],
            react=when(is_outcome(outcome), answers_with(ok)),
        )
        yield Fault(
            f"wrong-code-for-{name}",
            family,
            f"answers {other.name} where {spec.name} is due",
            CASES[outcome],
            react=when(is_outcome(outcome), answers_with(other.code)),
        )
    yield Fault(
        "wrong-code-for-truncated",
        family,
        f"answers {protocol.answers[Outcome.BAD_DATA].name} to a frame that is cut short",
        CUT,
        react=when(is_truncated, answers_with(protocol.answers[Outcome.BAD_DATA].code)),
    )
    yield Fault(
        "unused-code-for-valid",
        family,
        f"answers {unused}, an unused code, to valid instructions",
        EVERYTHING,
        react=when(is_outcome(Outcome.VALID), answers_with(unused)),
    )
    yield Fault(
        "unused-code-for-faults",
        family,
        f"answers {unused}, an unused code, to faulty instructions",
        ALL_FAULTY,
        react=faults_only(answers_with(unused)),
    )
    for spec in protocol.responses[:2]:
        yield Fault(
            f"always-{spec.code}",
            family,
            f"answers {spec.name} to everything, but acts rightly",
            ALL_FAULTY if spec.outcome is Outcome.VALID else EVERYTHING,
            react=answers_with(spec.code),
        )
    yield Fault(
        "double-answer",
        family,
        "answers everything twice",
        EVERYTHING,
        react=_twice,
    )
    yield Fault(
        "double-answer-to-faults",
        family,
        "answers faulty instructions twice",
        ALL_FAULTY,
        react=faults_only(_twice),
    )
    yield Fault(
        "late-second-answer",
        family,
        "answers faulty instructions a second time, 10 ms later",
        ALL_FAULTY,
        react=faults_only(lambda d, e, r: replace(r, answers=(*r.answers, (10 * MS, ok)))),
    )
    yield Fault(
        "silent-on-faults",
        family,
        "does not answer faulty whole frames, but stops",
        WHOLE_FAULTS,
        react=when(lambda e: not e.judgement.valid and not is_truncated(e), answers_with()),
    )
    yield Fault(
        "answers-too-late",
        family,
        "answers faulty instructions only after 1.2 times the longest time that is allowed",
        ALL_FAULTY,
        react=faults_only(
            lambda d, e, r: answered(
                r,
                *(code for _, code in r.answers),
                delay=int(protocol.timing.answer_longest * 1.2 * MS),
            )
        ),
    )
    if any(spec.length for spec in protocol.instructions):
        carrying = {(s.id, s.length) for s in protocol.instructions if s.length}
        yield Fault(
            "answers-at-header",
            family,
            "answers an instruction with data at its header already, and again at its end",
            EVERYTHING,
            begins=lambda d, byte: (ok,) if protocol.headers[byte] in carrying else (),
        )


def _twice(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    return replace(reaction, answers=reaction.answers * 2)
