"""Small good captures of bilprov and of another program, as bytes: what is damaged afterwards."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import cache
from random import Random

from mcap.writer import CompressionType, Writer

from benchmarks.product import metadata
from benchmarks.torture.guard import folder
from benchmarks.torture.unplugged_taps import Talk
from bilprov.analyzer.decode.checkpoint import encoded
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.recorder import RecordWriter
from bilprov.captures import topics
from bilprov.captures.schemas import MS, Asked, CaseMark, Checkpoint, Chunk, Line, Resumption
from bilprov.captures.topics import PART, CarLook
from bilprov.captures.writer import CaptureWriter

_START = 1_790_000_000_000_000_000  # ns since 1970
_TURNS = 40  # instructions
_EVENTS = ("gap", "modem", "parity", "unplugged", "reconnected")


@cache
def own_captures() -> tuple[bytes, ...]:
    """Small captures of bilprov: finished, without decoded topics, and one cut off."""
    whole, raw = (_written(decoded=decoded) for decoded in (True, False))
    return whole, raw, whole[: len(whole) * 2 // 3]


@cache
def foreign_captures() -> tuple[bytes, ...]:
    """Small captures of another program, one for each compression, with checksums."""
    return tuple(_foreign(kind) for kind in CompressionType)


@cache
def loose_capture() -> bytes:
    """A small capture of another program whose messages are in no chunk: no checksum has them."""
    return _foreign(CompressionType.NONE, chunked=False)


@cache
def parts() -> tuple[bytes, ...]:
    """A recording in three parts."""
    about = metadata(load_protocol())
    paths = [folder() / f"part-{number}.mcap" for number in range(3)]
    writer: CaptureWriter = RecordWriter(paths[0], _START, {**about, PART: "1"})
    for number, path in enumerate(paths):
        if number:
            writer.go_on_in(path, {**about, PART: str(number + 1)})
        for turn in range(12):
            t = (12 * number + turn) * 10 * MS
            writer.chunk(Chunk(t, "host", bytes([turn]) * 4))
            writer.chunk(Chunk(t + MS, "device", bytes([number])))
            if turn % 4 == 3:
                writer.write(Line(t + 2 * MS, "modem", "host", "RTS"), t + 2 * MS)
                writer.flush()
    writer.close()
    return tuple(path.read_bytes() for path in paths)


def _events(seed: int) -> Iterator[Chunk | Line]:
    """A conversation in which an answer is missing and something happens to the line at times."""
    talk = Talk(Random(seed))
    for turn in range(_TURNS):
        t = turn * 10 * MS
        frame, answer = talk.next()
        yield Chunk(t, "host", frame)
        if turn % 7 != 3:
            yield Chunk(t + MS, "device", answer)
        if turn % 8 == 5:
            yield Line(t + 2 * MS, _EVENTS[turn // 8], "host", "x")


def _written(*, decoded: bool) -> bytes:
    """A capture as `sniff` and `conform` write it, with every kind of message."""
    protocol = load_protocol()
    path = folder() / "seed.mcap"
    path.unlink(missing_ok=True)
    about = metadata(protocol) | {topics.MACHINE: "a machine"}
    session = Session(protocol, timeout=50 * MS, skew=0)
    with RecordWriter(path, _START, about) as out:
        out.attach("run.json", "application/json", b"{}", 0)
        for turn, event in enumerate(_events(seed=decoded)):
            out.event(event)
            for record in session.feed(event) if decoded else ():
                out.record(record)
            if state := session.saved() if turn % 4 == 3 else None:
                made = Checkpoint.of(event.t, protocol.sha256, encoded(state), None)
                out.write(made, event.t)
                out.event(Resumption(event.t, "gap", checkpoint=made, silent=turn % 16 == 7))
            out.write(CarLook(event.t, True, motion="forward", left=3), event.t)
            out.write(Asked(event.t, "send"), event.t)
            out.write(CaseMark(event.t, f"case/{turn}", "end", "pass"), event.t)
            if turn % 6 == 5:
                out.flush()
    return path.read_bytes()


def _foreign(kind: CompressionType, chunked: bool = True) -> bytes:
    """A capture by the official library, with the times of two messages in the wrong order."""
    out = io.BytesIO()
    writer = Writer(out, compression=kind, use_chunking=chunked, chunk_size=200)
    writer.start("", "another writer")
    names = {topics.HOST_RAW: topics.RAW_ENCODING, topics.DEVICE_RAW: topics.RAW_ENCODING}
    names |= {topics.LINE: topics.JSON_ENCODING, "/other": topics.JSON_ENCODING}
    ids = {name: writer.register_channel(name, kind, 0) for name, kind in names.items()}
    writer.add_metadata(topics.METADATA_NAME, {topics.START_KEY: str(_START), "line": "9600 8E1"})
    frame = bytes([load_protocol().pad_byte])
    data = {
        topics.HOST_RAW: frame * 3,
        topics.DEVICE_RAW: bytes(3),
        topics.LINE: b'{"t": 0, "event": "gap", "tap": "host", "detail": ""}',
        "/other": b'{"a": [1]}',
    }
    for turn in range(6):
        for name, channel in ids.items():
            time = _START + turn * MS - (turn == 3) * 2 * MS
            writer.add_message(channel, time, data[name], time, turn)
    writer.add_attachment(_START, _START, "a.txt", "text/plain", b"content")
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()
