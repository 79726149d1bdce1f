"""Adapts a test step to the choices of the device under test, where the options allow them.

A device may take the LED's instruction under another ID, not know it at all, take the data of an
unused ID for instructions, or ignore upper bits. Where such a choice was allowed, and observed, the
suite sends and expects accordingly, so that the rest of the device is still judged in full.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from bilprov.conformance.cases.steps import FrameClass, Step, code_of, framed
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import FAULT, FrameEffect
from bilprov.conformance.oracle.verdicts import Accepted, Verdict
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol

S = TypeVar("S", bound=Step)


def led_instruction(protocol: Protocol) -> InstructionSpec | None:
    """The instruction that switches the LED (R-led-id, R-version)."""
    lit = (s for s in protocol.instructions if any(map(s.effect.sets, protocol.lights)))
    return next((spec for spec in lit if spec.fields), None)


def on_the_wire(protocol: Protocol, choices: Choices, frame: bytes) -> bytes:
    """The frame with the LED ID that the device uses; b"" if the device does not know the frame."""
    if not frame or not choices.others:
        return frame
    led = led_instruction(protocol)
    if led is None:
        return frame
    identity, length = protocol.headers[frame[0]]
    if choices.differs("R-version"):
        return b"" if identity == led.id else frame
    if choices.differs("R-led-id") and choices.led_id is not None:
        swapped = {led.id: choices.led_id, choices.led_id: led.id}.get(identity, identity)
        return bytes([protocol.header_bytes[swapped, length]]) + frame[1:]
    return frame


def adapt_to_device(protocol: Protocol, choices: Choices, step: S) -> S:
    """The step as it is sent to a device with these choices, and judged there."""
    if choices.others.isdisjoint(_POINTS):
        return step
    identity, length = protocol.headers[step.frame[0]]
    data = step.frame[1:]
    led = led_instruction(protocol)
    if choices.differs("R-version") and led is not None and identity == led.id:
        step = _as_unused(framed(protocol, protocol.unused_ids[0], length, data), step)
    elif choices.differs("R-led-id"):
        step = replace(step, frame=on_the_wire(protocol, choices, step.frame))
        identity = protocol.headers[step.frame[0]][0]
    spec = protocol.by_id.get(identity)
    unused_id = step.kind is FrameClass.UNUSED_ID or (
        step.kind is FrameClass.TRUNCATED and spec is None
    )
    if unused_id and choices.word("R-drain-unused") == "run" and length:
        whole = data[:length].ljust(length, b"\0")
        only = framed(protocol, protocol.unused_ids[0], length, whole)
        return replace(_as_unused(only, step), frame=step.frame[:1], truncated=False)
    bad = step.faulty and not step.truncated and spec is not None and length == spec.length
    if bad and spec is not None and choices.differs("R-led-upper-bits"):
        found = spec.decode(data)
        values = {f.name: found[f.name] & f.high for f in spec.fields}
        ok = (code_of(protocol, Outcome.VALID),)
        accepted = (Accepted(ok, Verdict.NON_STRICT, "R-led-upper-bits", "ignored"),)
        return replace(step, accepted=accepted, frame_effect=FrameEffect(spec.effect, values))
    return step


_POINTS = ("R-version", "R-led-id", "R-drain-unused", "R-led-upper-bits")


def _as_unused(model: Step, step: S) -> S:
    """The step, judged like `model`, which is a frame with an unused ID."""
    return replace(
        step,
        kind=model.kind,
        accepted=model.accepted,
        frame_effect=FAULT,
        clause=model.clause,
        point=model.point,
        reading=model.reading,
    )
