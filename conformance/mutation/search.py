"""Searches for inputs at which a faulty device differs from the reference.

Both devices are sent the same seeded random sequences, side by side: frames of every kind, in the
usual deliveries, and the frames at which the words of the fault hint. What shows a difference is
shortened. A search that finds nothing proves nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import msgspec

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.steps import FrameClass, Inputs
from bilprov.conformance.dut.simulator import Event, Fault, Simulator
from bilprov.conformance.mutation.catalogue import Draw
from bilprov.conformance.mutation.triggers import Trigger
from bilprov.spec.codec import judge, raw_frame
from bilprov.spec.protocol import Protocol

_PARTS = ((8000, 2000), (100_000, 20_000), (40_000, 400))
"""Inputs of each part of a search, and of each of its sequences, from power-on to power-off."""
MOST = max(inputs for inputs, _ in _PARTS)
_SHORTENING = 50_000  # inputs sent at most to shorten a sequence
_TOLD = 8  # inputs of a sequence that are named in words
_IDLE = 400 * MS  # how long to wait for what a device does without an input
_SPLIT = 3 * MS
_RUNS = (16, 70, 250)  # how often a frame is sent in a row
_VALUES = ("value", "speed", "steering", "led")
_EXAMPLES = 3  # frames of a trigger that are inputs of their own
_HEADERS_AND_BYTES = ("id", "length", "size", "excess", "first-byte", "second-byte", "last-byte")
_WAYS = (
    *3 * ("",),
    *2 * ("sent ahead", "after 170 ms", "split"),
    *("after 400 ms", "in a row"),
)
"""The deliveries of a frame; one that stands several times is drawn more often."""


class Symbol(NamedTuple):
    """One input: in words, a (pause before it in ns, value) for each byte, and the pause after."""

    words: str
    bytes: tuple[tuple[int, int], ...]
    after: int = 0


class Search(msgspec.Struct, frozen=True):
    """The result of a search, of so many inputs `tried`.

    `shown` are the inputs, in words, of a sequence that shows the fault (empty if none was found),
    `difference` is what differs after it.
    """

    shown: tuple[str, ...] = ()
    difference: str = ""
    tried: int = 0

    def __str__(self) -> str:
        if not self.shown:
            return f"not shown by {self.tried:,} random inputs"
        last = ", ".join(self.shown[-_TOLD:])
        first = f"{len(self.shown):,} inputs, last " if len(self.shown) > _TOLD else ""
        return f"shows after {first}{last}: {self.difference}"


def search(protocol: Protocol, fault: Fault, most: int = MOST) -> Search:
    """Search in a few long sequences and in many short ones, in each part `most` inputs at most."""
    inputs, tried = _inputs(protocol, fault), 0
    for count, length in _PARTS:
        length = min(length, most)
        for _ in range(max(1, min(count, most) // length)):
            sequence = [next(inputs) for _ in range(length)]
            shown, _ = try_sequence(protocol, fault, sequence)
            tried += length
            if shown:
                words, differs = _shortened(protocol, fault, sequence[: len(shown)])
                return Search(words, differs, tried)
    return Search(tried=tried)


def _inputs(protocol: Protocol, fault: Fault) -> Iterator[Symbol]:
    """Yield random inputs without end; every fourth is one at which the fault hints, if any."""
    draw, supply, hinted = Draw(1), Inputs(protocol, 1), hints(protocol, fault)
    kinds = (*supply.kinds, FrameClass.TRUNCATED)
    while True:
        if hinted and not draw.below(4):
            frame = draw.pick(hinted)
        else:
            frame = supply.next(draw.pick(draw.pick((supply.valid_kinds, kinds)))).frame
        yield _symbol(protocol, frame, draw)


def _symbol(protocol: Protocol, frame: bytes, draw: Draw) -> Symbol:
    """The frame in one of the deliveries; one that is cut short is followed by its time-out."""
    byte = line_settings(protocol).byte_time
    missing = len(frame) <= protocol.lengths[frame[0]]
    way = draw.pick(_WAYS)
    pauses = {"sent ahead": byte, "after 170 ms": 170 * MS, "after 400 ms": _IDLE}
    pause, between, times, after = pauses.get(way, 3 * byte), byte, 1, 0
    if missing:
        way, pause = "cut short", 3 * byte
        after = int(protocol.timing.truncation_timeout * MS * 5 / 4)
    elif way == "split":
        between = _SPLIT
    elif way == "in a row":
        times = draw.pick(_RUNS) if not draw.below(8) else 2
        way, pause = f"{times} times", draw.pick((byte, 3 * byte))
    each = zip((pause, *[between] * (len(frame) - 1)), frame, strict=True)
    words = f"{judge(protocol, frame).describe()} [{frame.hex(' ')}] {way}".rstrip()
    return Symbol(words, tuple(each) * times, after)


def hints(protocol: Protocol, fault: Fault) -> list[bytes]:
    """Frames at which a fault shows, from its trigger and its effect; some are cut short."""
    wheels = fault.what.split() if fault.show else []
    values = {int(word) for word in wheels if word.isdigit()}
    acting, examples = fault.trigger, list[bytes]()
    if isinstance(acting, Trigger):
        for part in filter(None, (acting, acting.since, acting.until)):
            for term in part.terms:
                values |= set(term.values) if term.subject in _VALUES else set()
        examples = _examples(protocol, acting)
    around = (end for value in sorted(values) for end in (value, value - 1) if 0 <= end <= 0xFF)
    return [*(frame for value in around for frame in _with_value(protocol, value)), *examples]


def _with_value(protocol: Protocol, value: int) -> Iterator[bytes]:
    """Yield each instruction with this value in its first field, or in its first byte."""
    for spec in protocol.instructions:
        for part in spec.fields[:1]:
            inside = part.low <= value <= part.high
            rest = b"".join(other.build(other.low) for other in spec.fields[1:])
            data = part.build(value) + rest if inside else bytes([value]).ljust(spec.length, b"\0")
            yield raw_frame(protocol, spec.id, spec.length, data)


def _examples(protocol: Protocol, acting: Trigger) -> list[bytes]:
    """Some frames of a trigger that is about headers or data bytes, cut ones too."""
    frame_terms = acting.about_frame
    if all(term.subject not in _HEADERS_AND_BYTES for term in frame_terms):
        return []
    bytes_ = [t.values[0] for t in frame_terms if t.subject.endswith("-byte")]
    sizes = [t.values[0] for t in frame_terms if t.subject == "size"]
    found = []
    for header, length in enumerate(protocol.lengths):
        for fill, place in product([protocol.pad_byte, *bytes_], (0, 1, length - 1)):
            data = bytearray([protocol.pad_byte] * length)
            if 0 <= place < length:
                data[place] = fill
            for size in sizes or [length + 1]:
                frame = bytes([header, *data])[:size]
                kind = "instruction" if size > length else "truncated"
                event = Event(protocol, judge(protocol, frame), protocol.power_on, 0, 0, kind, 0)
                if all(term.holds(term.of(event)) for term in frame_terms):
                    found.append(frame)
    return list(dict.fromkeys(found))[:_EXAMPLES]


def _shortened(
    protocol: Protocol, fault: Fault, sequence: Sequence[Symbol]
) -> tuple[tuple[str, ...], str]:
    """Shorten a sequence that shows the fault: leave out halves, then quarters, then inputs.

    A count of many inputs cannot be shortened: after `_SHORTENING` inputs it is left as it is.
    Returns the words of what is left, and what differs after it.
    """
    size, sent = len(sequence) // 2, 0
    while size and sent < _SHORTENING:
        start = 0
        while start < len(sequence) and sent < _SHORTENING:
            sent += len(sequence)
            fewer = [*sequence[:start], *sequence[start + size :]]
            shown, _ = try_sequence(protocol, fault, fewer)
            if shown:
                sequence = fewer[: len(shown)]
            else:
                start += size
        size //= 2
    return try_sequence(protocol, fault, sequence)


def try_sequence(
    protocol: Protocol, fault: Fault, sequence: Sequence[Symbol]
) -> tuple[tuple[str, ...], str]:
    """Send inputs to both devices until they differ; return their words and what differs."""
    pair = _Pair(protocol, fault)
    pair.watch(10 * MS)
    for index, symbol in enumerate(sequence, 1):
        pair.send(symbol)
        if index == len(sequence):
            pair.watch(_IDLE)
        if pair.difference:
            return tuple(sent.words for sent in sequence[:index]), pair.difference
    return (), ""


class _Pair:
    """Both devices side by side from power-on; `difference` is what differs first, "" so far."""

    def __init__(self, protocol: Protocol, fault: Fault) -> None:
        self._reference, self._faulty = Simulator(protocol), Simulator(protocol, fault)
        self._now = 0
        self.difference = ""

    def send(self, symbol: Symbol) -> None:
        """Send an input to both."""
        for pause, byte in symbol.bytes:
            self.watch(pause)
            for device in (self._reference, self._faulty):
                device.receive(bytes([byte]), self._now)
            self._compare(self._now)
        self.watch(symbol.after)

    def watch(self, time: int) -> None:
        """Let so much time (ns) pass, until they differ."""
        until = self._now + time
        while self._now < until and not self.difference:
            due = (self._reference.deadline(), self._faulty.deadline())
            self._now = min((t for t in due if t is not None and t < until), default=until)
            self._compare(self._now)

    def _compare(self, now: int) -> None:
        due, given = self._reference.advance(now), self._faulty.advance(now)
        if due != given:
            due_words, words = due.hex(" ") or "nothing", given.hex(" ") or "nothing"
            self.difference = f"answers {words} where {due_words} is due"
        elif self._faulty.fault.show or self._reference.state != self._faulty.state:
            look, seen = self._reference.look(now), self._faulty.look(now)
            for name in look.__struct_fields__:
                wanted, actual = getattr(look, name), getattr(seen, name)
                if wanted != actual and not self.difference:
                    self.difference = f"{name} is {actual} where {wanted} is due"
