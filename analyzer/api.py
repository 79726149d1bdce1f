"""What `from bilprov import ...` offers for bytes and captures; the protocol comes last and is the
kit's own unless another is given (see `load_protocol`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from analyzer.decode.records import DeviceRecord, HostRecord, Record
from analyzer.decode.session import Session
from analyzer.grammar_file import load_protocol
from analyzer.replay.capture_session import capture_session
from captures.reader import open_capture
from captures.schemas import Chunk, Direction
from spec import codec
from spec import explain as explaining
from spec.codec import Judgement
from spec.explain import Explanation
from spec.protocol import Protocol


def judge(frame: bytes, protocol: Protocol | None = None) -> Judgement:
    """What a conforming device makes of one frame.

    Raises ValueError for no bytes or for more than the header announces.
    """
    return codec.judge(protocol or load_protocol(), frame)


def encode(
    instruction: str, fields: Mapping[str, int] | None = None, protocol: Protocol | None = None
) -> bytes:
    """The bytes of an instruction: `encode("LED", {"rgb": 5})`.

    Raises ValueError, in one sentence, for an unknown instruction or field, a missing field or a
    value out of its range.
    """
    return codec.build(protocol or load_protocol(), instruction, fields)


def explain(
    data: bytes, direction: Direction = "host", protocol: Protocol | None = None
) -> Explanation:
    """What every bit of some bytes means, and what a conforming device answers and does."""
    if direction == "host":
        return explaining.explain(protocol or load_protocol(), data)
    return explaining.explain_responses(protocol or load_protocol(), data)


def decode(
    data: bytes, direction: Direction = "host", protocol: Protocol | None = None
) -> list[HostRecord | DeviceRecord]:
    """The frames in some bytes of the host, or the responses in some of the device.

    The bytes count as sent in one go: times are 0, and a last frame that is not whole is reported
    as cut short.
    """
    session = Session(protocol or load_protocol(), heard=frozenset({direction}))
    records = [*session.feed(Chunk(0, direction, data)), *session.finish()]
    return [record for record in records if isinstance(record, HostRecord | DeviceRecord)]


def read_capture(path: str | Path, protocol: Protocol | None = None) -> Iterator[Record]:
    """A capture's records in order, decoded anew: frames, answers, line events and faults.

    Times are ns since the capture's start. Raises CaptureError, in one sentence, when the file
    cannot be read as a capture.
    """
    capture = open_capture(path)
    session = capture_session(capture, protocol or load_protocol())
    for event in capture:
        yield from session.feed(event)
    yield from session.finish()
