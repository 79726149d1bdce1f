"""Faults in how a device parses bytes into frames, and frames into instructions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, Reaction, answers
from bilprov.conformance.mutation.faults.vocabulary import CASES, CUT, EVERYTHING, is_outcome, when
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol


def parsing_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in how a device parses bytes into frames and instructions."""
    family = "parsing"
    ok = protocol.answers[Outcome.VALID].code
    yield Fault(
        "never-times-out",
        family,
        "waits for missing data for ever and keeps driving",
        CUT,
        timeout=None,
    )
    swapped = bytes(
        protocol.headers[protocol.header_bytes[length, identity]][1]
        if (length, identity) in protocol.header_bytes
        else length
        for identity, length in protocol.headers
    )
    yield Fault(
        "nibbles-swapped",
        family,
        "takes the length for the ID and the ID for the length",
        EVERYTHING,
        lengths=swapped,
        react=_judge_swapped,
    )
    for identity in protocol.unused_ids[:1] + protocol.unused_ids[-1:]:
        yield Fault(
            f"accepts-id-{identity}",
            family,
            f"takes the unused ID {identity} for an instruction: OK, no stop",
            (
                f"unused-id/{identity}/*",
                f"truncated/{identity}/*",
                *(CASES[Outcome.UNKNOWN_ID] if identity == protocol.unused_ids[0] else ()),
            ),
            react=when(
                lambda e, identity=identity: e.judgement.id == identity,  # type: ignore[misc]
                lambda d, e, r: replace(answers(r, ok), state=e.before),
            ),
        )
    for spec in protocol.instructions:
        for part in spec.fields:
            if part.bits and list(bad_data(spec)):
                bit = len(part.bits)
                yield Fault(
                    f"accepts-{spec.name.lower()}-bit-{bit}",
                    family,
                    f"{spec.name} takes bit {bit} for a colour too: OK, no stop",
                    ("bad-data/*", "recovery/bad-data/*"),
                    react=when(
                        is_outcome(Outcome.BAD_DATA),
                        lambda d, e, r, top=2 << bit: (  # type: ignore[misc]
                            replace(answers(r, ok), state=e.before)
                            if max(v for _, v in e.judgement.fields) < top
                            else r
                        ),
                    ),
                )
                yield Fault(
                    f"ignores-{spec.name.lower()}-upper-bits",
                    family,
                    f"{spec.name} ignores the bits that mean nothing: OK, no stop",
                    ("bad-data/*", "recovery/bad-data/*"),
                    react=when(
                        is_outcome(Outcome.BAD_DATA),
                        lambda d, e, r: replace(answers(r, ok), state=e.before),
                    ),
                )
    yield Fault(
        "one-byte-too-many-is-fine",
        family,
        "accepts one data byte more than an instruction takes",
        CASES[Outcome.TOO_MANY],
        react=when(
            lambda e: bool(
                e.judgement.instruction
                and e.kind == "instruction"
                and e.judgement.length == e.judgement.instruction.length + 1
            ),
            lambda d, e, r: replace(answers(r, ok), state=e.before),
        ),
    )
    header_only = bytes(
        0 if identity not in protocol.by_id else length for identity, length in protocol.headers
    )
    yield Fault(
        "runs-data-of-unused",
        family,
        "answers an unused ID at its header and runs its data as instructions",
        ("unused-id/*", "truncated/*"),
        lengths=header_only,
    )
    over = bytes(
        0 if identity in protocol.by_id and length > protocol.by_id[identity].length else length
        for identity, length in protocol.headers
    )
    yield Fault(
        "runs-data-of-too-long",
        family,
        "answers a known ID with too many data bytes at its header and runs them as instructions",
        ("wrong-length/*", "recovery/too-many/*", "truncated/*"),
        lengths=over,
        react=_code_of_length,
    )
    takes = bytes(
        protocol.by_id[identity].length
        if identity in protocol.by_id and length < protocol.by_id[identity].length
        else length
        for identity, length in protocol.headers
    )
    yield Fault(
        "swallows-missing-data",
        family,
        "takes the data that an instruction needs, whatever length its header says",
        ("wrong-length/*",),
        lengths=takes,
    )


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


def _code_of_length(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: answer too many data bytes to a header alone, which the kit judges as truncated."""
    judgement, protocol = event.judgement, device.protocol
    known = judgement.instruction
    if known and len(judgement.frame) == 1 and judgement.length > known.length:
        return answers(reaction, protocol.answers[Outcome.TOO_MANY].code)
    return reaction
