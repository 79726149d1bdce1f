"""What a session must know to go on decoding from one moment, as a value and as JSON text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from bilprov.captures.schemas import MS, Direction
from bilprov.spec.framing import frame_size, is_open
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

# What a text may hold; what is decoded after it may still be as large again.
_MOST = 1 << 61  # instructions
_LATEST = 1 << 61  # ns: 73 years


QUIET = 20 * MS
"""Ns of idle host line after an answer in mid-frame, after which the frame is given up."""


class WaitingFrames(msgspec.Struct, frozen=True, omit_defaults=True):
    """Instructions that wait for an answer: whole frames, of which the last may be cut short.

    All of them ended at `end` and count as unanswered from `expires` on (ns). `first` is the number
    of the first; where it is None, they and all that wait are the newest of all.
    """

    end: int
    expires: int
    frames: bytes
    first: int | None = None

    def split(self, size_of: Callable[[bytes, int], int | None]) -> Iterator[bytes]:
        """Yield the frames one by one; `size_of` gives the size of the one that begins there."""
        at = 0
        while at < len(self.frames):
            size = size_of(self.frames, at)
            end = at + size if size and size > 0 else len(self.frames)
            yield self.frames[at:end]
            at = end


def _sizes(protocol: Protocol) -> Callable[[bytes, int], int | None]:
    """What gives the size of the frame that begins at a place of some bytes."""
    if protocol.layout.part("length") is None:
        return lambda frames, at: frame_size(protocol, frames[at:])
    head = protocol.layout.head  # it has the length; thousands may wait, and few heads differ
    by_head = cache(partial(frame_size, protocol))
    return lambda frames, at: by_head(frames[at : at + head])


class DecoderState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of a session after all events up to `time`. Times and durations are in ns.

    `timeout`, `skew` and `heard` are the session's settings. `sequence` is the next instruction's
    number and `state` what the instructions so far predict. `frame` holds the bytes of the frame
    that is not complete, which came from `frame_start` to `frame_end`. `waiting` are the
    instructions that wait for an answer, the oldest first, and `held` the answers
    (time, byte) that wait for an instruction. `out_of_step` is when the open frame is given up,
    `lost_at` when bytes were last lost. `unsynced_since` is since when frame boundaries are unknown
    and the host is silent, and `spoken` tells whether the device has sent a byte since. `away` are
    the sides whose port is unplugged; then nothing is paired. `by_address` are the states of the
    devices on a bus, where frames have an address.
    """

    time: int
    timeout: int
    skew: int
    heard: tuple[Direction, ...]
    sequence: int
    state: State
    frame: bytes = b""
    frame_start: int = 0
    frame_end: int = 0
    waiting: tuple[WaitingFrames, ...] = ()
    held: tuple[tuple[int, int], ...] = ()
    out_of_step: int | None = None
    lost_at: int | None = None
    unsynced_since: int | None = None
    spoken: bool = False
    away: tuple[Direction, ...] = ()
    by_address: tuple[tuple[int, State], ...] | UnsetType = UNSET

    def instructions(self, protocol: Protocol) -> Iterator[tuple[int, WaitingFrames, bytes]]:
        """Yield the number of each instruction that waits, its group, and its bytes."""
        size_of = _sizes(protocol)
        groups = [(group, list(group.split(size_of))) for group in self.waiting]
        number = self.sequence - sum(len(frames) for _, frames in groups)
        for group, frames in groups:
            first = number if group.first is None else group.first
            yield from ((first + place, group, frame) for place, frame in enumerate(frames))
            number = first + len(frames)

    def require_sense(self, protocol: Protocol) -> None:
        """Raise ValueError unless a session of this protocol can be in this state."""
        state = self.state
        count = sum(1 for _ in self.instructions(protocol))
        expiries = [group.expires for group in self.waiting]
        past = [self.frame_start, self.frame_end, *(group.end for group in self.waiting)]
        past += [t for t, _ in self.held]
        past += [t for t in (self.lost_at, self.unsynced_since) if t is not None]
        states = [state, *(one for _, one in self.by_address or ())]
        sane = (
            all(_can_be(protocol, one) for one in states)
            and self.time <= 2 * _LATEST
            and all(0 <= t <= self.time for t in past)
            and self.frame_start <= self.frame_end
            and (len(set(self.heard)) > 1 or not (self.waiting or self.held))
            and 0 <= count <= self.sequence <= 2 * _MOST
            and expiries == sorted(expiries)
            and all(group.frames for group in self.waiting)
            and all(0 <= byte <= 255 for _, byte in self.held)
            and not (self.held and self.waiting)
            and not (self.away and self.waiting)
            and is_open(protocol, self.frame)
            and (self.out_of_step is None or self.frame != b"")
            and self.out_of_step in (None, *(t + QUIET for t, _ in self.held))
        )
        if not sane:
            raise ValueError("no session is ever in this state")


def _can_be(protocol: Protocol, state: State) -> bool:
    """Whether a device of this protocol can be in a state."""
    return (
        type(state) is protocol.state_type
        and all(spec.holds(getattr(state, name)) for name, spec in protocol.variables.items())
        and state == state.of({name: getattr(state, name) for name in state.variables})
    )


def encoded(state: DecoderState) -> str:
    """The state as JSON text."""
    return msgspec.json.encode(state).decode()


def encoded_or_none(state: DecoderState | None) -> str | None:
    """The same, where the state can be told."""
    return None if state is None else encoded(state)


def decoded(text: str, protocol: Protocol) -> DecoderState | None:
    """The state in a JSON text; None if it is none, or one that no session can be in."""
    try:
        told = msgspec.json.decode(text, type=dict[str, Any])
        of_device = msgspec.convert(told.get("state"), protocol.state_type)
        state = msgspec.convert(told, DecoderState)  # which keeps no variable of a State
        state = replace(state, state=of_device)
        if "by_address" in told:
            pairs = tuple[tuple[int, protocol.state_type], ...]  # type: ignore[name-defined]
            state = replace(state, by_address=msgspec.convert(told["by_address"], pairs))
        state.require_sense(protocol)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    return state if state.sequence <= _MOST and state.time <= _LATEST else None
