"""Writes a run into a capture: the bytes as they came, and beside them what was decoded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from analyzer.decode.pairing import MILLISECOND
from analyzer.decode.records import DeviceRecord, Fault, HostRecord, Record, faults_of
from analyzer.version import kit_version
from captures.closing import Closing
from captures.schemas import Asked, CaseMark, Chunk, Direction, Line, Log, Look, State, Time
from captures.writer import CaptureWriter
from spec.protocol import Protocol


def session_metadata(
    protocol: Protocol,
    *,
    ports: Mapping[str, str],
    line: str,
    timeout: int,
    skew: int,
    heard: Iterable[Direction],
    attached: bool = False,
) -> dict[str, str]:
    """The capture's record `bilprov`: what a replay needs in order to decode in the same way.

    `ports` gives each port's part and name, `line` its settings as text, `timeout` and `skew` are
    in ns, `heard` the directions that are listened to, `attached` whether listening began in the
    midst of whatever was going on.
    """
    return {
        "version": kit_version(),
        "grammar_name": protocol.name,
        "grammar_version": protocol.version,
        "grammar_sha256": protocol.sha256,
        **{f"port_{part}": name for part, name in ports.items()},
        "line": line,
        "clock": "monotonic; log_time = wall clock at start + monotonic",
        "truncation_timeout_ms": f"{timeout / MILLISECOND:g}",
        "skew_ms": f"{skew / MILLISECOND:g}",
        "heard": " ".join(sorted(heard)),
        "attached": "yes" if attached else "no",
    }


class Recorder(Closing):
    """Writes events and records into a capture; a context manager that finishes the file.

    Raises CaptureError where the file cannot be written.
    """

    def __init__(self, path: str | Path, start_wall: int, metadata: Mapping[str, str]) -> None:
        self.path = Path(path)
        self.bytes = 0
        self._start = start_wall
        self._state: State | None = None
        self._writer = CaptureWriter(
            path, start_wall=start_wall, metadata=metadata, version=kit_version()
        )

    def event(self, event: Chunk | Line) -> None:
        """Write what came, before anything is made of it."""
        if isinstance(event, Chunk):
            self._writer.chunk(event)
            self.bytes += len(event.data)
        else:
            self._writer.write(event, event.t)

    def record(self, record: Record) -> None:
        """Write what was decoded: the frame, the state when it changes, and the faults."""
        if isinstance(record, HostRecord):
            self._writer.write(record.value, record.value.t)
            if record.state != self._state:
                self._state = record.state
                self._writer.write(record.state, record.value.end)
        elif isinstance(record, DeviceRecord):
            self._writer.write(record.value, record.value.t)
        for fault in faults_of(record):
            self._writer.write(self._log(fault), fault.t)

    def mark(self, value: CaseMark | Look | Asked, t: int) -> None:
        """Write what belongs to a conformance run, at `t` ns since the start."""
        self._writer.write(value, t)

    def attach(self, name: str, media_type: str, data: bytes, t: int) -> None:
        """Attach a file's content at `t` ns since the start."""
        self._writer.attach(name, media_type, data, t)

    def tick(self, now: int) -> None:
        """Let time pass (ns since the start): what has waited for 0.1 s reaches the disk."""
        self._writer.tick(now)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def _log(self, fault: Fault) -> Log:
        seconds, nanoseconds = divmod(self._start + fault.t, 1_000_000_000)
        return Log(Time(seconds, nanoseconds), int(fault.severity), fault.reason, fault.kind)
