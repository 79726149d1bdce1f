"""Targets that decode: frames, sessions, columns and checkpoints, each held against another way."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from random import Random

import msgspec

from benchmarks.fuzz.engine import Target, Test, require
from benchmarks.fuzz.mutators import json_mutator, mutated_bytes
from bilprov.analyzer.decode import checkpoint, stream
from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.session import SKEW, Session, SessionSettings
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.spec.codec import judge, nearest
from bilprov.spec.framing import Framed, Framer
from bilprov.spec.protocol import Protocol

Event = Chunk | Line

# Ns between two events: mostly short; the ends of the time-outs and a byte beside them.
_PAUSES = (
    *(0, 0, 1, 1000, 100_000, MS, MS, 3 * MS, 5 * MS, 15 * MS, 20 * MS - 1, 20 * MS, 25 * MS),
    *(50 * MS - 1, 50 * MS, 100 * MS, 120 * MS, 999 * MS, 1000 * MS, 1001 * MS, 2500 * MS, -MS),
    *(-30 * MS, 1 << 53, 1 << 60),
)
_LATEST = 1 << 61  # ns; an opened capture gives no time that is much later
_WORDS = ("open", "break", "parity", "modem", "gap", "overrun", "unplugged", "reconnected", "x")
_TAPS: tuple[Direction | str, ...] = ("host", "device", "")
_TIMEOUTS = (None, None, None, None, 1, 5 * MS, 1500 * MS)
_HEARD: tuple[tuple[Direction, ...], ...] = (("host", "device"),) * 3 + (("host",), ("device",))


class Tape:
    """Reads an input byte by byte, as what traffic is made of; behind its end come zeros."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def over(self) -> bool:
        """Whether all has been read."""
        return self._at >= len(self._data)

    def byte(self) -> int:
        """The next byte."""
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def block(self, size: int) -> bytes:
        """The next bytes, as many as there are of `size`."""
        self._at += size
        return self._data[self._at - size : self._at]


def settings(tape: Tape) -> SessionSettings:
    """Settings of a session: one byte."""
    byte = tape.byte()
    return {
        "attached": bool(byte & 1),
        "skew": 0 if byte & 2 else SKEW,
        "timeout": _TIMEOUTS[(byte >> 2) % len(_TIMEOUTS)],
        "heard": frozenset(_HEARD[(byte >> 5) % len(_HEARD)]),
    }


def events(protocol: Protocol, tape: Tape) -> list[Event]:
    """Events on a line: for each a byte that says what, one that says when, and its bytes."""
    found: list[Event] = []
    due = bytearray()
    t = 0
    while not tape.over and len(found) < 200:
        what, when = tape.byte(), tape.byte()
        pause = _PAUSES[when % len(_PAUSES)] if when < 128 else when * 1000
        t = min(t + pause, _LATEST)
        kind, count = what % 8, what // 8
        if kind <= 2:
            frames = b"".join(_frame(protocol, tape) for _ in range(1 + count % 4))
            due.extend(_answers(protocol, frames))
            cut = count // 4
            found.append(Chunk(t, "host", frames[:cut] or frames))
            if cut and frames[cut:]:
                found.append(Chunk(t + MS * (count % 4), "host", frames[cut:]))
        elif kind <= 4:
            found.append(Chunk(t, "device", bytes(due[:count] or due)))
            del due[: count or len(due)]
        elif kind <= 6:
            side: Direction = "host" if kind == 5 else "device"
            found.append(Chunk(t, side, tape.block(count)))
        else:
            word, tap = _WORDS[count % len(_WORDS)], _TAPS[count % len(_TAPS)]
            found.append(Line(t, word, tap, "x" * (count % 3)))  # type: ignore[arg-type]
    return found


def _frame(protocol: Protocol, tape: Tape) -> bytes:
    header = tape.byte()
    frame = bytes([header]) + tape.block(protocol.lengths[header])
    return nearest(protocol, frame) if header & 1 else frame


def _answers(protocol: Protocol, data: bytes) -> Iterator[int]:
    at = 0
    while at < len(data):
        end = at + 1 + protocol.lengths[data[at]]
        if end <= len(data):
            yield judge(protocol, data[at:end]).response.code
        at = end


def conversations() -> list[bytes]:
    """Inputs that are conversations: mostly frames and their answers, some oddities."""
    found = []
    for seed in range(12):
        random = Random(seed)
        data = bytearray([random.choice((0, 0, 1, 2, 0x60, 0x80))])
        for _ in range(random.choice((3, 10, 40))):
            count = random.choice((0, 0, 1, 3))
            data += bytes([random.choice((0, 1, 2)) + 8 * count, random.choice((3, 5, 6))])
            data += random.randbytes(2 * (count + 1))
            data += bytes([3, random.choice((2, 3, 4, 5))])
            if random.random() < 0.1:
                data += bytes([random.randrange(256), random.randrange(128)])
        found.append(bytes(data))
    return found


def records_one_by_one(session: Session, played: Sequence[Event]) -> list[Record]:
    """The records that a Session gives, event by event."""
    records = [record for event in played for record in session.feed(event)]
    return records + session.finish()


def _shape(records: Sequence[Record]) -> Hashable:
    """What of some records tells an input from others: which kinds of records, which faults."""
    kinds = {type(record).__name__ for record in records}
    faults = {fault.kind for record in records for fault in record.faults}
    return frozenset(kinds), frozenset(faults), len(records).bit_length()


