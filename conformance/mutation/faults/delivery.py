"""Faults triggered by fast delivery: pipelined instructions, and full buffers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, Hear, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    PIPELINED,
    after_a_fault,
    answers_with,
    drives_on,
    every,
    faulty,
    is_named,
    late,
    pipelined,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

_FAMILY = "delivery"
_MOTIONS = list(Motion)


def delivery_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show only if the host does not wait for each answer."""
    ok = protocol.answers[Outcome.VALID].code
    lost = answers_with()
    yield _fault(
        "sent-ahead-lost",
        "loses a frame that comes before the answer to the frame before has gone",
        when(pipelined, _both(drives_on, lost)),
    )
    yield _fault(
        "sent-ahead-valid-lost",
        "loses a valid instruction that comes before the answer has gone, but no faulty one",
        when(every(pipelined, valid), _both(drives_on, lost)),
    )
    yield _fault(
        "sent-ahead-merged",
        "carries out what is sent ahead, and answers it and the frame before only once",
        when(pipelined, lost),
    )
    yield _fault(
        "sent-ahead-answered-not-done",
        "answers what is sent ahead and does not carry it out",
        when(every(pipelined, valid), drives_on),
    )
    yield _fault(
        "sent-ahead-fault-does-not-stop",
        "a fault that is sent ahead does not stop it",
        when(every(pipelined, faulty), drives_on),
        clauses=("safety", "instructions"),
    )
    yield _fault(
        "sent-ahead-fault-is-fine",
        f"answers {protocol.answers[Outcome.VALID].name} to a fault that is sent ahead, but stops",
        when(every(pipelined, faulty), answers_with(ok)),
    )
    yield _fault(
        "sent-ahead-fault-answered-twice",
        "answers a fault that is sent ahead twice",
        when(every(pipelined, faulty), twice),
    )
    yield _fault(
        "sent-ahead-answers-overtake",
        "answers valid instructions 3 ms late and faults at once: sent ahead, answers overtake",
        when(valid, late(3)),
    )
    yield _fault(
        "sent-ahead-answered-as-before",
        "answers what is sent ahead with the code of the frame before",
        when(
            pipelined,
            lambda d, e, r: (
                answers_with(e.previous.response.code)(d, e, r) if e.previous is not None else r
            ),
        ),
    )
    yield _fault(
        "sent-ahead-stop-lost",
        f"loses {protocol.stop.name} where it is sent ahead, answered all the same",
        when(every(pipelined, is_named(protocol.stop)), drives_on),
        clauses=("instructions",),
    )
    for setter in setters(protocol):
        yield _fault(
            f"sent-ahead-{setter.name}-ignored",
            f"{setter.name} sent ahead is answered and ignored",
            when(every(pipelined, is_named(setter)), drives_on),
            clauses=("instructions",),
        )
    for mover in movers(protocol)[::3]:
        yield _fault(
            f"sent-ahead-{mover.name}-ignored",
            f"{mover.name} sent ahead is answered and does not move it",
            when(every(pipelined, is_named(mover)), drives_on),
            clauses=("instructions",),
        )
    yield _fault(
        "runs-on-after-fault-in-a-burst",
        "a valid instruction sent ahead behind a fault brings back the motion from before it",
        _resume_in_burst,
        clauses=("safety",),
    )
    yield _fault(
        "merges-second-fault-in-a-burst",
        "answers two faults, the second sent ahead, only once",
        when(every(pipelined, faulty, after_a_fault), lost),
    )
    for run in (3, 5):
        yield _fault(
            f"queue-of-{run - 1}-frames",
            f"has room for {run - 1} frames: each further one that is sent ahead is lost",
            _queue(run - 1),
        )
    for size in (16, 32, 64):
        yield Fault(
            f"buffer-of-{size}-bytes",
            _FAMILY,
            f"loses what comes after {size} bytes without a pause: its buffer is full",
            PIPELINED,
            hear=_buffer(size),
            clauses=("responses", "instructions", "header"),
        )
    yield Fault(
        "ring-of-64-bytes-skips-its-end",
        _FAMILY,
        "loses the byte that falls on the end of its ring of 64 bytes, in a burst",
        PIPELINED,
        hear=_ring(64),
        clauses=("responses", "instructions", "header"),
    )
    yield Fault(
        "frame-across-32-bytes-torn",
        _FAMILY,
        "takes 32 bytes at a time and forgets a frame that lies across two such chunks",
        PIPELINED,
        hear=_torn(32),
        clauses=("responses", "instructions", "header"),
    )
    yield Fault(
        "deaf-while-it-answers-a-fault",
        _FAMILY,
        "loses the byte that comes while it sends the answer to a fault",
        PIPELINED,
        hear=_deaf_after_fault,
        clauses=("responses", "instructions", "header"),
    )
    yield Fault(
        "flushes-once",
        _FAMILY,
        "throws away what was sent ahead behind the first fault, and never again",
        PIPELINED,
        hear=_flush_once,
        clauses=("responses", "instructions", "header"),
    )


def _fault(
    name: str, doc: str, react: React, clauses: tuple[str, ...] = ("responses", "instructions")
) -> Fault:
    return Fault(name.lower(), _FAMILY, doc, PIPELINED, react=react, clauses=clauses)


def _both(one: React, other: React) -> React:
    return lambda device, event, reaction: other(device, event, one(device, event, reaction))


def _resume_in_burst(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not event.judgement.valid:
        if event.before.moving:
            device.memory["motion"] = _MOTIONS.index(event.before.motion)
        return reaction
    motion = device.memory.pop("motion", None)
    instruction = event.judgement.instruction
    settles = instruction is None or instruction.effect.sets("motion")
    if motion is None or settles or not event.pipelined:
        return reaction
    return replace(reaction, state=replace(reaction.state, motion=_MOTIONS[motion]))


def _queue(room: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        waiting = device.memory.get("waiting", 0) + 1 if event.pipelined else 1
        device.memory["waiting"] = min(waiting, room + 1)
        if waiting > room:
            return replace(reaction, answers=(), state=event.before)
        return reaction

    return react


def _burst(device: MutatedDevice, now: int) -> int:
    """Count a byte: return its number, from 1, since the line last paused."""
    memory = device.memory
    together = now - memory.get("byte at", -(1 << 60)) <= device.byte_time
    memory["burst"] = memory.get("burst", 0) + 1 if together else 1
    memory["byte at"] = now
    return memory["burst"]


def _buffer(size: int) -> Hear:
    return lambda device, data, now: b"" if _burst(device, now) > size else data


def _ring(size: int) -> Hear:
    return lambda device, data, now: b"" if _burst(device, now) % size == 0 else data


def _torn(size: int) -> Hear:
    def hear(device: MutatedDevice, data: bytes, now: int) -> bytes:
        if _burst(device, now) % size == 1 and device.held:
            device.drop()
        return data

    return hear


def _deaf_after_fault(device: MutatedDevice, data: bytes, now: int) -> bytes:
    over = device.over_at
    if device.row == 0 or device.held or over is None:
        return data
    return b"" if now - over <= device.byte_time else data


def _flush_once(device: MutatedDevice, data: bytes, now: int) -> bytes:
    if device.faults == 0 or device.memory.get("flushed") == 2:
        return data
    if now - max(device.over_at or 0, device.memory.get("flushed at", 0)) <= device.byte_time:
        device.memory["flushed"], device.memory["flushed at"] = 1, now
        return b""
    device.memory["flushed"] = 2
    device.memory.pop("flushed at", None)
    return data
