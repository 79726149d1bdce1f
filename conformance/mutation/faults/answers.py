"""Faults in the answers: wrong codes, too many or too few, and instructions under other IDs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction, answers
from bilprov.conformance.mutation.faults.family import (
    ALL_FAULTY,
    CASES,
    CUT,
    EVERYTHING,
    SEQUENCE,
    WHOLE_FAULTS,
    Family,
    slug,
)
from bilprov.conformance.mutation.faults.vocabulary import (
    answers_as,
    answers_as_before,
    answers_ok,
    answers_with,
    as_if,
    every,
    faulty,
    is_outcome,
    is_truncated,
    is_whole,
    late,
    silent,
    standing,
    twice,
    valid,
    when,
)
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol

answer_fault = Family("answer", "responses instructions", ALL_FAULTY)
code_fault = Family("code", "responses instructions")


def answer_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the code, number and time of answers."""
    ok, bad = protocol.answers[Outcome.VALID], protocol.answers[Outcome.BAD_DATA]
    unused = next(code for code in range(256) if code not in protocol.codes)
    for outcome, due in protocol.answers.items():
        if outcome is Outcome.VALID:
            continue
        others = [spec for spec in protocol.responses if spec.code not in (due.code, ok.code)]
        # The competing-errors and unused-length readings allow some others: take one they forbid.
        other = bad if outcome is Outcome.UNKNOWN_ID else others[0]
        yield answer_fault(
            f"ok-to-{slug(outcome)}",
            f"answers {ok.name} to {outcome.value}, but stops",
            when(is_outcome(outcome), answers_ok),
            caught_by=CASES[outcome],
        )
        yield answer_fault(
            f"wrong-code-for-{slug(outcome)}",
            f"answers {other.name} where {due.name} is due",
            when(is_outcome(outcome), answers_with(other.code)),
            caught_by=CASES[outcome],
        )
    yield answer_fault(
        "wrong-code-for-truncated",
        f"answers {bad.name} to a frame that is cut short",
        when(is_truncated, answers_with(bad.code)),
        caught_by=CUT,
    )
    yield answer_fault(
        "unused-code-for-valid",
        f"answers {unused}, an unused code, to valid instructions",
        when(is_outcome(Outcome.VALID), answers_with(unused)),
        caught_by=EVERYTHING,
    )
    yield answer_fault(
        "unused-code-for-faults",
        f"answers {unused}, an unused code, to faulty instructions",
        when(faulty, answers_with(unused)),
    )
    for spec in protocol.responses[:2]:
        yield answer_fault(
            f"always-{spec.code}",
            f"answers {spec.name} to everything, but acts rightly",
            answers_with(spec.code),
            caught_by=ALL_FAULTY if spec.outcome is Outcome.VALID else EVERYTHING,
        )
    yield answer_fault("double-answer", "answers everything twice", twice, caught_by=EVERYTHING)
    yield answer_fault(
        "double-answer-to-faults", "answers faulty instructions twice", when(faulty, twice)
    )
    yield answer_fault(
        "late-second-answer",
        "answers faulty instructions a second time, 10 ms later",
        when(faulty, lambda d, e, r: replace(r, answers=(*r.answers, (10 * MS, ok.code)))),
    )
    yield answer_fault(
        "silent-on-faults",
        "does not answer faulty whole frames, but stops",
        when(every(faulty, is_whole), silent),
        caught_by=WHOLE_FAULTS,
    )
    yield answer_fault(
        "answers-too-late",
        "answers faulty instructions only after 1.2 times the longest time that is allowed",
        when(faulty, late(1.2 * protocol.timing.answer_longest)),
    )
    carrying = {(spec.id, spec.length) for spec in protocol.instructions if spec.length}
    if carrying:
        yield answer_fault(
            "answers-at-header",
            "answers an instruction with data at its header already, and again at its end",
            caught_by=EVERYTHING,
            begins=lambda d, byte: (ok.code,) if protocol.headers[byte] in carrying else (),
        )


