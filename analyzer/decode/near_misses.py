"""Tells which instruction bytes nearly are that do not decode, and what keeps them from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import product
from typing import Literal, NamedTuple

from bilprov.spec.checks import CheckFunction, Crc, Sum, Xor
from bilprov.spec.codec import judge, spaced
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import frame_size
from bilprov.spec.layout import Check, Layout
from bilprov.spec.numbers import Order
from bilprov.spec.protocol import InstructionSpec, Protocol

Obstacle = Literal["checksum", "length", "range", "sync", "address", "id"]

_ORDERS: tuple[Order, ...] = ("big", "little")
_LONGEST = 512  # bytes within which another end of a frame is looked for
_OBSTACLES: dict[Outcome, Obstacle] = {
    Outcome.BAD_DATA: "range",
    Outcome.BAD_CHECKSUM: "checksum",
    Outcome.BAD_SYNC: "sync",
    Outcome.OTHER_ADDRESS: "address",
    Outcome.UNKNOWN_ID: "id",
    Outcome.TOO_MANY: "length",
    Outcome.TOO_FEW: "length",
}
# The nearer come first: what only a value or a length keeps from being a frame is nearly one.
_NEAREST: tuple[Obstacle, ...] = ("range", "length", "address", "sync", "checksum", "id")

_USUAL: tuple[CheckFunction, ...] = (
    *(Sum(8), Sum(8, complement=1), Sum(8, complement=2), Xor(), Sum(16)),
    *(Crc(8, 0x07), Crc(8, 0x31, reflected=True), Crc(8, 0xD5)),
    *(Crc(16, 0x8005, init, reflected=True) for init in (0xFFFF, 0)),
    *(Crc(16, 0x8005, init) for init in (0, 0xFFFF)),
    *(Crc(16, 0x1021, init) for init in (0, 0xFFFF)),
    *(Crc(16, 0x1021, 0, reflected=True), Crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF)),
    Crc(32, 0x04C11DB7, 0xFFFFFFFF, reflected=True, xorout=0xFFFFFFFF),
)
"""The checks that many protocols use."""


class NearMiss(NamedTuple):
    """The instruction that some bytes nearly are ("" if none is near), and what is wrong."""

    name: str
    obstacle: Obstacle
    reason: str


def near_miss(protocol: Protocol, data: bytes) -> NearMiss | None:
    """What bytes of the host nearly are that begin where a frame was expected; None if nothing."""
    found = list(_hypotheses(protocol, data))
    return min(found, key=lambda one: (not one.name, _NEAREST.index(one.obstacle)), default=None)


def _hypotheses(protocol: Protocol, data: bytes) -> Iterator[NearMiss]:
    layout = protocol.layout
    if layout.sync and not layout.begins(data[: layout.head]):
        yield from _other_sync(protocol, data)
        return
    size = frame_size(protocol, data)
    judged = judge(protocol, data[:size] if size and size > 0 else data)
    if judged.valid:
        return
    name = judged.instruction.name if judged.instruction else ""
    if judged.instruction and judged.outcome in (Outcome.BAD_CHECKSUM, Outcome.TOO_FEW):
        yield from _other_length(layout, judged.instruction, data, len(judged.frame))
    yield NearMiss(name, _OBSTACLES[judged.outcome], judged.reason)


def _other_length(
    layout: Layout, spec: InstructionSpec, data: bytes, size: int
) -> Iterator[NearMiss]:
    """The frame with another end, if its check is right there."""
    check = layout.check
    least = layout.head + layout.tail
    if check is None or layout.part("length"):
        return
    for end in check.right_sizes(data[:_LONGEST], least):
        if check.part.size == 1 and end < len(data):
            continue  # right by chance, once in 256 times
        if end != size and not layout.wrong_constant(data[:end]):
            came, due = end - least, size - least
            reason = (
                f"its check is right after {_bytes(end)}, with {_bytes(came)} of data; "
                f"{spec.name} takes {max(due, spec.length)}"
            )
            yield NearMiss(spec.name, "length", reason)
            return


def _other_sync(protocol: Protocol, data: bytes) -> Iterator[NearMiss]:
    """The frame with the right constants in front: in place of the first bytes, or before them."""
    layout = protocol.layout
    sync = layout.sync
    for missing in range(len(sync) + 1):
        patched = sync + data[len(sync) - missing :]
        size = frame_size(protocol, patched)
        if size is None or not 0 < size <= len(patched):
            continue
        judged = judge(protocol, patched[:size])
        as_sent = layout.check is not None and layout.check.holds(data[: size - missing])
        if judged.valid or (judged.outcome is Outcome.BAD_CHECKSUM and as_sent):
            came = spaced(data[: len(sync) - missing]) or "no such bytes"
            yield NearMiss(judged.name, "sync", f"it begins with {came}, right is {spaced(sync)}")
            return


def _bytes(count: int) -> str:
    return "1 byte" if count == 1 else f"{count} bytes"


class Checked(NamedTuple):
    """A frame whose declared check is wrong, and what the check of its request covers."""

    frame: bytes
    asked: bytes = b""


def fitting_check(layout: Layout, frames: Iterable[Checked], asked: str = "") -> str:
    """A usual check that is right in each of these frames, as it is declared; "" if there is none.

    `asked` names the covered part of the request, if a check of the answer may count it too. One
    frame alone says little of a check of one byte: two are needed then.
    """
    given = list(frames)
    check = layout.check
    if check is None or len(given) < (2 if check.part.size == 1 else 1):
        return ""
    places = {part.offset: part.name for part in layout.parts if part.offset >= 0}
    places |= {layout.head: "data"} if layout.has_data else {}
    tried = product(
        sorted({check.asked, bool(asked)}, key=check.asked.__ne__),
        sorted(places, key=check.first.__ne__),
        _USUAL,
        _ORDERS,
    )
    for counts_asked, first, function, order in tried:
        if counts_asked <= bool(asked) and _fits(
            replace(check, asked=counts_asked, first=first), function, order, given
        ):
            begins = "" if first == check.first else places[first]
            return _in_words(layout, check, function, order, asked * counts_asked, begins)
    return ""


def _fits(check: Check, function: CheckFunction, order: Order, frames: list[Checked]) -> bool:
    """Whether another function, in the place of the check, is right in every frame."""
    return all(
        function((asked if check.asked else b"") + check.covered(frame))
        == int.from_bytes(check.part.raw(frame), order)
        for frame, asked in frames
    )


def _in_words(
    layout: Layout, check: Check, function: CheckFunction, order: Order, asked: str, begins: str
) -> str:
    """The check as a grammar declares it; `begins` is the part that its bytes begin with."""
    size, covered = check.part.size, layout.covered[0]
    kind = "Byte" if size == 1 else f"Int{8 * size}u{order[0]}"
    counted = f"asked.{asked}.data + " if asked else ""
    said = f'"{check.part.name}" / Checksum({kind}, {declared(function)}, '
    said += f"{counted}this.{covered}.data)"
    return said + (f', with "{covered}" beginning at "{begins}"' if begins else "")


def declared(function: CheckFunction) -> str:
    """A check as a grammar declares it."""
    if isinstance(function, Sum):
        complement = int(function.complement)
        return f"Sum({function.bits}{f', complement={complement}' if complement else ''})"
    if isinstance(function, Xor):
        return f"Xor({function.start or ''})"
    digits = function.width // 4
    said = f"Crc({function.width}, 0x{function.poly:0{digits}X}, 0x{function.init:0{digits}X}"
    said += ", reflected=True" if function.reflected else ""
    return said + (f", xorout=0x{function.xorout:0{digits}X})" if function.xorout else ")")
