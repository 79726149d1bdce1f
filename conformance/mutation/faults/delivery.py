"""Faults in delivery: frames sent ahead or in bursts, split or cut short, or after an idle line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, Hear, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.family import CUT, PIPELINED, SEQUENCE, SPLIT, Family
from bilprov.conformance.mutation.faults.vocabulary import (
    after_a_fault,
    answers_again,
    answers_as,
    answers_as_before,
    answers_ok,
    becomes,
    drives_on,
    every,
    faulty,
    is_named,
    is_truncated,
    is_whole,
    late,
    loses,
    pipelined,
    restarts,
    silent,
    split,
    then,
    twice,
    valid,
    when,
)
from bilprov.spec.by_effect import movers, setters
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

burst_fault = Family("delivery", "responses instructions", PIPELINED)
burst_instruction_fault = Family("delivery", "instructions", PIPELINED)
buffer_fault = Family("delivery", "responses instructions header", PIPELINED)
split_fault = Family("delivery", "responses instructions header", SPLIT)
time_out_fault = Family("delivery", "instructions responses safety", ("truncated/*",))
cut_fault = Family("delivery", "responses instructions", CUT)
idle_fault = Family("delivery", "responses instructions", SPLIT)

_SLEEP = 150 * MS


def burst_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that show only if the host does not wait for each answer."""
    stop = protocol.stop
    yield burst_fault(
        "sent-ahead-lost",
        "loses a frame that comes before the answer to the frame before has gone",
        when(pipelined, loses),
    )
    yield burst_fault(
        "sent-ahead-valid-lost",
        "loses a valid instruction that comes before the answer has gone, but no faulty one",
        when(every(pipelined, valid), loses),
    )
    yield burst_fault(
        "sent-ahead-merged",
        "carries out what is sent ahead, and answers it and the frame before only once",
        when(pipelined, silent),
    )
    yield burst_fault(
        "sent-ahead-answered-not-done",
        "answers what is sent ahead and does not carry it out",
        when(every(pipelined, valid), drives_on),
    )
    yield burst_fault(
        "sent-ahead-fault-does-not-stop",
        "a fault that is sent ahead does not stop it",
        when(every(pipelined, faulty), drives_on),
        clauses="safety instructions",
    )
    yield burst_fault(
        "sent-ahead-fault-is-fine",
        f"answers {protocol.answers[Outcome.VALID].name} to a fault that is sent ahead, but stops",
        when(every(pipelined, faulty), answers_ok),
    )
    yield burst_fault(
        "sent-ahead-fault-answered-twice",
        "answers a fault that is sent ahead twice",
        when(every(pipelined, faulty), twice),
    )
    yield burst_fault(
        "sent-ahead-answers-overtake",
        "answers valid instructions 3 ms late and faults at once: sent ahead, answers overtake",
        when(valid, late(3)),
    )
    yield burst_fault(
        "sent-ahead-answered-as-before",
        "answers what is sent ahead with the code of the frame before",
        when(pipelined, answers_as_before),
    )
    yield burst_instruction_fault(
        "sent-ahead-stop-lost",
        f"loses {stop.name} where it is sent ahead, answered all the same",
        when(every(pipelined, is_named(stop)), drives_on),
    )
    ignored = [(setter, "is answered and ignored") for setter in setters(protocol)]
    ignored += [(mover, "is answered and does not move it") for mover in movers(protocol)[::3]]
    for spec, what in ignored:
        yield burst_instruction_fault(
            f"sent-ahead-{spec.name}-ignored",
            f"{spec.name} sent ahead {what}",
            when(every(pipelined, is_named(spec)), drives_on),
        )
    yield burst_fault(
        "runs-on-after-fault-in-a-burst",
        "a valid instruction sent ahead behind a fault brings back the motion from before it",
        restarts(every(valid, pipelined), settings=1),
        clauses="safety",
    )
    yield burst_fault(
        "merges-second-fault-in-a-burst",
        "answers two faults, the second sent ahead, only once",
        when(every(pipelined, faulty, after_a_fault), silent),
    )
    for room in (2, 4):
        yield burst_fault(
            f"queue-of-{room}-frames",
            f"has room for {room} frames: each further one that is sent ahead is lost",
            _queue(room),
        )
    for size in (16, 32, 64):
        yield buffer_fault(
            f"buffer-of-{size}-bytes",
            f"loses what comes after {size} bytes without a pause: its buffer is full",
            hear=_buffer(size),
        )
    yield buffer_fault(
        "ring-of-64-bytes-skips-its-end",
        "loses the byte that falls on the end of its ring of 64 bytes, in a burst",
        hear=lambda d, data, now: b"" if _burst(d, now) % 64 == 0 else data,
    )
    yield buffer_fault(
        "frame-across-32-bytes-torn",
        "takes 32 bytes at a time and forgets a frame that lies across two such chunks",
        hear=_torn,
    )
    yield buffer_fault(
        "deaf-while-it-answers-a-fault",
        "loses the byte that comes while it sends the answer to a fault",
        hear=_deaf_after_fault,
    )
    yield buffer_fault(
        "flushes-once",
        "throws away what was sent ahead behind the first fault, and never again",
        hear=_flush_once,
    )


