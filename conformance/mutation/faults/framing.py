"""Faults in framing: from bytes on the line to frames, and from headers to instructions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, Reaction, answers
from bilprov.conformance.mutation.faults.family import (
    CASES,
    CUT,
    EVERYTHING,
    SEQUENCE,
    WATCHED,
    Family,
)
from bilprov.conformance.mutation.faults.vocabulary import (
    Condition,
    accepts,
    answers_as,
    every,
    has_id,
    is_outcome,
    is_whole,
    when,
)
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

parsing_fault = Family("parsing", "header instructions responses safety", EVERYTHING)
line_fault = Family("line", "header responses instructions safety", EVERYTHING)
data_run_fault = Family("delivery", "header instructions responses", (*SEQUENCE, *CUT))


def parsing_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in how a device parses bytes into frames and instructions."""
    by_id = protocol.by_id
    yield parsing_fault(
        "never-times-out",
        "waits for missing data for ever and keeps driving",
        caught_by=CUT,
        timeout=None,
    )
    yield parsing_fault(
        "nibbles-swapped",
        "takes the length for the ID and the ID for the length",
        _judge_swapped,
        lengths=bytes(i if (n, i) in protocol.header_bytes else n for i, n in protocol.headers),
    )
    for identity in protocol.unused_ids[:1] + protocol.unused_ids[-1:]:
        first = CASES[Outcome.UNKNOWN_ID] if identity == protocol.unused_ids[0] else ()
        yield parsing_fault(
            f"accepts-id-{identity}",
            f"takes the unused ID {identity} for an instruction: OK, no stop",
            when(has_id(identity), accepts),
            caught_by=(f"unused-id/{identity}/*", f"truncated/{identity}/*", *first),
        )
    for spec in protocol.instructions:
        for part in spec.fields:
            if part.bits and list(bad_data(spec)):
                bit = len(part.bits)
                yield parsing_fault(
                    f"accepts-{spec.name}-bit-{bit}",
                    f"{spec.name} takes bit {bit} for a colour too: OK, no stop",
                    when(every(is_outcome(Outcome.BAD_DATA), _all_below(2 << bit)), accepts),
                    caught_by=WATCHED[Outcome.BAD_DATA],
                )
                yield parsing_fault(
                    f"ignores-{spec.name}-upper-bits",
                    f"{spec.name} ignores the bits that mean nothing: OK, no stop",
                    when(is_outcome(Outcome.BAD_DATA), accepts),
                    caught_by=WATCHED[Outcome.BAD_DATA],
                )
    yield parsing_fault(
        "one-byte-too-many-is-fine",
        "accepts one data byte more than an instruction takes",
        when(every(is_whole, lambda e: _excess(e) == 1), accepts),
        caught_by=CASES[Outcome.TOO_MANY],
    )
    yield parsing_fault(
        "runs-data-of-unused",
        "answers an unused ID at its header and runs its data as instructions",
        caught_by=("unused-id/*", "truncated/*"),
        lengths=_cut_to_header(protocol, {(i, n) for i, n in protocol.headers if i not in by_id}),
    )
    yield parsing_fault(
        "runs-data-of-too-long",
        "answers a known ID with too many data bytes at its header and runs them as instructions",
        when(_header_of_too_many, answers_as(Outcome.TOO_MANY)),
        caught_by=("wrong-length/*", "recovery/too-many/*", "truncated/*"),
        lengths=_cut_to_header(protocol, _too_long(protocol)),
    )
    yield parsing_fault(
        "swallows-missing-data",
        "takes the data that an instruction needs, whatever length its header announces",
        caught_by=("wrong-length/*",),
        lengths=bytes(max(n, by_id[i].length) if i in by_id else n for i, n in protocol.headers),
    )


def line_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults of the serial line: an echo, a dead line, lost flow-control bytes."""
    xon, xoff = 0x11, 0x13
    yield line_fault(
        "echo", "sends back what it gets: a loop-back plug", caught_by=(), exit=2, hear=_echo
    )
    yield line_fault(
        "dead", "never answers anything", caught_by=(), exit=2, hear=lambda d, data, now: b""
    )
    yield line_fault(
        "xon-xoff",
        "its line eats the flow-control bytes XON and XOFF",
        hear=lambda d, data, now: bytes(b for b in data if b not in (xon, xoff)),
    )


def data_run_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that run the data of one ID, or of one length, as instructions."""
    for one in protocol.unused_ids[len(protocol.unused_ids) // 2 :][:1]:
        yield data_run_fault(
            f"runs-data-of-id-{one}",
            f"answers the unused ID {one} at its header and runs its data as instructions",
            caught_by=(f"unused-id/{one}/*", f"truncated/{one}/*"),
            lengths=_cut_to_header(protocol, {(i, n) for i, n in protocol.headers if i == one}),
        )
    for length in (2, protocol.data_lengths[-1]):
        refused = {(i, n) for i, n in _too_long(protocol) if n == length}
        yield data_run_fault(
            f"runs-data-of-length-{length}",
            f"refuses a known ID with {length} data bytes at its header and runs the data",
            when(_header_of_too_many, answers_as(Outcome.TOO_MANY)),
            lengths=_cut_to_header(protocol, refused),
        )


def _too_long(protocol: Protocol) -> set[tuple[int, int]]:
    """Return the (ID, length) of the headers of known IDs with too many data bytes."""
    by_id = protocol.by_id
    return {(i, n) for i, n in protocol.headers if i in by_id and n > by_id[i].length}


def _cut_to_header(protocol: Protocol, headers: set[tuple[int, int]]) -> bytes:
    """Return the data length of each header byte, 0 for these headers, each (ID, length)."""
    return bytes(0 if header in headers else header[1] for header in protocol.headers)


def _all_below(end: int) -> Condition:
    """Return a trigger: each field is smaller than `end`."""
    return lambda event: max(value for _, value in event.judgement.fields) < end


def _excess(event: Event) -> int:
    """Return how many data bytes a known ID has too many by its header, 0 for an unknown ID."""
    known = event.judgement.instruction
    return event.judgement.length - known.length if known else 0


def _header_of_too_many(event: Event) -> bool:
    """Trigger: a header with too many data bytes that came alone, judged as truncated."""
    return is_whole(event) and len(event.judgement.frame) == 1 and _excess(event) > 0


def _judge_swapped(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: act on the swapped header; one that fits no instruction is an unknown ID."""
    protocol = device.protocol
    swapped = protocol.header_bytes.get((event.judgement.length, event.judgement.id))
    spec = protocol.by_id.get(event.judgement.length)
    if swapped is None or spec is None or event.judgement.id != spec.length:
        code = protocol.answers[Outcome.UNKNOWN_ID].code
        return replace(answers(reaction, code), state=protocol.on_fault.apply(event.before))
    fields = {f.name: f.low for f in spec.fields}
    ok = protocol.answers[Outcome.VALID].code
    return replace(answers(reaction, ok), state=spec.effect.apply(event.before, fields))


def _echo(device: MutatedDevice, data: bytes, now: int) -> bytes:
    for byte in data:
        device.answer(byte, now)
    return b""
