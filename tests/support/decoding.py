"""Builds events, decodes them into records, and queries the records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.replay.capture_decoding import capture_settings
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol

MS = 1_000_000  # ns

Event = Chunk | Line


def conversation(
    exchanges: Sequence[tuple[bytes, bytes]], period: int = 20 * MS, latency: int = MS
) -> list[Chunk]:
    """Events of a host that waits for each answer; times in ns."""
    events: list[Chunk] = []
    for at, (said, answered) in enumerate(exchanges, 1):
        events.append(Chunk(at * period, "host", said))
        if answered:
            events.append(Chunk(at * period + latency, "device", answered))
    return events


def decoded(session: Session, events: Iterable[Event]) -> list[Record]:
    records: list[Record] = []
    for event in events:
        records += session.feed(event)
    return records + session.finish()


def hosts(records: Iterable[Record]) -> list[HostRecord]:
    return [record for record in records if isinstance(record, HostRecord)]


def devices(records: Iterable[Record]) -> list[DeviceRecord]:
    return [record for record in records if isinstance(record, DeviceRecord)]


def kinds(records: Iterable[Record]) -> list[str]:
    return [fault.kind for record in records for fault in record.faults]


def capture_session(capture: Capture, protocol: Protocol) -> Session:
    """A session with the settings of the recording one."""
    return Session(protocol, **capture_settings(capture, protocol))
