"""Counts how much of recorded bytes decodes, and finds the first bytes that do not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from bilprov.analyzer.decode.near_misses import Checked, NearMiss, fitting_check, near_miss
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.captures.schemas import Direction
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import covered

_SHOWN = 24  # bytes of what does not decode
_LOOKED_AT = 512  # bytes from there on that tell what it nearly is
_FRAMES = 50  # with a wrong check that are tried with other checks


@dataclass
class Side:
    """One direction: its bytes, how many of them decode, in how many frames or answers."""

    bytes: int = 0
    decoded: int = 0
    frames: int = 0


@dataclass
class Undecoded:
    """The first bytes of a direction that do not decode.

    `offset` counts bytes of that direction, `t` is their time in ns. `near` is the instruction that
    they nearly are, or are nearly the answer to, and what is wrong.
    """

    direction: Direction
    offset: int
    t: int
    data: bytes
    near: NearMiss | None


@dataclass
class DecodedShare:
    """What decodes of each direction, and the first bytes that do not; None if all do.

    `check` is a usual check that fits where the declared one is wrong, "" if none does.
    """

    sides: dict[Direction, Side] = field(default_factory=dict)
    first: Undecoded | None = None
    check: str = ""

    @property
    def whole(self) -> bool:
        """Whether every byte decodes."""
        return self.first is None

    @property
    def percent(self) -> float:
        """How many of 100 bytes decode."""
        total = sum(side.bytes for side in self.sides.values())
        return 100 * sum(side.decoded for side in self.sides.values()) / total if total else 0.0


def decoded_share(protocol: Protocol, records: Iterable[Record]) -> DecodedShare:
    """Count what decodes: valid requests, and whole answers, whatever they report."""
    share = DecodedShare()
    begun: HostRecord | DeviceRecord | None = None
    data, offset = b"", 0
    wrong: dict[Direction, list[Checked]] = {"host": [], "device": []}
    for record in records:
        if not isinstance(record, HostRecord | DeviceRecord):
            continue
        direction = _direction(record)
        side = share.sides.setdefault(direction, Side())
        if _decodes(record):
            side.decoded += len(record.data)
            side.frames += 1
        else:
            if begun is None:
                begun, offset = record, side.bytes
            if _has_wrong_check(protocol, record) and len(wrong[direction]) < _FRAMES:
                wrong[direction].append(_checked(protocol, record))
        if begun is not None and direction == _direction(begun) and len(data) < _LOOKED_AT:
            data += record.data
        side.bytes += len(record.data)
    if begun is not None:
        direction = _direction(begun)
        near = _near(protocol, begun, data)
        share.first = Undecoded(direction, offset, begun.t, data[:_SHOWN], near)
        share.check = _fitting(protocol, wrong, direction)
    return share


def _checked(protocol: Protocol, record: HostRecord | DeviceRecord) -> Checked:
    """A frame, with what the check of its request covers."""
    asked = record.answered if isinstance(record, DeviceRecord) else None
    return Checked(record.data, covered(protocol, asked.frame) if asked else b"")


def _fitting(
    protocol: Protocol, wrong: dict[Direction, list[Checked]], direction: Direction
) -> str:
    """A usual check that fits where the declared one is wrong, of this direction or the other."""
    host = fitting_check(protocol.layout, wrong["host"])
    asked = protocol.layout.covered[0] if protocol.layout.covered else ""
    device = fitting_check(protocol.reply, wrong["device"], asked)
    return host or device if direction == "host" else device or host


def _direction(record: HostRecord | DeviceRecord) -> Direction:
    return "host" if isinstance(record, HostRecord) else "device"


def _decodes(record: HostRecord | DeviceRecord) -> bool:
    if isinstance(record, HostRecord):
        return record.judgement is not None and record.judgement.valid
    if record.reply:
        return not record.reply.reason and record.reply.response is not None
    return record.answer is not None


def _has_wrong_check(protocol: Protocol, record: HostRecord | DeviceRecord) -> bool:
    """Whether a frame is whole and only its check is known to be wrong."""
    if isinstance(record, HostRecord):
        return bool(record.judgement and record.judgement.outcome is Outcome.BAD_CHECKSUM)
    check = protocol.reply.check
    return bool(check and record.reply and record.reply.reason.startswith(check.part.name))


def _near(protocol: Protocol, record: HostRecord | DeviceRecord, data: bytes) -> NearMiss | None:
    """What a record that does not decode nearly is; `data` goes on after its bytes."""
    if isinstance(record, HostRecord):
        return near_miss(protocol, data)
    asked = record.answered.instruction if record.answered else None
    reason = record.reply.reason if record.reply else record.reason
    wrong = _has_wrong_check(protocol, record)
    return NearMiss(asked.name if asked else "", "checksum" if wrong else "length", reason)
