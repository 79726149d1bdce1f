"""Faults triggered by pauses: in split frames, truncated frames, and after an idle line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    CUT,
    SEQUENCE,
    SPLIT,
    answers_with,
    drives_on,
    every,
    faulty,
    is_truncated,
    split,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import setters
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

_FAMILY = "delivery"
_SLEEP = 150 * MS


def pause_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that only a pause on the line triggers."""
    yield from _split(protocol)
    yield from _time_outs(protocol)
    yield from _cut_short(protocol)
    yield from _data_run(protocol)
    yield Fault(
        "asleep-after-150-ms",
        _FAMILY,
        "falls asleep after 150 ms without a byte and loses the one that wakes it",
        SPLIT,
        hear=_asleep,
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "forgets-speed-when-idle",
        _FAMILY,
        "falls asleep after 150 ms without a byte while it stands, and has lost the speed then",
        SPLIT,
        react=_forgetful,
        clauses=("instructions",),
    )


def _split(protocol: Protocol) -> Iterator[Fault]:
    few = protocol.answers[Outcome.TOO_FEW].code
    changes: dict[str, tuple[str, React]] = {
        "split-is-too-few": (
            "answers a frame with a pause of more than 1 ms as one with too few data, and stops",
            lambda d, e, r: replace(
                answers_with(few)(d, e, r), state=protocol.on_fault.apply(e.before)
            ),
        ),
        "split-is-ignored": ("answers it and does not carry it out", drives_on),
        "split-is-answered-twice": ("carries it out and answers it twice", twice),
        "split-is-not-answered": ("carries it out and does not answer it", answers_with()),
    }
    for name, (what, change) in changes.items():
        yield Fault(
            name,
            _FAMILY,
            what
            if what.startswith("answers a frame")
            else f"a valid frame with a pause of more than 1 ms: {what}",
            SPLIT,
            react=when(every(split, valid), change),
            clauses=("responses", "instructions", "header"),
        )
    yield Fault(
        "split-fault-does-not-stop",
        _FAMILY,
        "a whole faulty frame with a pause of more than 1 ms does not stop it",
        SPLIT,
        react=when(every(split, faulty, lambda e: not is_truncated(e)), drives_on),
        clauses=("safety", "instructions", "responses"),
    )
    for setter in setters(protocol)[-1:]:
        header = protocol.header_bytes[setter.id, setter.length]
        usual = int(protocol.timing.truncation_timeout * MS)
        yield Fault(
            f"short-time-out-of-{setter.name.lower()}",
            _FAMILY,
            f"waits only 1 ms for the data of {setter.name}",
            SPLIT,
            timeouts=_except(header, MS, usual),
            clauses=("responses", "instructions", "header"),
        )


def _time_outs(protocol: Protocol) -> Iterator[Fault]:
    usual = int(protocol.timing.truncation_timeout * MS)
    few = protocol.answers[Outcome.TOO_FEW].code
    known = [identity in protocol.by_id for identity, _ in protocol.headers]
    yield Fault(
        "time-out-for-known-ids-only",
        _FAMILY,
        "waits for ever for the data of an unused ID",
        ("truncated/*",),
        timeouts=lambda byte: usual if known[byte] else None,
        clauses=("instructions", "responses", "safety"),
    )
    fitting = {
        protocol.header_bytes[spec.id, spec.length] for spec in protocol.instructions if spec.length
    }
    yield Fault(
        "time-out-for-valid-headers-only",
        _FAMILY,
        "waits for ever for the data of a header that no instruction has",
        ("truncated/*",),
        timeouts=lambda byte: usual if byte in fitting else None,
        clauses=("instructions", "responses", "safety"),
    )
    longest = protocol.data_lengths[-1]
    yield Fault(
        f"no-time-out-for-{longest}-bytes",
        _FAMILY,
        f"waits for ever for {longest} data bytes",
        ("truncated/*",),
        timeouts=lambda byte: None if protocol.headers[byte][1] == longest else usual,
        clauses=("instructions", "responses", "safety"),
    )
    yield Fault(
        "time-out-left-armed",
        _FAMILY,
        "forgets to disarm the time-out when the data of a valid frame have come: "
        "one more answer, unless another frame comes first",
        SPLIT,
        react=when(
            lambda e: valid(e) and e.judgement.length > 0,
            lambda d, e, r: replace(r, unasked=((usual, few),)),
        ),
        clauses=("responses", "instructions"),
    )


