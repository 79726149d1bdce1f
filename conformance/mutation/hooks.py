"""Effects on more than the reaction to a frame: on bytes, framing, time-outs, power-on, wheels.

`HOOKS` has the function of each word. It takes the protocol, the trigger and the arguments, and
returns fields of `Fault`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.dut.simulator import Event, Reaction, Simulator
from bilprov.conformance.mutation.effects import at_frames, entered
from bilprov.conformance.mutation.triggers import Trigger
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

Hooks = dict[str, Any]

HOOKS: dict[str, Callable[..., Hooks]] = {}
hook = entered(HOOKS)


# -- the line: bytes on their way to the device --------------------------------------------------


@hook
def echo(protocol: Protocol, acting: Trigger) -> Hooks:
    """Send back what comes: a loop-back plug."""

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        for byte in data:
            device.answer(byte, now)
        return b""

    return {"hear": hear}


@hook
def loses_bytes(protocol: Protocol, acting: Trigger, *lost: int) -> Hooks:
    """Lose these bytes; all of them, if none is given."""
    gone = bytes(lost) or bytes(range(256))
    return {"hear": lambda device, data, now: data.translate(None, gone)}


@hook
def loses_next_byte(protocol: Protocol, acting: Trigger) -> Hooks:
    """Lose the byte that comes after a frame of the trigger."""

    def marks(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        device.memory["deaf"] = 1
        return reaction

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        return b"" if device.memory.pop("deaf", 0) else data

    return {"react": at_frames(acting, marks), "hear": hear}


def _burst(device: Simulator, now: int) -> int:
    """Count a byte: return its number, from 1, since the line last paused."""
    memory = device.memory
    together = now - memory.get("byte at", -(1 << 60)) <= device.byte_time
    memory["burst"] = memory.get("burst", 0) + 1 if together else 1
    memory["byte at"] = now
    return memory["burst"]


@hook
def buffer(protocol: Protocol, acting: Trigger, size: int) -> Hooks:
    """Lose what comes after so many bytes without a pause."""
    return {"hear": lambda device, data, now: b"" if _burst(device, now) > size else data}


@hook
def torn_between_chunks(protocol: Protocol, acting: Trigger, size: int) -> Hooks:
    """Forget a frame that lies across two chunks of that size."""

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        if _burst(device, now) % size == 1 and device.held:
            device.drop()
        return data

    return {"hear": hear}


@hook
def deaf_after_fault(protocol: Protocol, acting: Trigger) -> Hooks:
    """Lose the byte that comes while the answer to a fault is sent."""

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        over = device.over_at
        if device.row == 0 or device.held or over is None:
            return data
        return b"" if now - over <= device.byte_time else data

    return {"hear": hear}


@hook
def sleeps(protocol: Protocol, acting: Trigger, milliseconds: int) -> Hooks:
    """Lose the byte that ends so long a silence between two frames."""

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        before = device.memory.get("byte at")
        device.memory["byte at"] = now
        asleep = before is not None and now - before > milliseconds * MS
        return b"" if asleep and not device.held else data

    return {"hear": hear}


@hook
def flushes(protocol: Protocol, acting: Trigger, milliseconds: int = 0) -> Hooks:
    """Drop all bytes after a frame of the trigger until the line is idle so long, or a time-out."""
    pause = (milliseconds or int(protocol.timing.truncation_timeout)) * MS

    def marks(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        device.memory["idle at"] = event.now + pause
        return reaction

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        if now < device.memory.get("idle at", now):
            device.memory["idle at"] = now + pause
            return b""
        device.memory.pop("idle at", None)
        return data

    return {"react": at_frames(acting, marks), "hear": hear}


@hook
def puts_cut_frames_before_the_next(protocol: Protocol, acting: Trigger) -> Hooks:
    """Keep the bytes of a truncated frame and put them before the next byte."""

    def put_aside(device: Simulator, frame: bytes) -> bytes:
        device.memory["aside"] = int.from_bytes(b"\1" + frame, "big")
        return b""

    def put_before(device: Simulator, data: bytes, now: int) -> bytes:
        aside = device.memory.pop("aside", None)
        if aside is None:
            return data
        return aside.to_bytes((aside.bit_length() + 7) // 8, "big")[1:] + data

    return {"remains": put_aside, "hear": put_before}


@hook
def runs_cut_data(protocol: Protocol, acting: Trigger) -> Hooks:
    """Run the data of a truncated frame as instructions."""
    return {"remains": lambda device, frame: frame[1:]}


# -- framing: data lengths, time-outs, and what happens at a header ------------------------------


@hook
def swaps_length_and_id(protocol: Protocol, acting: Trigger) -> Hooks:
    """Take the ID of a header for its length, where there is such a header."""
    swapped = (i if (n, i) in protocol.header_bytes else n for i, n in protocol.headers)
    return {"lengths": bytes(swapped)}


@hook
def takes_what_is_needed(protocol: Protocol, acting: Trigger) -> Hooks:
    """Take the data that an instruction needs, whatever its header announces."""
    by_id = protocol.by_id
    needed = (max(n, by_id[i].length) if i in by_id else n for i, n in protocol.headers)
    return {"lengths": bytes(needed)}


@hook
def runs_data(protocol: Protocol, acting: Trigger, which: str, number: int | None = None) -> Hooks:
    """Take frames for their header alone: `unused` IDs (or one), `too-long` (or of one length)."""
    by_id = protocol.by_id

    def cut(identity: int, length: int) -> bool:
        if which == "unused":
            return identity not in by_id and number in (None, identity)
        known = by_id.get(identity)
        return known is not None and length > known.length and number in (None, length)

    return {"lengths": bytes(0 if cut(*header) else header[1] for header in protocol.headers)}


@hook
def time_out(protocol: Protocol, acting: Trigger, milliseconds: int | None = None) -> Hooks:
    """End a frame after so long a pause; never, without a number."""
    return {"timeout": None if milliseconds is None else milliseconds * MS}


@hook
def time_out_over_frame(protocol: Protocol, acting: Trigger) -> Hooks:
    """Count the time-out from the header on, over the whole frame."""
    return {"whole_frame": True}


def _timeouts(protocol: Protocol, other: int | None, headers: Iterable[int]) -> Hooks:
    """Return the hook with another time-out (ns, None for never) for these headers."""
    usual, others = int(protocol.timing.truncation_timeout * MS), set(headers)
    return {"timeouts": lambda header: other if header in others else usual}


@hook
def no_time_out_for_unused(protocol: Protocol, acting: Trigger) -> Hooks:
    """Wait for ever for the data of an unused ID."""
    unused = (
        b for b, (identity, _) in enumerate(protocol.headers) if identity not in protocol.by_id
    )
    return _timeouts(protocol, None, unused)


@hook
def no_time_out_for_length(protocol: Protocol, acting: Trigger, length: int) -> Hooks:
    """Wait for ever for so many data bytes."""
    return _timeouts(protocol, None, (b for b, n in enumerate(protocol.lengths) if n == length))


@hook
def time_out_of(protocol: Protocol, acting: Trigger, name: str, milliseconds: int) -> Hooks:
    """Wait only so long for the data of an instruction."""
    spec = protocol.by_name[name]
    return _timeouts(protocol, milliseconds * MS, [protocol.header_bytes[spec.id, spec.length]])


@hook
def answers_at_header(protocol: Protocol, acting: Trigger) -> Hooks:
    """Answer an instruction with data at its header already, and again at its end."""
    carrying = {(spec.id, spec.length) for spec in protocol.instructions if spec.length}
    ok = protocol.answers[Outcome.VALID].code
    return {"begins": lambda device, byte: (ok,) if protocol.headers[byte] in carrying else ()}


@hook
def stops_at_header(protocol: Protocol, acting: Trigger, which: str = "") -> Hooks:
    """Stop at a wrong header (only of `unused` IDs); the answer comes after the data, as usual."""

    def begins(device: Simulator, header: int) -> tuple[int, ...]:
        identity, length = protocol.headers[header]
        known = protocol.by_id.get(identity)
        if known is None or (not which and length != known.length):
            device.state = device.state.but(**{protocol.car.by: protocol.car.still})
        return ()

    return {"begins": begins}


@hook
def refuses_at_header(protocol: Protocol, acting: Trigger) -> Hooks:
    """Answer a frame of the trigger at its header and drop its data.

    The data end when all have come, or after a pause that truncates a frame.
    """

    def hear(device: Simulator, data: bytes, now: int) -> bytes:
        memory = device.memory
        if memory.get("skips"):
            pause = device.timeouts[memory["skips of"]]
            if pause is None or now < memory["skips at"] + pause:
                memory["skips"], memory["skips at"] = memory["skips"] - 1, now
                return b""
        for name in ("skips", "skips of", "skips at"):
            memory.pop(name, None)
        if device.held:
            return data
        length = protocol.lengths[data[0]]
        frame = data + bytes(length)
        judgement, _ = device.step(frame, device.state)
        if not acting.holds(
            Event(protocol, judgement, device.state, 0, 0, "instruction", now), memory
        ):
            return data
        memory["skips"], memory["skips of"], memory["skips at"] = length, data[0], now
        device.react_at_header(frame, now)
        return b""

    return {"hear": hear}


# -- power-on, and what a probe sees of the wheels -----------------------------------------------


@hook
def power_on(protocol: Protocol, acting: Trigger, *values: Any) -> Hooks:
    """Be switched on with these values of variables: each a name and a value."""
    names = map(protocol.by_role.__getitem__, values[::2])
    return {"power_on": protocol.power_on.but(**dict(zip(names, values[1::2], strict=True)))}


@hook
def banner(protocol: Protocol, acting: Trigger, text: str) -> Hooks:
    """Send a line of text at power-on."""
    return {"banner": f"{text}\r\n".encode()}


@hook
def wheels_level_off(protocol: Protocol, acting: Trigger, most: int) -> Hooks:
    """Turn the wheels no faster than at this speed."""

    def show(look: Look) -> Look:
        speed = protocol.car.drive(look).speed
        if speed is None or look.left is None or look.right is None or speed <= most:
            return look
        left, right = (round(wheel * most / speed) for wheel in (look.left, look.right))
        return msgspec.structs.replace(look, left=left, right=right)

    return {"show": show}


@hook
def wheels_astray(
    protocol: Protocol, acting: Trigger, how: str, variable: str, least: int
) -> Hooks:
    """Turn the wheels `reversed`, or by `half`, from a size of the speed or the steering on."""
    car = protocol.car

    def show(look: Look) -> Look:
        motion, speed, steering = car.drive(look)
        values = {"speed": speed or 0, "steering": steering or 0}
        size = abs(values[variable])
        if size < least:
            return look
        values[variable] = -values[variable] if how == "reversed" else _halved(values[variable])
        sign = -1 if values["speed"] < 0 else 1
        driving = {car.by: motion or car.still, car.speed: abs(values["speed"])}
        state = protocol.state(**driving, **{car.steering: values["steering"]})
        left, right = car.wheels(state, protocol.full_steering)
        return msgspec.structs.replace(look, left=sign * left, right=sign * right)

    return {"show": show}


def _halved(value: int) -> int:
    return -(-value // 2) if value < 0 else value // 2
