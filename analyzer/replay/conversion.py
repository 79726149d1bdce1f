"""Writes a capture anew with all that can be decoded from its bytes."""

from __future__ import annotations

from pathlib import Path

from bilprov.analyzer.decode.checkpoint import encoded_or_none
from bilprov.analyzer.decode.records import shapes_of
from bilprov.analyzer.replay.capture_parts import Progress
from bilprov.analyzer.replay.capture_session import capture_session
from bilprov.analyzer.replay.recorder import Checkpoints, RecordWriter, grammar_metadata
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line, look_class
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol


def write_decoded(
    capture: Capture, protocol: Protocol, path: str | Path, progress: Progress
) -> None:
    """Write a new capture with what was recorded, and every record that is decoded from it.

    Raw chunks, line events, what a conformance run noted, attachments and metadata are the same;
    where messages are lost, the `gap` stands in the new file. Checkpoints are made anew. `progress`
    is told of the raw bytes of each message; what it raises removes the new file.

    Raises CaptureError if the old file cannot be read, which leaves no new one, or the new file
    cannot be written.
    """
    out = _new_file(capture, protocol, path)
    done = False
    try:
        _write(capture, protocol, out, progress)
        done = True
        out.close()
    finally:
        if not done and not out.failed:
            out.close()
            out.path.unlink(missing_ok=True)


def _new_file(capture: Capture, protocol: Protocol, path: str | Path) -> RecordWriter:
    metadata = {
        key: text for key, text in capture.contents.metadata.items() if key != topics.START_KEY
    }
    # The new file's records are those of this grammar, whatever the old one's were.
    metadata |= grammar_metadata(protocol)
    try:
        return RecordWriter(path, capture.start, metadata, shapes_of(protocol))
    except ValueError as error:
        raise CaptureError(
            f"{printable(capture.path)} cannot be decoded into a new file: {error}"
        ) from error


def _write(capture: Capture, protocol: Protocol, out: RecordWriter, progress: Progress) -> None:
    session = capture_session(capture, protocol)
    checkpoints, size = Checkpoints(protocol.sha256), 0
    for file in capture.attachments():
        out.attach(file.name, file.media_type, file.data, file.log_time - capture.start)
    for value in capture.recorded(looks=look_class(protocol.state_type)):
        progress(len(value.data) if isinstance(value, Chunk) else 0)
        if isinstance(value, Chunk | Line):
            out.event(value)
            for record in session.feed(value):
                out.record(record)
            size += len(value.data) if isinstance(value, Chunk) else 0
            if made := checkpoints.made(value.t, size, lambda: encoded_or_none(session.saved())):
                out.write(made, value.t)
        elif not isinstance(value, Checkpoint):
            out.write(value, value.t)
    for record in session.finish():
        out.record(record)
