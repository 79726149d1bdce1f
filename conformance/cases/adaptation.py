"""A frame as the device under test reads it: what the options allow and the device has chosen.

A device may take the LED's instruction under another ID, not know it at all, take the data of an
unused ID for instructions, or ignore upper bits. Where that was allowed, and seen, the suite sends
and expects accordingly, so that the rest of the device is still judged in full.
"""

from __future__ import annotations

from dataclasses import replace

from conformance.cases.steps import Accepted, Class, Step, code_of, cut, unused
from conformance.oracle.choices import Choices
from conformance.oracle.state_model import FAULT, Deed
from conformance.oracle.verdicts import Verdict
from spec.fields import Outcome
from spec.protocol import InstructionSpec, Protocol


def led_instruction(protocol: Protocol) -> InstructionSpec | None:
    """The instruction that switches the LED (R-led-id, R-version)."""
    return next((s for s in protocol.instructions if s.effect.sets("led") and s.fields), None)


def on_the_wire(protocol: Protocol, choices: Choices, frame: bytes) -> bytes:
    """The frame with its LED ID as the device takes it; b"" for one that it does not know."""
    if not frame or not choices.others:
        return frame
    led = led_instruction(protocol)
    if led is None:
        return frame
    identity, length = protocol.headers[frame[0]]
    if choices.is_other("R-version"):
        return b"" if identity == led.id else frame
    if choices.is_other("R-led-id") and choices.led_id is not None:
        swapped = {led.id: choices.led_id, choices.led_id: led.id}.get(identity, identity)
        return bytes([protocol.header_bytes[swapped, length]]) + frame[1:]
    return frame


def as_chosen(protocol: Protocol, choices: Choices, step: Step) -> Step:
    """The step as it is sent to, and judged on, a device with these choices."""
    if choices.others.isdisjoint(_POINTS):
        return step
    identity, length = protocol.headers[step.frame[0]]
    data = step.frame[1:]
    led = led_instruction(protocol)
    if choices.is_other("R-version") and led is not None and identity == led.id:
        make = cut if step.cut else unused
        step = _as_unused(protocol, make(protocol, protocol.unused_ids[0], length, data), step)
    elif choices.is_other("R-led-id"):
        step = replace(step, frame=on_the_wire(protocol, choices, step.frame))
        identity = protocol.headers[step.frame[0]][0]
    spec = protocol.by_id.get(identity)
    nobody = step.kind is Class.UNUSED_ID or (step.kind is Class.TRUNCATED and spec is None)
    if nobody and choices.word("R-drain-unused") == "run" and length:
        only = unused(protocol, protocol.unused_ids[0], length, data[:length].ljust(length, b"\0"))
        return replace(_as_unused(protocol, only, step), frame=step.frame[:1], cut=False)
    bad = step.faulty and not step.cut and spec is not None and length == spec.length
    if bad and spec is not None and choices.is_other("R-led-upper-bits"):
        values = {f.name: f.parse(data[f.offset :][: f.size]) & f.high for f in spec.fields}
        ok = (code_of(protocol, Outcome.VALID),)
        accepted = (Accepted(ok, Verdict.NON_STRICT, "R-led-upper-bits", "ignored"),)
        return replace(step, accepted=accepted, deed=Deed(spec.effect, values))
    return step


_POINTS = ("R-version", "R-led-id", "R-drain-unused", "R-led-upper-bits")


def _as_unused(protocol: Protocol, model: Step, step: Step) -> Step:
    """The step, judged as a frame with an unused ID."""
    return replace(
        step,
        kind=model.kind,
        accepted=model.accepted,
        deed=FAULT,
        clause=model.clause,
        point=model.point,
        reading=model.reading,
    )
