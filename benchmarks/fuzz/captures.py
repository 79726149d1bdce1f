"""Targets that read capture files: opening, by index and as evidence, mending, exporting."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Hashable
from functools import cache
from itertools import pairwise
from pathlib import Path
from struct import unpack_from

import msgspec
from mcap.writer import CompressionType, Writer

from benchmarks.fuzz.capture_mutator import mutated_capture
from benchmarks.fuzz.engine import Target, Test, folder, require
from benchmarks.fuzz.traffic import (
    Tape,
    columns_at_once,
    conversations,
    events,
    in_columns,
    records_one_by_one,
)
from benchmarks.product import metadata
from bilprov.analyzer.decode.checkpoint import encoded
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.capture_file import of_capture
from bilprov.analyzer.edit.cut import write_window
from bilprov.analyzer.edit.new_capture import edited_metadata, new_capture
from bilprov.analyzer.export.pcapng import write_pcapng
from bilprov.analyzer.export.text import write_csv, write_jsonl
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.capture_info import summarized
from bilprov.analyzer.output.capture_stats import file_stats
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.plot.page import plot_page
from bilprov.analyzer.replay.capture_parts import Chosen, decoded_batches
from bilprov.analyzer.replay.capture_session import capture_decoder, capture_line, capture_session
from bilprov.analyzer.replay.recorder import RecordWriter
from bilprov.analyzer.replay.seek import opened_at
from bilprov.analyzer.totals.timeline import Timeline
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.evidence import open_evidence
from bilprov.captures.reader import Capture, open_capture, open_indexed
from bilprov.captures.schemas import MS, Asked, CaseMark, Checkpoint, Chunk, Resumption
from bilprov.captures.storage.records import MAGIC
from bilprov.captures.topics import CarLook

_START = 1_790_000_000_000_000_000  # ns since 1970


def capture_file(data: bytes) -> Path:
    """A file with these bytes, in place of the one before."""
    path = folder() / "input.mcap"
    path.write_bytes(data)
    return path


def reader() -> Test:
    """A capture is refused in a sentence, or read whole, by its index too, and examined."""

    def test(data: bytes) -> Hashable:
        path = capture_file(data)
        for finding in of_capture(path):
            require(bool(finding.sentence), "a finding says nothing")
        return examined(path)

    return test


def examined(path: Path) -> Hashable:
    """What a capture comes to that is opened, by its index too, and read in every way.

    Raises CaptureError, and Wrong where two of the ways do not agree.
    """
    indexed = open_indexed(path)
    capture = open_capture(path)
    held = list(capture.events())
    require(len(list(capture.sights())) >= len(held), "there are fewer sights than events")
    for message in capture.messages():
        require(message.topic in capture.contents.counts, "a topic is not counted")
    list(capture.recorded())
    attached = {file.name for file in capture.attachments()}
    size = capture.contents.size
    require(0 <= capture.left_out <= size, "more bytes are left out than there are")
    if indexed is not None and not capture.damage and not capture.unfinished:
        require(indexed.start == capture.start, "the index tells another start")
        require(list(indexed.events()) == held, "the index leads to other events")
        after = indexed.checkpoint_before(1 << 62)
        if after is not None:
            list(indexed.recorded(after))
    try:
        sound = not open_evidence(path, attached).capture.unfinished
    except CaptureError:
        sound = None
    return _seen(capture), indexed is None, sound, len(held).bit_length()


def _seen(capture: Capture) -> Hashable:
    notes = [note.partition("(")[2] for note in capture.damage[:2]]
    return (
        capture.unfinished,
        len(capture.damage),
        *("".join(filter(str.isalpha, n)) for n in notes),
    )


def mending() -> Test:
    """What `capture repair` writes is whole, and holds the events of the broken capture."""

    def test(data: bytes) -> Hashable:
        return mended(capture_file(data))

    return test


def mended(path: Path) -> Hashable:
    """What a capture comes to of which `capture repair` writes what is whole.

    Raises CaptureError, and Wrong where the new capture is damaged or has other bytes.
    """
    protocol = load_protocol()
    new = folder() / "new.mcap"
    capture = open_capture(path)
    metadata = edited_metadata(capture, protocol, "repair")
    try:
        with new_capture(new, capture.start, metadata, protocol, force=True) as out:
            for file in capture.attachments():
                at = file.log_time - capture.start
                out.attach(file.name, file.media_type, file.data, at)
            opened = opened_at(capture, protocol, 0)
            size = write_window(opened, protocol, out, Window(), lambda count: None)
        whole = open_capture(new)
        require(not whole.damage and not whole.unfinished, "what was recovered is damaged")
        found = sum(len(one.data) for one in whole.events() if isinstance(one, Chunk))
        require(found == size, "what was recovered has other bytes than was said")
        held = b"".join(e.data for e in capture.events() if isinstance(e, Chunk))
        kept = b"".join(e.data for e in whole.events() if isinstance(e, Chunk))
        require(held == kept, "what was recovered has other bytes")
    finally:
        new.unlink(missing_ok=True)
    return _seen(capture), size.bit_length()


def exporting() -> Test:
    """What is decoded and written of any capture is well formed, and the same in columns."""
    protocol = load_protocol()
    faulty = compile_filter("faulty or t > 0.1", protocol)

    def test(data: bytes) -> Hashable:
        capture = open_capture(capture_file(data))
        played = list(capture.events())
        records = records_one_by_one(capture_session(capture, protocol), played)
        with columns_at_once():
            found = in_columns(capture_decoder(capture, protocol), played)
            require(found == records, "columns hold other records")
            for chosen in (None, faulty.started(capture.start)):
                _export(capture, chosen)
            totals, timeline = Totals(protocol), Timeline(protocol)
            for batch in decoded_batches(capture, protocol, lambda count: None):
                totals.add(batch)
                timeline.add(batch)
        stats = file_stats(capture, totals, capture_line(capture, protocol))
        msgspec.json.encode(stats)
        require("</html>" in plot_page(capture, protocol, timeline, stats, "0"), "half a page")
        summarized(capture, protocol)
        return _seen(capture), len(records).bit_length()

    return test


def _export(capture: Capture, test: Filter | None) -> None:
    chosen = Chosen(capture, load_protocol(), test, Window(), lambda count: None)
    for write in (write_csv, write_jsonl, write_pcapng):
        out = io.BytesIO()
        write(chosen, out)
        _REQUIRED[write.__name__](out.getvalue())


def _require_csv(data: bytes) -> None:
    rows = list(csv.reader(io.StringIO(data.decode(), newline="")))
    require(len({len(row) for row in rows}) == 1, "rows of CSV differ in length")


def _require_jsonl(data: bytes) -> None:
    for line in data.decode().splitlines():
        require(isinstance(json.loads(line), dict), "a line is no JSON object")


def _require_pcapng(data: bytes) -> None:
    at = 0
    while at < len(data):
        require(len(data) - at >= 12, "a block is cut short")
        length = unpack_from("<I", data, at + 4)[0]
        require(length >= 12 and length % 4 == 0, "a block has no such length")
        require(at + length <= len(data), "a block ends behind the file")
        require(unpack_from("<I", data, at + length - 4)[0] == length, "a block's lengths differ")
        at += length


_REQUIRED = {
    "write_csv": _require_csv,
    "write_jsonl": _require_jsonl,
    "write_pcapng": _require_pcapng,
}


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


def _written(*, decoded: bool) -> bytes:
    """A capture as `sniff` and `conform` write it, with every kind of message."""
    protocol = load_protocol()
    path = folder() / "seed.mcap"
    path.unlink(missing_ok=True)
    about = metadata(protocol) | {topics.MACHINE: "fuzz"}
    session = Session(protocol, timeout=50 * MS, skew=0)
    with RecordWriter(path, _START, about) as out:
        out.attach("run.json", "application/json", b"{}", 0)
        for turn, event in enumerate(events(protocol, Tape(conversations()[decoded]))):
            if not 0 <= event.t < 1 << 40:
                continue
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


def capture_seeds() -> list[bytes]:
    """Small good captures of each kind, of bilprov and of another program."""
    found = [*own_captures(), *foreign_captures(), loose_capture()]
    require(all(one.startswith(MAGIC) for one in found), "a seed is no capture")
    require(all(one != other for one, other in pairwise(found)), "two seeds are the same")
    return found


_REFUSED = (CaptureError,)

TARGETS = (
    Target("reader", reader, _REFUSED, capture_seeds, mutated_capture, 2),
    Target("repair", mending, _REFUSED, capture_seeds, mutated_capture, 0.4),
    Target("export", exporting, _REFUSED, capture_seeds, mutated_capture, 0.2),
)