def split_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that a pause inside a frame triggers."""
    stops = becomes(lambda e, state: protocol.on_fault.apply(e.before))
    usual = int(protocol.timing.truncation_timeout * MS)
    yield split_fault(
        "split-is-too-few",
        "answers a frame with a pause of more than 1 ms as one with too few data, and stops",
        when(every(split, valid), then(answers_as(Outcome.TOO_FEW), stops)),
    )
    for name, doc, effect in (
        ("ignored", "answers it and does not carry it out", drives_on),
        ("answered-twice", "carries it out and answers it twice", twice),
        ("not-answered", "carries it out and does not answer it", silent),
    ):
        doc = f"a valid frame with a pause of more than 1 ms: {doc}"
        yield split_fault(f"split-is-{name}", doc, when(every(split, valid), effect))
    yield split_fault(
        "split-fault-does-not-stop",
        "a whole faulty frame with a pause of more than 1 ms does not stop it",
        when(every(split, faulty, is_whole), drives_on),
        clauses="safety instructions responses",
    )
    for setter in setters(protocol)[-1:]:
        short = protocol.header_bytes[setter.id, setter.length]
        yield split_fault(
            f"short-time-out-of-{setter.name}",
            f"waits only 1 ms for the data of {setter.name}",
            timeouts=lambda byte, short=short: MS if byte == short else usual,
        )


def time_out_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in which frames are truncated, and in what comes after one that was."""
    usual = int(protocol.timing.truncation_timeout * MS)
    few = protocol.answers[Outcome.TOO_FEW].code
    longest = protocol.data_lengths[-1]
    fitting = {(spec.id, spec.length) for spec in protocol.instructions if spec.length}
    yield time_out_fault(
        "time-out-for-known-ids-only",
        "waits for ever for the data of an unused ID",
        timeouts=lambda byte: usual if protocol.headers[byte][0] in protocol.by_id else None,
    )
    yield time_out_fault(
        "time-out-for-valid-headers-only",
        "waits for ever for the data of a header that no instruction has",
        timeouts=lambda byte: usual if protocol.headers[byte] in fitting else None,
    )
    yield time_out_fault(
        f"no-time-out-for-{longest}-bytes",
        f"waits for ever for {longest} data bytes",
        timeouts=lambda byte: None if protocol.headers[byte][1] == longest else usual,
    )
    yield idle_fault(
        "time-out-left-armed",
        "forgets to disarm the time-out when the data of a valid frame have come: "
        "one more answer, unless another frame comes first",
        when(
            lambda e: valid(e) and e.judgement.length > 0,
            lambda d, e, r: replace(r, unasked=((usual, few),)),
        ),
    )
    yield cut_fault(
        "frame-after-truncation-lost",
        "loses the frame that follows one that was cut short",
        when(lambda e: e.previous_kind == "truncated", loses),
        clauses="responses instructions safety",
        caught_by=(*SEQUENCE, *CUT),
    )
    yield cut_fault(
        "cut-frame-put-before-the-next",
        "answers a frame that is cut short and stops, but puts its bytes before the next one",
        clauses="responses instructions safety header",
        caught_by=(*SEQUENCE, *CUT),
        remains=_put_aside,
        hear=_put_before,
    )
    yield cut_fault(
        "cut-frame-answered-twice",
        "answers a frame that is cut short twice",
        when(is_truncated, twice),
    )
    yield cut_fault(
        "cut-frame-answered-again-later",
        "answers a frame that is cut short again 30 ms later, unless another frame comes first",
        when(is_truncated, answers_again(30)),
        caught_by=SPLIT,
    )
    yield cut_fault(
        "data-of-cut-frame-run",
        "runs the data of a frame that is cut short as instructions",
        clauses="responses instructions safety header",
        caught_by=(*SEQUENCE, *CUT),
        remains=lambda device, frame: b"" if device.memory else frame[1:],
    )


def idle_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that an idle line triggers."""
    yield idle_fault(
        "asleep-after-150-ms",
        "falls asleep after 150 ms without a byte and loses the one that wakes it",
        hear=_asleep,
    )
    yield idle_fault(
        "forgets-speed-when-idle",
        "falls asleep after 150 ms without a byte while it stands, and has lost the speed then",
        _forgetful,
        clauses="instructions",
    )


def _queue(room: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        waiting = device.memory.get("waiting", 0) + 1 if event.pipelined else 1
        device.memory["waiting"] = min(waiting, room + 1)
        return loses(device, event, reaction) if waiting > room else reaction

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


def _torn(device: MutatedDevice, data: bytes, now: int) -> bytes:
    if _burst(device, now) % 32 == 1 and device.held:
        device.drop()
    return data


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
