"""What is done with a capture that may be damaged: read, mended, exported, edited.

Each raises CaptureError for a file that is refused, and Wrong where two ways that must agree
differ, or what was written is not whole.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import msgspec

from benchmarks.torture.capture_seeds import own_captures
from benchmarks.torture.guard import folder, require
from bilprov.analyzer.decode import stream
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.finding import of_capture
from bilprov.analyzer.edit.compare import compared
from bilprov.analyzer.edit.cut import (
    Copy,
    cut_metadata,
    edited_metadata,
    new_capture,
    write_selected,
    write_window,
)
from bilprov.analyzer.edit.join import Joined, write_joined
from bilprov.analyzer.export.pcapng import write_pcapng
from bilprov.analyzer.export.rows import Chosen, write_text
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.capture_info import summarized
from bilprov.analyzer.output.capture_stats import file_stats
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.plot.page import plot_page
from bilprov.analyzer.replay.capture_decoding import (
    capture_decoder,
    capture_line,
    capture_settings,
    opened_at,
    opened_whole,
    unheard,
)
from bilprov.analyzer.totals.timeline import Timeline
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture, open_capture, open_evidence, open_indexed
from bilprov.captures.schemas import Chunk
from bilprov.spec.errors import UserError


def examined(path: Path) -> None:
    """Open a capture, by its index too, read it in every way and examine it."""
    for finding in of_capture(path):
        require(bool(finding.sentence), "a finding says nothing")
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
    with suppress(CaptureError):
        open_evidence(path, attached)


def mended(path: Path) -> None:
    """Do what `capture repair` does: the new capture is whole, and holds the old one's bytes."""
    protocol = load_protocol()
    capture = open_capture(path)

    about = edited_metadata(capture, protocol, "repair")
    opened = opened_at(capture, protocol, 0)
    size, whole = _written([capture], about, lambda copy: write_window(opened, Window(), copy))
    require(size == len(_bytes_of(whole)), "what was recovered has other bytes than was said")
    require(_bytes_of(whole) == _bytes_of(capture), "what was recovered has other bytes")


def edited(path: Path) -> None:
    """Compare a capture with itself, cut a filter's part out of it, join it with another."""
    protocol, capture = load_protocol(), open_capture(path)
    require(
        compared([capture, capture], protocol, unheard).exit == 0, "a capture differs from itself"
    )
    test = compile_filter("faulty", protocol).started(capture.start)
    frames, part = _written(
        [capture],
        cut_metadata(capture, protocol, Window(), "faulty"),
        lambda copy: write_selected(
            lambda t: opened_at(capture, protocol, t), Window(), test, copy
        ),
    )
    size = len(_bytes_of(part))
    require(size <= len(_bytes_of(capture)), "a part has more bytes than the whole")
    require((frames > 0) <= (size > 0), "a part has frames and no bytes")
    try:
        joined = Joined(protocol, [capture, open_capture(_other())])
    except (CaptureError, UserError):
        return
    captures = [source.capture for source in joined.sources]
    said, both = _written(captures, joined.metadata(), lambda copy: write_joined(joined, copy))
    held = len(_bytes_of(capture)) + len(_bytes_of(open_capture(_other())))
    require(said == len(_bytes_of(both)) == held, "bytes were lost or doubled")


def _written(
    captures: list[Capture], metadata: dict[str, str], write: Callable[[Copy], None]
) -> tuple[int, Capture]:
    """What `write` says that it wrote into a new capture, and that capture, which is whole."""
    new = folder() / "new.mcap"
    with new_capture(new, captures, metadata, load_protocol(), unheard, force=True) as copy:
        write(copy)
    made = open_capture(new)
    require(not made.damage and not made.unfinished, "what was written is damaged")
    return copy.raw_bytes, made


def _bytes_of(capture: Capture) -> bytes:
    return b"".join(event.data for event in capture.events() if isinstance(event, Chunk))


@cache
def _other() -> Path:
    path = folder() / "other.mcap"
    path.write_bytes(own_captures()[0])
    return path


def exported(path: Path) -> None:
    """Decode a capture one by one and to columns, and write it in every form."""
    protocol, capture = load_protocol(), open_capture(path)
    played = list(capture.events())
    session = Session(protocol, **capture_settings(capture, protocol))
    decoder = capture_decoder(capture, protocol)
    records = [record for event in played for record in session.feed(event)]
    records += session.finish()
    before, stream.LEAST = stream.LEAST, 0  # else little traffic is left to a Session
    try:
        batches = [*decoder.feed(played), *decoder.finish()]
        found = [record for batch in batches for record in batch.records()]
        require(found == records, "columns hold other records")
        faulty = compile_filter("faulty or t > 0.1", protocol).started(capture.start)
        for chosen in (None, faulty):
            _export(capture, chosen)
        totals, timeline = Totals(protocol), Timeline(protocol)
        for batch in opened_whole(capture, protocol).decoded(unheard):
            totals.add(batch)
            timeline.add(batch)
    finally:
        stream.LEAST = before
    stats = file_stats(capture, totals, capture_line(capture, protocol))
    msgspec.json.encode(stats)
    require("</html>" in plot_page(capture, protocol, timeline, stats, "0"), "half a page")
    summarized(capture, protocol)


def _export(capture: Capture, test: Filter | None) -> None:
    chosen = Chosen(capture, load_protocol(), test, Window(), unheard)
    table, lines = io.BytesIO(), io.BytesIO()
    write_text(chosen, table, "csv")
    rows = list(csv.reader(io.StringIO(table.getvalue().decode(), newline="")))
    require(len({len(row) for row in rows}) == 1, "rows of CSV differ in length")
    write_text(chosen, lines, "jsonl")
    for line in lines.getvalue().splitlines():
        require(isinstance(json.loads(line), dict), "a line is no JSON object")
    write_pcapng(chosen, io.BytesIO())
