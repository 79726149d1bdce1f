"""Mixtures: faulty devices that follow one reading for some frames and another for the others.

Only mixtures that can show both choices are made: one by ID, for example, needs two IDs at which
the point of the reading arises.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.variants import MIXTURE, Variant, variants
from bilprov.spec.codec import bad_data
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import Protocol

_TIMES = 12  # how often the point arises before the device changes its choice


@cache
def mixtures(protocol: Protocol) -> dict[str, Fault]:
    """Return every mixture by name."""
    found = [
        fault
        for variant in variants(protocol).values()
        if variant.mixes
        for fault in mixtures_of(protocol, variant)
    ]
    return {fault.name: fault for fault in found}


def mixtures_of(protocol: Protocol, variant: Variant) -> Iterator[Fault]:
    """Yield the mixtures of one variant: by frame, by count, by ID and by motion, if both show."""
    if not variant.mixes:
        return
    ids, motions = _where_it_shows(protocol, variant)
    rows = [
        ("by-frame", "every second time", "times !& 1"),
        (
            f"after-{_TIMES}",
            f"after it has chosen otherwise {_TIMES} times",
            f"times >= {_TIMES}",
        ),
    ]
    if len(ids) > 1:
        some, others = (", ".join(map(str, part)) for part in (ids[::2], ids[1::2]))
        words = f"for ID {some} and not for {others}"
        rows.append(("by-id", words, f"id {some.replace(',', '')}"))
    if len(motions) > 1:
        moves = motions[1::2]
        words = f"while its motion is {' or '.join(moves)}"
        rows.append(("by-motion", words, f"motion {' '.join(moves)}"))
    for name, words, when in rows:
        fault = variant.taking(
            when, f"{MIXTURE}{variant.name}:{name}", f"{variant.doc}, but only {words}"
        )
        yield replace(
            fault,
            family="mixture",
            exit=1,
            caught_by=("reading/*",),
            clauses=("header", "instructions", "responses", "safety"),
        )


def _where_it_shows(protocol: Protocol, variant: Variant) -> tuple[list[int], list[Motion]]:
    """Return the IDs and the motions at which the variant differs from the reference."""
    ids: dict[int, None] = {}
    motions: dict[Motion, None] = {}
    reference, other = Simulator(protocol), Simulator(protocol, variant.fault)
    frames = list(_frames(protocol))
    behind = other.fault.hear is not None
    for motion in Motion:
        state = _begin(protocol, motion)
        for frame in frames:
            told = [_told(one, state, frame, behind=behind) for one in (reference, other)]
            if told[0] != told[1]:
                ids[protocol.headers[frame[0]][0]] = None
                motions[motion] = None
    return sorted(ids), list(motions)


def _begin(protocol: Protocol, motion: Motion) -> State:
    top = {name: high for name, (_, high) in protocol.limits.items()}
    return State(motion, top.get("speed", 0), top.get("steering", 0) // 2, top.get("led", 0))


def _frames(protocol: Protocol) -> Iterator[bytes]:
    """Yield, for each ID, frames of the right length, longer, with bad data, and truncated."""
    for identity in protocol.ids:
        known = protocol.by_id.get(identity)
        own = known.length if known else 0
        for length in (own, own + 1, own + 2):
            header = protocol.header_bytes.get((identity, length))
            if header is None:
                continue
            for byte in (protocol.pad_byte, 0xFF):
                yield bytes([header]) + bytes([byte]) * length
            if length:
                yield bytes([header])
        if known:
            header = protocol.header_bytes[identity, own]
            yield from (bytes([header]) + data for data in list(bad_data(known))[:1])


def _told(device: Simulator, state: State, frame: bytes, *, behind: bool) -> object:
    """Return what a device in that state does during the frame and on the idle line after it.

    `behind` sends one pad byte right after a complete frame, for variants that may lose it.
    """
    device.power_cycle(0)
    device.advance(0)
    device.state = state
    now, told = 10 * MS, []
    whole = len(frame) > device.protocol.lengths[frame[0]]
    for byte in (*frame, *([device.protocol.pad_byte] if whole and behind else [])):
        now += device.byte_time
        device.receive(bytes([byte]), now)
        told.append((device.advance(now), device.look(now)))
    now += 2 * int(device.protocol.timing.truncation_timeout * MS)
    told.append((device.advance(now), device.look(now)))
    return told