def _cut_short(protocol: Protocol) -> Iterator[Fault]:
    yield Fault(
        "frame-after-truncation-lost",
        _FAMILY,
        "loses the frame that follows one that was cut short",
        (*SEQUENCE, *CUT),
        react=when(
            lambda e: e.previous_kind == "truncated",
            lambda d, e, r: replace(r, answers=(), state=e.before),
        ),
        clauses=("responses", "instructions", "safety"),
    )
    yield Fault(
        "cut-frame-put-before-the-next",
        _FAMILY,
        "answers a frame that is cut short and stops, but puts its bytes before the next one",
        (*SEQUENCE, *CUT),
        remains=_put_aside,
        hear=_put_before,
        clauses=("responses", "instructions", "safety", "header"),
    )
    yield Fault(
        "cut-frame-answered-twice",
        _FAMILY,
        "answers a frame that is cut short twice",
        CUT,
        react=when(is_truncated, twice),
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "cut-frame-answered-again-later",
        _FAMILY,
        "answers a frame that is cut short again 30 ms later, unless another frame comes first",
        SPLIT,
        react=when(
            is_truncated,
            lambda d, e, r: replace(r, unasked=((30 * MS, e.judgement.response.code),)),
        ),
        clauses=("responses", "instructions"),
    )
    yield Fault(
        "data-of-cut-frame-run",
        _FAMILY,
        "runs the data of a frame that is cut short as instructions",
        (*SEQUENCE, *CUT),
        remains=lambda device, frame: b"" if device.memory else frame[1:],
        clauses=("responses", "instructions", "safety", "header"),
    )


def _data_run(protocol: Protocol) -> Iterator[Fault]:
    middle = protocol.unused_ids[len(protocol.unused_ids) // 2 :][:1]
    for identity in middle:
        yield Fault(
            f"runs-data-of-id-{identity}",
            _FAMILY,
            f"answers the unused ID {identity} at its header and runs its data as instructions",
            (f"unused-id/{identity}/*", f"truncated/{identity}/*"),
            lengths=bytes(0 if i == identity else n for i, n in protocol.headers),
            clauses=("header", "instructions", "responses"),
        )
    for length in (2, protocol.data_lengths[-1]):
        yield Fault(
            f"runs-data-of-length-{length}",
            _FAMILY,
            f"refuses a known ID with {length} data bytes at its header and runs the data",
            (*SEQUENCE, *CUT),
            lengths=bytes(
                0 if n == length and i in protocol.by_id and protocol.by_id[i].length < n else n
                for i, n in protocol.headers
            ),
            react=_too_many_at_header,
            clauses=("header", "instructions", "responses"),
        )


def _except(header: int, timeout: int, usual: int) -> Callable[[int], int | None]:
    return lambda byte: timeout if byte == header else usual


def _too_many_at_header(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    known = event.judgement.instruction
    alone = len(event.judgement.frame) == 1
    if event.kind == "instruction" and alone and known and event.judgement.length > known.length:
        code = device.protocol.answers[Outcome.TOO_MANY].code
        return answers_with(code)(device, event, reaction)
    return reaction


def _asleep(device: MutatedDevice, data: bytes, now: int) -> bytes:
    before = device.memory.get("byte at")
    device.memory["byte at"] = now
    return b"" if before is not None and now - before > _SLEEP and not device.held else data


def _forgetful(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    idle = event.gap is not None and event.gap > _SLEEP and not event.before.moving
    if not idle:
        return reaction
    _, state = device.step(event.judgement.frame, replace(event.before, speed=0))
    return replace(reaction, state=state)


def _put_aside(device: MutatedDevice, frame: bytes) -> bytes:
    device.memory["aside"] = int.from_bytes(b"\1" + frame, "big")
    return b""


def _put_before(device: MutatedDevice, data: bytes, now: int) -> bytes:
    aside = device.memory.pop("aside", None)
    if aside is None:
        return data
    return aside.to_bytes((aside.bit_length() + 7) // 8, "big")[1:] + data