def framer() -> Test:
    """Frames of bytes that come in pieces are those of the bytes at once."""
    protocol = load_protocol()

    def test(data: bytes) -> Hashable:
        tape = Tape(data)
        size = 1 + tape.byte() % 9
        stream = tape.block(len(data))
        whole, pieces = Framer(protocol, MS), Framer(protocol, MS)
        once = whole.feed(stream, 0) + whole.drop(1)
        parts: list[Framed] = []
        for at in range(0, len(stream), size):
            parts += pieces.feed(stream[at : at + size], 0)
        parts += pieces.drop(1)
        require(parts == once, "pieces give other frames")
        require(b"".join(frame.data for frame in once) == stream, "frames have other bytes")
        return len(once).bit_length(), once[-1].kind if once else ""

    return test


def session() -> Test:
    """Records of chunks are those of bytes one by one and those of arrays, each byte in one."""
    protocol = load_protocol()

    def test(data: bytes) -> Hashable:
        tape = Tape(data)
        chosen, sizes = settings(tape), [1 + tape.byte() % 32, 1000]
        played = events(protocol, tape)
        records = records_one_by_one(Session(protocol, **chosen), played)
        single = [part for event in played for part in _byte_by_byte(event)]
        found = records_one_by_one(Session(protocol, **chosen), single)
        require(found == records, "bytes give other records")
        with columns_at_once():
            found = in_columns(StreamDecoder(protocol, **chosen), played, sizes)
        require(found == records, "columns hold other records")
        host = b"".join(record.data for record in records if isinstance(record, HostRecord))
        require(host == _bytes_of(played, "host"), "records have other bytes of the host")
        device = bytes(record.byte for record in records if isinstance(record, DeviceRecord))
        require(device == _bytes_of(played, "device"), "records have other bytes of the device")
        for record in records:
            msgspec.json.encode(json_line(record))
        return _shape(records)

    return test


def _byte_by_byte(event: Event) -> list[Event]:
    if not isinstance(event, Chunk) or not event.data:
        return [event]
    return [Chunk(event.t, event.direction, bytes([byte])) for byte in event.data]


def _bytes_of(played: Sequence[Event], side: Direction) -> bytes:
    chunks = (event for event in played if isinstance(event, Chunk))
    return b"".join(chunk.data for chunk in chunks if chunk.direction == side)


@contextmanager
def columns_at_once() -> Iterator[None]:
    """Decode little traffic into columns too, which is otherwise left to a Session."""
    before, stream.LEAST = stream.LEAST, 0
    try:
        yield
    finally:
        stream.LEAST = before


def in_columns(
    decoder: StreamDecoder, played: Sequence[Event], sizes: Sequence[int] = (1000,)
) -> list[Record]:
    """The records of a StreamDecoder that takes events in batches of these sizes."""
    parts, at, turn = [], 0, 0
    while at < len(played):
        size = sizes[turn % len(sizes)]
        parts += decoder.feed(played[at : at + size])
        at, turn = at + size, turn + 1
    parts += decoder.finish()
    return [record for part in parts for record in part.records()]


@cache
def _afterwards() -> tuple[Event, ...]:
    """Some regular traffic, with times from 0 on."""
    protocol = load_protocol()
    tape = Tape(conversations()[0] * 2)
    return tuple(event for event in events(protocol, tape) if isinstance(event, Chunk))


def checkpoints() -> Test:
    """A decoder's state from a file is refused or goes on: a session and columns agree."""
    protocol = load_protocol()

    def test(data: bytes) -> Hashable:
        state = checkpoint.decoded(data.decode("utf-8", "surrogateescape"), protocol)
        if state is None:
            return None
        require(checkpoint.decoded(checkpoint.encoded(state), protocol) == state, "another state")
        chosen: SessionSettings = {
            "timeout": state.timeout,
            "skew": state.skew,
            "heard": frozenset(state.heard),
        }
        one, other = Session(protocol, **chosen), StreamDecoder(protocol, **chosen)
        try:
            one.resume(state)
        except ValueError:  # sides in another order, or one of them twice
            return "refused"
        other.resume(state)
        played = [msgspec.structs.replace(e, t=e.t + state.time) for e in _afterwards()]
        records = records_one_by_one(one, played)
        with columns_at_once():
            require(in_columns(other, played) == records, "columns hold other records")
        for record in records:
            msgspec.json.encode(json_line(record))
        return _shape(records)

    return test


def _states() -> list[bytes]:
    """The states of sessions in the middle of the seeds' traffic."""
    protocol = load_protocol()
    found: set[str] = set()
    for data in conversations():
        tape = Tape(data)
        one = Session(protocol, **settings(tape))
        for event in events(protocol, tape):
            one.feed(event)
            state = one.saved()
            if state is not None and len(found) < 60:
                found.add(checkpoint.encoded(state))
    return [text.encode() for text in sorted(found)]


_KEYS = tuple(field.name for field in msgspec.structs.fields(DecoderState))

TARGETS = (
    Target("framer", framer, (), conversations, mutated_bytes, 18),
    Target("session", session, (), conversations, mutated_bytes, 2),
    Target("checkpoint", checkpoints, (), _states, json_mutator(_KEYS), 8),
)
