"""Faults in response codes, in instructions under another ID, and at power-on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    ALL_FAULTY,
    SEQUENCE,
    answers_with,
    as_if,
    every,
    faulty,
    is_outcome,
    valid,
    when,
)
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import State
from bilprov.spec.protocol import InstructionSpec, Protocol

_FAMILY = "code"


def code_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield faults with wrong codes by a rule, instructions under other IDs, power-on faults."""
    ok = protocol.answers[Outcome.VALID].code
    codes = sorted(protocol.codes)
    for spec in protocol.responses[2:]:
        yield _fault(
            f"always-{spec.code}",
            f"answers {spec.name} to everything, but acts rightly",
            answers_with(spec.code),
        )
    for code in (codes[-1] + 1, 255):
        yield _fault(
            f"faults-get-{code}",
            f"answers {code}, an unused code, to every fault while it stands",
            when(every(faulty, lambda e: not e.before.moving), answers_with(code)),
        )
    rules: dict[str, tuple[str, Callable[[Event, int], int]]] = {
        "code-of-frame-before": (
            "answers each frame with the code of the one before",
            lambda e, code: e.previous.response.code if e.previous else ok,
        ),
        "code-plus-one": (
            "answers faults with the next code",
            lambda e, code: code + (code != ok),
        ),
        "code-minus-one": (
            "answers faults with the code before the right one",
            lambda e, code: code - (code != ok),
        ),
        "code-inverted": ("answers faults with all bits turned", lambda e, code: (
            code if code == ok else ~code & 0xFF
        )),
        "code-in-ascii": ("answers with digits, as text", lambda e, code: code + ord("0")),
        "code-with-parity-bit": (
            "sets the highest bit of an answer with an odd number of ones",
            lambda e, code: code | (0x80 if code.bit_count() % 2 else 0),
        ),
        "code-is-the-id": (
            "answers faults with the ID of the instruction",
            lambda e, code: code if code == ok else e.judgement.id,
        ),
        "code-echoes-header": (
            "answers faults with their header",
            lambda e, code: code if code == ok else e.judgement.frame[0],
        ),
        "codes-reversed": (
            "has the codes of faults in the wrong order",
            lambda e, code: code if code == ok else codes[len(codes) - codes.index(code)],
        ),
    }  # fmt: skip
    for name, (doc, rule) in rules.items():
        yield _fault(name, doc, _coded(rule))
    yield _fault(
        "ok-to-faults-at-rest",
        "answers OK to a fault that finds it standing",
        when(every(faulty, lambda e: not e.before.moving), answers_with(ok)),
    )
    yield _fault(
        "last-error-sticks",
        "answers the valid instruction after a fault with the fault's code",
        when(
            lambda e: valid(e) and e.row > 0,
            lambda d, e, r: answers_with(e.previous.response.code)(d, e, r) if e.previous else r,
        ),
    )
    yield _fault(
        "header-code-once-it-failed",
        "answers any fault with the code of the first fault since power-on",
        _first_code,
    )
    many, few = (protocol.answers[o].code for o in (Outcome.TOO_MANY, Outcome.TOO_FEW))
    yield _fault(
        "too-many-is-too-few-at-speed-0",
        "answers too few for too many data bytes as long as its speed is 0",
        when(every(is_outcome(Outcome.TOO_MANY), lambda e: e.before.speed == 0), answers_with(few)),
    )
    yield _fault(
        "too-few-is-too-many-with-a-light-on",
        "answers too many for too few data bytes as long as its light is on",
        when(every(is_outcome(Outcome.TOO_FEW), lambda e: e.before.led > 0), answers_with(many)),
    )
    yield from _elsewhere(protocol)
    yield from _power_on(protocol)


def _elsewhere(protocol: Protocol) -> Iterator[Fault]:
    """Yield faults that take other IDs for the last instruction: the example's, both, none, all."""
    last = protocol.instructions[-1]
    ids = protocol.unused_ids
    if not ids or not last.effect.assignments:
        return
    for name, doc, taken, kept in (
        (f"{last.name}-as-id-{ids[0]}", f"takes ID {ids[0]} for {last.name}", ids[:1], False),
        (
            f"{last.name}-as-id-{ids[0]}-too",
            f"takes ID {ids[0]} for {last.name} as well",
            ids[:1],
            True,
        ),
        (f"no-{last.name}", f"knows no {last.name}: its ID is unused", (), False),
        (
            f"{last.name}-as-any-unused-id",
            f"takes every unused ID for {last.name}",
            ids,
            True,
        ),
    ):
        yield Fault(
            name.lower(),
            _FAMILY,
            doc,
            ("valid/*", "unused-id/*", *SEQUENCE),
            react=under_other_ids(last, taken, kept=kept),
            clauses=("instructions", "responses"),
        )


def _power_on(protocol: Protocol) -> Iterator[Fault]:
    fast = protocol.limits.get("speed", (0, 1))[1]
    turning = [s.effect.motion for s in protocol.instructions if s.effect.motion and not s.fields][
        -1:
    ]
    for motion in turning:
        yield Fault(
            "turns-at-power-on",
            "power-on",
            f"moves {motion.value} as soon as it is switched on",
            ("power-on/*",),
            power_on=State(motion=motion, speed=fast // 2),
            clauses=("safety", "instructions"),
        )
        yield Fault(
            "motion-set-at-power-on",
            "power-on",
            f"begins to move {motion.value} with the first speed: a motion is set at power-on",
            ("power-on/*",),
            power_on=State(motion=motion),
            clauses=("safety", "instructions"),
        )
    yield Fault(
        "first-frame-answered-twice",
        "power-on",
        "answers the first frame after power-on twice",
        ("power-on/*",),
        react=when(lambda e: e.frames == 0, lambda d, e, r: replace(r, answers=r.answers * 2)),
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "second-frame-unanswered",
        "power-on",
        "does not answer the second frame after power-on",
        ("power-on/lost",),
        react=when(lambda e: e.frames == 1, answers_with()),
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "first-fault-unanswered",
        "power-on",
        "does not answer the first fault after power-on",
        ("power-on/lost",),
        react=when(lambda e: faulty(e) and e.faults == 0, answers_with()),
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "banner-after-first-frame",
        "power-on",
        "introduces itself 5 ms after it has answered the first frame",
        ("power-on/*",),
        react=when(
            lambda e: e.frames == 0,
            lambda d, e, r: replace(r, answers=(*r.answers, *((5_000_000, c) for c in b"READY"))),
        ),
        clauses=("responses", "instructions"),
    )


def _fault(name: str, doc: str, react: React) -> Fault:
    caught = ALL_FAULTY if name in ("code-plus-one", "code-inverted") else SEQUENCE
    return Fault(name.lower(), _FAMILY, doc, caught, react=react, clauses=_CLAUSES)


_CLAUSES = ("responses", "instructions")


def _coded(rule: Callable[[Event, int], int]) -> React:
    return lambda device, event, reaction: answers_with(
        *(rule(event, code) & 0xFF for _, code in reaction.answers)
    )(device, event, reaction)


def _first_code(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if event.judgement.valid:
        return reaction
    code = device.memory.setdefault("code", event.judgement.response.code)
    return answers_with(code)(device, event, reaction)


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
