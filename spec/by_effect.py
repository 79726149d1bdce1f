"""Finds the instructions of a protocol by their effect: which motion or variable they set."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from bilprov.spec.codec import build
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol


def moves(spec: InstructionSpec) -> bool:
    """Return whether the instruction sets the robot moving."""
    return spec.effect.motion not in (None, Motion.STOPPED)


@lru_cache(maxsize=1 << 8)
def moving_to(protocol: Protocol, motion: Motion) -> InstructionSpec | None:
    """Return the instruction without data that sets this kind of motion, None if there is none."""
    return next(
        (s for s in protocol.instructions if s.effect.motion is motion and not s.fields), None
    )


@lru_cache(maxsize=1 << 12)
def setting(protocol: Protocol, variable: str, value: int) -> bytes:
    """Return a frame that sets a variable and leaves the motion alone, b"" if there is none."""
    for spec in protocol.instructions:
        if spec.effect.sets("motion"):
            continue
        for name, source in spec.effect.assignments:
            if name != variable or not isinstance(source, tuple):
                continue
            field, factor = source
            part = next(f for f in spec.fields if f.name == field)
            wanted = value // factor
            if wanted * factor == value and part.low <= wanted <= part.high:
                values = {f.name: f.low for f in spec.fields} | {field: wanted}
                return build(protocol, spec.name, values)
    return b""


@lru_cache(maxsize=1 << 4)
def moving_motions(protocol: Protocol) -> tuple[Motion, ...]:
    """Return the kinds of motion, except stopped, that an instruction without data sets."""
    found = {spec.effect.motion for spec in protocol.instructions if not spec.fields}
    return tuple(m for m in Motion if m in found and m is not Motion.STOPPED)


def setters(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """Return the instructions whose data set a variable and that leave the motion alone."""
    return tuple(
        s
        for s in protocol.instructions
        if s.fields and s.effect.assignments and not s.effect.sets("motion")
    )


@lru_cache(maxsize=1 << 4)
def movers(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """Return the instructions without data that set the robot moving."""
    return tuple(s for s in protocol.instructions if not s.fields and moves(s))


def variable_of(spec: InstructionSpec) -> str:
    """Return the (first) variable that an instruction sets."""
    return spec.effect.assignments[0][0]


class LinkCheck(NamedTuple):
    """The frames that tell whether a device answers on a line; none of them moves it.

    `setting` gives the speed half its range (a stop, where no instruction sets it). `unused` is the
    header of an unused ID and `short` that of the setting without its data; each is b"" where the
    protocol has none.
    """

    setting: bytes
    unused: bytes
    short: bytes


def link_check(protocol: Protocol, taken: int | None = None) -> LinkCheck:
    """Return the frames of the link check; `taken` is an unused ID to leave out."""
    low, high = protocol.limits.get("speed", (0, 0))
    frame = setting(protocol, "speed", (low + high) // 2) or bytes([protocol.pad_byte])
    identity, length = protocol.headers[frame[0]]
    free = [one for one in protocol.unused_ids if one != taken]
    unused = bytes([protocol.header_bytes[free[0], 0]]) if free else b""
    short = bytes([protocol.header_bytes[identity, 0]]) if length else b""
    return LinkCheck(frame, unused, short)
