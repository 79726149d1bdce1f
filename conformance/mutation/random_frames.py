"""Draws frames that are faulty whatever their data, and a value in their data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from bilprov.conformance.dut.fault import Event
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.faults.vocabulary import is_truncated
from bilprov.conformance.mutation.random_triggers import What, When
from bilprov.spec.codec import judge, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import FieldSpec, InstructionSpec, Protocol

_BYTES = (0, 1, 127, 128, 255, *(1 << bit for bit in range(1, 7)))
"""The data bytes of boundaries and of single bits."""


class FaultyFrames(NamedTuple):
    """Faulty frames with data: the trigger, and one of them with pad bytes as its data.

    `narrow` is true where any value of 256 besides would make them too few to be met: where both an
    ID and a length are given, and of truncated frames, each of which takes a time-out.
    """

    what: What
    frame: bytes
    narrow: bool


def faulty_frames(protocol: Protocol, draw: Draw) -> FaultyFrames:
    """Draw faulty frames with data: a wrong length, an unused ID, or a frame cut after k bytes."""
    kinds = [
        _wrong_length,
        *([_unused] if protocol.unused_ids else []),
        *([_cut] if protocol.data_lengths[-1] > 1 else []),
    ]
    return draw.pick(kinds)(protocol, draw)


def with_byte(draw: Draw, found: FaultyFrames, *, any_value: bool) -> When:
    """Draw a value, a threshold or a bit of the first, second or last data byte of such frames.

    Without `any_value` the value is one of a boundary or of a single bit.
    """
    places = [("first", 1), ("last", -1), *([("second", 2)] if len(found.frame) > 2 else [])]
    place, index = draw.pick(places)
    words, test, value = _value(draw, any_value=any_value)
    data = bytearray(found.frame)
    data[index] = value
    return When(
        f"the {place} data byte {words}",
        lambda event: (
            len(event.judgement.frame) > abs(index) and test(event.judgement.frame[index])
        ),
        (bytes(data),),
    )


def with_first_value(draw: Draw, part: FieldSpec, *, any_value: bool) -> When:
    """Draw a value of a field; without `any_value` one of a boundary or of a single bit."""
    some = () if any_value else [value for value in _BYTES if part.low <= value <= part.high]
    value = draw.pick(some) if some else draw.between(part.low, part.high)

    def holds(event: Event) -> bool:
        return bool(event.judgement.fields) and event.judgement.fields[0][1] == value

    return When(f"with the value {value}", holds, (value,))


def _value(draw: Draw, *, any_value: bool) -> tuple[str, Callable[[int], bool], int]:
    """Draw a test of a byte: its words, itself, and a value for which it holds."""
    kind = draw.below(4)
    if kind == 0:
        least = draw.between(1, 255)
        return f"from {least}", lambda byte: byte >= least, least
    if kind == 1:
        mask = 1 << draw.below(8)
        return f"with bit {mask:#x} set", lambda byte: bool(byte & mask), mask
    value = draw.below(256) if any_value else draw.pick(_BYTES)
    return str(value), lambda byte: byte == value, value


def _wrong_length(protocol: Protocol, draw: Draw) -> FaultyFrames:
    spec = draw.pick([spec for spec in protocol.instructions if _wrong_lengths(protocol, spec)])
    length = draw.pick(_wrong_lengths(protocol, spec))
    many = length > spec.length
    outcome = Outcome.TOO_MANY if many else Outcome.TOO_FEW
    kind = draw.below(3)  # a length of one ID, a length of two IDs, any such length of one ID
    ids = [spec.id]
    if kind == 1:
        beside = [s for s in protocol.instructions if s is not spec and s.length == spec.length]
        ids += [draw.pick(beside).id] if beside else []
    one = None if kind == 2 else length
    words = f"ID {' or '.join(map(str, sorted(ids)))} with {_announced(one, outcome.value)}"
    return _found(protocol, words, ids, one, length, outcome=outcome)


def _wrong_lengths(protocol: Protocol, spec: InstructionSpec) -> list[int]:
    """Return the wrong lengths, with data, that a header of the instruction can announce."""
    return [length for length in protocol.data_lengths if length not in (0, spec.length)]


def _unused(protocol: Protocol, draw: Draw) -> FaultyFrames:
    identity = draw.pick(protocol.unused_ids)
    length = draw.pick(protocol.data_lengths[1:])
    kind = draw.below(3)  # any data of one ID, one length of any, one length of one ID
    ids = list(protocol.unused_ids) if kind == 1 else [identity]
    name = "an unused ID" if kind == 1 else f"the unused ID {identity}"
    one = None if kind == 0 else length
    words = f"{name} with {_announced(one, 'data')}"
    return _found(protocol, words, ids, one, length, outcome=Outcome.UNKNOWN_ID)


def _cut(protocol: Protocol, draw: Draw) -> FaultyFrames:
    arrived = draw.between(1, min(3, protocol.data_lengths[-1] - 1))
    length = draw.between(arrived + 1, protocol.data_lengths[-1])
    kinds = [
        ("a frame", list(protocol.ids)),
        ("a frame of a known ID", list(protocol.by_id)),
        ("a frame of an unused ID", list(protocol.unused_ids)),
    ]
    name, ids = draw.pick([(name, ids) for name, ids in kinds if ids])
    words = f"{name} cut short after {arrived} of its data bytes"
    return _found(protocol, words, ids, None, length, arrived=arrived)


def _announced(length: int | None, otherwise: str) -> str:
    return otherwise if length is None else f"{length} data bytes announced"


def _found(
    protocol: Protocol,
    words: str,
    ids: Sequence[int],
    announced: int | None,
    length: int,
    *,
    outcome: Outcome | None = None,
    arrived: int | None = None,
) -> FaultyFrames:
    """Return the frames of these IDs that announce so many bytes (None for any).

    `arrived` is the number of data bytes that came of a truncated frame, None for a whole one.
    """

    def matches(event: Event) -> bool:
        judgement = event.judgement
        return (
            judgement.id in ids
            and announced in (None, judgement.length)
            and is_truncated(event) is (arrived is not None)
            and arrived in (None, len(judgement.frame) - 1)
            and outcome in (None, judgement.outcome)
            and not judgement.valid
        )

    data = bytes([protocol.pad_byte]) * (length if arrived is None else arrived)
    frame = raw_frame(protocol, ids[0], length, data)
    known = judge(protocol, frame).outcome if arrived is None else None
    assert known is outcome
    what = What(words, matches, outcome=outcome, cut=arrived is not None)
    narrow = arrived is not None or (announced is not None and len(ids) < 3)
    return FaultyFrames(what, frame, narrow=narrow)
