"""Judges the document's own examples by the grammar and reports those that contradict it."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.spec.codec import judge, nearest
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import ERRATA, EXAMPLES, Erratum, Example


@dataclass(frozen=True, slots=True)
class Finding:
    """An example line that a conforming device refuses.

    `sent` is the line's bytes, `meant` the nearest valid frame, `erratum` the entry that records
    the contradiction (None if no entry does yet).
    """

    example: Example
    sent: bytes
    reason: str
    meant: bytes
    erratum: Erratum | None


def check(protocol: Protocol, examples: tuple[Example, ...] = EXAMPLES) -> tuple[Finding, ...]:
    """Return every example line that the grammar finds faulty. One line is one instruction."""
    findings = []
    for example in examples:
        sent = bytes(int(bits, 2) for bits in example.bits.split())
        framer = Framer(protocol, timeout=None)
        frames = [*framer.feed(sent, 0), *framer.drop(0, "truncated")]
        first = judge(protocol, frames[0].data)
        if first.valid and len(frames) == 1:
            continue
        extra = len(sent) - len(first.frame)
        reason = first.reason
        if extra:
            more = "1 byte more" if extra == 1 else f"{extra} bytes more"
            reason = f"{reason or first.describe()}; {more} in the line, read as a new header"
        known = next((e for e in ERRATA if e.example == (example.section, example.line)), None)
        meant = nearest(protocol, first.frame, sent[len(first.frame) :])
        findings.append(Finding(example, sent, reason, meant, known))
    return tuple(findings)