def code_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults with wrong codes by a rule, and instructions under other IDs."""
    ok = protocol.answers[Outcome.VALID].code
    codes = sorted(protocol.codes)
    for spec in protocol.responses[2:]:
        yield code_fault(
            f"always-{spec.code}",
            f"answers {spec.name} to everything, but acts rightly",
            answers_with(spec.code),
        )
    for code in (codes[-1] + 1, 255):
        yield code_fault(
            f"faults-get-{code}",
            f"answers {code}, an unused code, to every fault while it stands",
            when(every(faulty, standing), answers_with(code)),
        )
    yield code_fault(
        "code-of-frame-before",
        "answers each frame with the code of the one before",
        _recoded(lambda e, code: e.previous.response.code if e.previous else ok),
    )
    for name, doc, rule, caught_by in (
        ("plus-one", "the next code", lambda e, code: code + 1, ALL_FAULTY),
        ("minus-one", "the code before the right one", lambda e, code: code - 1, SEQUENCE),
        ("inverted", "all bits turned", lambda e, code: ~code, ALL_FAULTY),
    ):
        change = when(faulty, _recoded(rule))
        yield code_fault(f"code-{name}", f"answers faults with {doc}", change, caught_by=caught_by)
    yield code_fault(
        "code-in-ascii",
        "answers with digits, as text",
        _recoded(lambda e, code: code + ord("0")),
    )
    yield code_fault(
        "code-with-parity-bit",
        "sets the highest bit of an answer with an odd number of ones",
        _recoded(lambda e, code: code | (0x80 if code.bit_count() % 2 else 0)),
    )
    for name, doc, rule in (
        ("is-the-id", "the ID of the instruction", lambda e, code: e.judgement.id),
        ("echoes-header", "their header", lambda e, code: e.judgement.frame[0]),
    ):
        change = when(faulty, _recoded(rule))
        yield code_fault(f"code-{name}", f"answers faults with {doc}", change)
    yield code_fault(
        "codes-reversed",
        "has the codes of faults in the wrong order",
        when(faulty, _recoded(lambda e, code: codes[len(codes) - codes.index(code)])),
    )
    yield code_fault(
        "ok-to-faults-at-rest",
        "answers OK to a fault that finds it standing",
        when(every(faulty, standing), answers_ok),
    )
    yield code_fault(
        "last-error-sticks",
        "answers the valid instruction after a fault with the fault's code",
        when(lambda e: valid(e) and e.row > 0, answers_as_before),
    )
    yield code_fault(
        "header-code-once-it-failed",
        "answers any fault with the code of the first fault since power-on",
        when(faulty, _first_code),
    )
    yield code_fault(
        "too-many-is-too-few-at-speed-0",
        "answers too few for too many data bytes as long as its speed is 0",
        when(
            every(is_outcome(Outcome.TOO_MANY), lambda e: e.before.speed == 0),
            answers_as(Outcome.TOO_FEW),
        ),
    )
    yield code_fault(
        "too-few-is-too-many-with-a-light-on",
        "answers too many for too few data bytes as long as its light is on",
        when(
            every(is_outcome(Outcome.TOO_FEW), lambda e: e.before.led > 0),
            answers_as(Outcome.TOO_MANY),
        ),
    )
    yield from _other_ids(protocol)


def _other_ids(protocol: Protocol) -> Iterator[Fault]:
    """Yield faults that take other IDs for the last instruction: the example's, both, none, all."""
    last, ids = protocol.instructions[-1], protocol.unused_ids
    if not ids or not last.effect.assignments:
        return
    name, one = last.name, ids[0]
    for fault, doc, taken, kept in (
        (f"{name}-as-id-{one}", f"takes ID {one} for {name}", ids[:1], False),
        (f"{name}-as-id-{one}-too", f"takes ID {one} for {name} as well", ids[:1], True),
        (f"no-{name}", f"knows no {name}: its ID is unused", (), False),
        (f"{name}-as-any-unused-id", f"takes every unused ID for {name}", ids, True),
    ):
        yield code_fault(
            fault,
            doc,
            under_other_ids(last, taken, kept=kept),
            clauses="instructions responses",
            caught_by=("valid/*", "unused-id/*", *SEQUENCE),
        )


def _recoded(rule: Callable[[Event, int], int]) -> React:
    """Return an effect: `rule` makes each code from the event and the correct code."""
    return lambda device, event, reaction: answers(
        reaction, *(rule(event, code) & 0xFF for _, code in reaction.answers)
    )


def _first_code(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: answer the code that the first frame on which it had this effect got."""
    return answers(reaction, device.memory.setdefault("code", event.judgement.response.code))


def under_other_ids(spec: InstructionSpec, ids: tuple[int, ...], *, kept: bool) -> React:
    """Return an effect: the IDs stand for the instruction; its own ID does too if `kept`."""

    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        protocol, judgement = device.protocol, event.judgement
        frame = judgement.frame
        if judgement.id in ids:
            own = bytes([protocol.header_bytes[spec.id, judgement.length]])
            return as_if(device, event, reaction, own + frame[1:])
        if judgement.id == spec.id and not kept:
            unused = protocol.header_bytes[protocol.unused_ids[-1], judgement.length]
            return as_if(device, event, reaction, bytes([unused]) + frame[1:])
        return reaction

    return react
