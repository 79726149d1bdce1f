"""Captures that are written for a test: their events, and the metadata of a recording session."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from pathlib import Path

from bilprov.analyzer.replay.recorder import session_metadata
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS

START = 10**18  # ns since 1970


def write_capture(
    path: Path,
    events: Iterable[Chunk | Line],
    metadata: Mapping[str, str] | None = None,
    start: int = START,
) -> Path:
    """Write a capture of these events, in place of one that is there."""
    path.unlink(missing_ok=True)
    with CaptureWriter(path, start_wall=start, metadata=metadata or {}, version="1") as writer:
        for event in events:
            if isinstance(event, Chunk):
                writer.chunk(event)
            else:
                writer.write(event, event.t)
    return path


def record_places(data: bytes, opcode: int, start: int = 8) -> list[tuple[int, int]]:
    """Where each record with this opcode begins and ends in a whole capture, from `start` on."""
    found, at = [], start
    while at < len(data) - 8:
        kind, length = struct.unpack_from("<BQ", data, at)
        if kind == opcode:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


def about(protocol: Protocol, *heard: Direction) -> dict[str, str]:
    """The metadata of a session that hears these sides, or else both."""
    return session_metadata(
        protocol, ports={}, line="", timeout=50 * MS, skew=0, heard=heard or ("host", "device")
    )
