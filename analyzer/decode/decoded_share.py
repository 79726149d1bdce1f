"""Counts how much of recorded bytes decodes, and tells what the first that do not nearly are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple, get_args

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.captures.schemas import Direction
from bilprov.captures.text import quantity
from bilprov.spec.checks import CheckFunction, Crc, Fletcher, Sum, Xor
from bilprov.spec.codec import judge, spaced
from bilprov.spec.data import Order
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import frame_size
from bilprov.spec.layout import Layout
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.replies import asked_values, covered, read_reply, reply_size, usual_way

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
        direction: Direction = "host" if isinstance(record, HostRecord) else "device"
        side = share.sides.setdefault(direction, Side())
        if _decodes(record):
            side.decoded += len(record.data)
            side.frames += 1
        else:
            if begun is None:
                begun, offset = record, side.bytes
            if _has_wrong_check(protocol, record) and len(wrong[direction]) < _FRAMES:
                asked = record.answered if isinstance(record, DeviceRecord) else None
                counted = covered(protocol, asked)
                wrong[direction].append(Checked(record.data, counted))
        if type(record) is type(begun) and len(data) < _LOOKED_AT:
            data += record.data
        side.bytes += len(record.data)
    if begun is not None:
        direction = "host" if isinstance(begun, HostRecord) else "device"
        near = _near(protocol, begun, data)
        share.first = Undecoded(direction, offset, begun.t, data[:_SHOWN], near)
        fitting = [
            fitting_check(protocol.layout, wrong["host"]),
            fitting_check(protocol.reply, wrong["device"], "".join(protocol.layout.covered[:1])),
        ]
        share.check = next(filter(None, fitting if direction == "host" else fitting[::-1]), "")
    return share


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
        judged = record.judgement
        # What has a right check, and an unused ID, ended where the check did: by silence.
        known = protocol.layout.check and judged and judged.outcome is Outcome.UNKNOWN_ID
        return near_miss(protocol, record.data if known else data)
    asked = record.answered
    name = asked.instruction.name if asked and asked.instruction else ""
    reason = record.reply.reason if record.reply else record.reason
    if _has_wrong_check(protocol, record):
        return NearMiss(name, "checksum", reason)
    if asked is None or asked.instruction is None:
        unasked = protocol.reply.begins(record.data)
        what = "they answer no request that waits"
        return NearMiss("", "request", what) if unasked else NearMiss("", "length", reason)
    layout, values = usual_way(protocol, asked.instruction).layout, asked_values(protocol, asked)
    unrepeated = layout.unrepeated(record.data, values)
    obstacle = unrepeated[0].role if unrepeated else "length"
    due = reply_size(protocol, record.data, asked)
    reason = read_reply(protocol, record.data, asked).reason
    if obstacle == "length" and due and due > len(record.data):
        reason = f"{len(record.data)} of {quantity(due, 'byte')} came"
    return NearMiss(name, obstacle if layout.begins(record.data) else "sync", reason)


_LONGEST = 512  # bytes within which another end of a frame is looked for
_OBSTACLES = {
    Outcome.BAD_DATA: "range",
    Outcome.BAD_CHECKSUM: "checksum",
    Outcome.BAD_SYNC: "sync",
    Outcome.OTHER_ADDRESS: "address",
    Outcome.UNKNOWN_ID: "id",
    Outcome.TOO_MANY: "length",
    Outcome.TOO_FEW: "length",
}

_USUAL: tuple[CheckFunction, ...] = (
    *(Sum(8), Sum(8, complement=1), Sum(8, complement=2), Xor(), Sum(16)),
    *(Fletcher(), Fletcher(255), Crc(7, 0x09, reflected=True)),
    *(Crc(8, 0x07), Crc(8, 0x31, reflected=True), Crc(8, 0xD5)),
    *(Crc(16, 0x8005, init, reflected=True) for init in (0xFFFF, 0)),
    *(Crc(16, 0x8005, init) for init in (0, 0xFFFF)),
    *(Crc(16, 0x1021, init) for init in (0, 0xFFFF)),
    *(Crc(16, 0x1021, 0, reflected=True), Crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF)),
    Crc(32, 0x04C11DB7, 0xFFFFFFFF, reflected=True, xorout=0xFFFFFFFF),
)
"""The checks that many protocols use."""


class NearMiss(NamedTuple):
    """The instruction that some bytes nearly are ("" if none is near), and what is wrong.

    The `obstacle` is one of _OBSTACLES, `request` for an answer that nothing asked for, or the part
    of an answer that does not repeat that of its request.
    """

    name: str
    obstacle: str
    reason: str


def near_miss(protocol: Protocol, data: bytes) -> NearMiss | None:
    """What bytes of the host nearly are that begin where a frame was expected; None if nothing."""
    layout = protocol.layout.of_frame(data)
    if layout.sync and not layout.begins(data[: layout.head]):
        return _other_sync(protocol, data)
    size = frame_size(protocol, data)
    judged = judge(protocol, data[:size] if size and size > 0 else data)
    if judged.valid:
        return None
    name = judged.instruction.name if judged.instruction else ""
    if judged.outcome in (Outcome.BAD_CHECKSUM, Outcome.TOO_FEW):
        size = 0 if judged.truncated else len(judged.frame)
        other = _other_length(layout, judged.instruction, data, size)
        if other and (other.name or not name):
            return other
    return NearMiss(name, _OBSTACLES[judged.outcome], judged.reason)


def _other_length(
    layout: Layout, spec: InstructionSpec | None, data: bytes, size: int
) -> NearMiss | None:
    """The frame with another end, if its check is right there."""
    check = layout.check
    if check is None:
        return None
    least = layout.head + layout.tail
    for end in check.right_sizes(data[:_LONGEST], check.first + check.last + 1):
        more = data[end:]
        if check.part.size == 1 and more and not (layout.sync and layout.begins(more)):
            continue  # right by chance, once in 256 times
        if end == size or layout.wrong_constant(data[:end]):
            continue
        reason = f"its check is right after {quantity(end, 'byte')}, "
        if spec and end >= least and not layout.part("length"):
            takes = f"{spec.name} takes {max(size - least, spec.length)}"
            reason += f"with {quantity(end - least, 'byte')} of data; {takes}"
            return NearMiss(spec.name, "length", reason)
        named = layout.part("address") or layout.part("length")
        reason += "as if a part of FRAME were declared with a wrong size"
        return NearMiss("", "length", reason + (f", such as {named.name}" if named else ""))
    return None


def _other_sync(protocol: Protocol, data: bytes) -> NearMiss | None:
    """The frame with the right constants in front: in place of the first bytes, or before them."""
    layout = protocol.layout
    sync = layout.sync
    for missing in range(len(sync) + 1):
        patched = sync + data[len(sync) - missing :]
        size = frame_size(protocol, patched)
        if size is None or not 0 < size <= len(patched):
            continue
        judged = judge(protocol, patched[:size])
        check = layout.of_frame(patched).check
        as_sent = check is not None and check.holds(data[: size - missing])
        if judged.valid or (judged.outcome is Outcome.BAD_CHECKSUM and as_sent):
            came = spaced(data[: len(sync) - missing]) or "no such bytes"
            why = f"it begins with {came}, right is {spaced(sync)}"
            return NearMiss(judged.name, "sync", why)
    return None


class Checked(NamedTuple):
    """A frame whose declared check is wrong, and what the check of its request covers."""

    frame: bytes
    asked: bytes = b""


def fitting_check(layout: Layout, frames: Sequence[Checked], asked: str = "") -> str:
    """A usual check that is right in each of these frames, as it is declared; "" if there is none.

    `asked` names the covered part of the request, which a check of the answer may count too. One
    frame alone says little of a check of one byte: two are needed then.
    """
    check = layout.check
    if check is None or len(frames) < (2 if check.part.size == 1 else 1):
        return ""
    part, covered, also = check.part, layout.covered[0], check.asked
    places = {part.offset: part.name for part in layout.parts if part.offset >= 0}
    places |= {layout.head: "data"} if layout.has_data else {}
    firsts = sorted(places, key=check.first.__ne__)
    for first, function, order in product(firsts, _USUAL, get_args(Order)):
        if all(
            function(before * also + frame[first : len(frame) - check.last])
            == int.from_bytes(part.raw(frame), order)
            for frame, before in frames
        ):
            kind = "Byte" if part.size == 1 else f"Int{8 * part.size}u{order[0]}"
            counted = f"asked.{asked}.data + " * also + f"this.{covered}.data"
            said = f'"{part.name}" / Checksum({kind}, {_declared(function)}, {counted})'
            begins = f', with "{covered}" beginning at "{places[first]}"'
            return said + begins * (first != check.first)
    return ""


def _declared(function: CheckFunction) -> str:
    """One of the usual checks as a grammar declares it."""
    if isinstance(function, Sum):
        complement = f", complement={function.complement}" if function.complement else ""
        return f"Sum({function.bits}{complement})"
    if not isinstance(function, Crc):
        return f"Fletcher({function.modulus})" if isinstance(function, Fletcher) else "Xor()"
    digits = -(-function.width // 4)
    said = f"Crc({function.width}, 0x{function.poly:0{digits}X}, 0x{function.init:0{digits}X}"
    said += ", reflected=True" if function.reflected else ""
    return said + (f", xorout=0x{function.xorout:0{digits}X})" if function.xorout else ")")
