"""Records a session into a capture: the raw bytes, and the records decoded from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from bilprov.analyzer.decode.records import Anomaly, DeviceRecord, HostRecord, Record
from bilprov.analyzer.version import kit_version
from bilprov.captures.schemas import MS, Chunk, Direction, Line, Log, State, Time
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol


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
    """The capture's metadata record `bilprov`, which a replay needs to decode in the same way.

    `ports` maps each port's role to its name, `line` is the line settings as text, `timeout` and
    `skew` are in ns, `heard` are the directions that are listened to, and `attached` is true if
    listening began in running traffic.
    """
    return {
        "version": kit_version(),
        "grammar_name": protocol.name,
        "grammar_version": protocol.version,
        "grammar_sha256": protocol.sha256,
        **{f"port_{part}": name for part, name in ports.items()},
        "line": line,
        "clock": "monotonic; log_time = wall clock at start + monotonic",
        "truncation_timeout_ms": f"{timeout / MS:g}",
        "skew_ms": f"{skew / MS:g}",
        "heard": " ".join(sorted(heard)),
        "attached": "yes" if attached else "no",
    }


class Recorder(CaptureWriter):
    """Writes events and records into a capture; a context manager that finishes the file.

    Raises CaptureError where the file cannot be written.
    """

    def __init__(self, path: str | Path, start_wall: int, metadata: Mapping[str, str]) -> None:
        super().__init__(path, start_wall=start_wall, metadata=metadata, version=kit_version())
        self.bytes = 0
        self._state: State | None = None

    def event(self, event: Chunk | Line) -> None:
        """Write a raw event, before it is decoded."""
        if isinstance(event, Chunk):
            self.chunk(event)
            self.bytes += len(event.data)
        else:
            self.write(event, event.t)

    def record(self, record: Record) -> None:
        """Write a decoded record: the frame, the state when it changes, and the anomalies."""
        if isinstance(record, HostRecord):
            self.write(record.value, record.t)
            if record.state != self._state:
                self._state = record.state
                self.write(record.state, record.end)
        elif isinstance(record, DeviceRecord):
            self.write(record.value, record.t)
        for fault in record.faults:
            self.write(self._log(fault), fault.t)

    def _log(self, fault: Anomaly) -> Log:
        seconds, nanoseconds = divmod(self._start + fault.t, 1_000_000_000)
        return Log(Time(seconds, nanoseconds), int(fault.severity), fault.reason, fault.kind)
