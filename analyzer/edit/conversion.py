"""Writes a capture anew with all that can be decoded from its bytes."""

from __future__ import annotations

from bilprov.analyzer.decode.checkpoint import encoded_or_none
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.replay.capture_parts import Progress
from bilprov.analyzer.replay.capture_session import capture_settings
from bilprov.analyzer.replay.recorder import Checkpoints, RecordWriter, grammar_metadata
from bilprov.captures import topics
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line, look_class
from bilprov.spec.protocol import Protocol


def decoded_metadata(capture: Capture, protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture for a copy whose records are those of this grammar."""
    about = dict(capture.contents.metadata)
    about.pop(topics.START_KEY, None)
    return about | grammar_metadata(protocol)


def write_decoded(
    capture: Capture, protocol: Protocol, out: RecordWriter, progress: Progress
) -> None:
    """Write what was recorded, and every record that is decoded from it.

    Where messages are lost, the `gap` stands in the new file. Checkpoints are made anew. `progress`
    is told of the raw bytes of each message. Raises CaptureError as `Capture.events` and the writer
    do.
    """
    session = Session(protocol, **capture_settings(capture, protocol))
    checkpoints, size = Checkpoints(protocol.sha256), 0
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
