"""Records a run as evidence: all that is needed to judge it again, and the verdict beside it.

Messages: the raw bytes both ways and their decoding, each case's begin and end, each look, each
operation of the runner. The metadata hold the grammar's text. Attached at the start: options and
environment (`run.json`); at the end: what was measured (`profile.json`) and the report
(`verdict.json`, as `--json` writes it).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from bilprov.analyzer.client.operations import (
    OPERATION_NAMES,
    Ended,
    Observation,
    Operation,
    Received,
    Reconnected,
    Reply,
)
from bilprov.analyzer.decode.records import Record, shapes_of
from bilprov.analyzer.decode.session import BOTH, Session
from bilprov.analyzer.replay.recorder import RecordWriter, session_metadata
from bilprov.analyzer.transport.line_settings import timeout_in_ns
from bilprov.analyzer.version import kit_version
from bilprov.captures.closing import Closing
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import Asked, CaseMark, Chunk, Line, Look
from bilprov.captures.wall_clock import wall_clock
from bilprov.conformance.dut.target import Environment, Target
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol

RUN, PROFILE, VERDICT = "run.json", "profile.json", "verdict.json"
"""The names of the attachments."""


class RunRecorder(Closing, RunListener):
    """A run listener that writes everything of runs on a target into a new capture.

    `truncation_timeout` is the time-out in ms, `start_wall` the time of day (ns) at which the run
    begins, now if None. Times are ns since the start. Raises CaptureError if the file cannot be
    made. A later error (a full disk) must not keep the run from stopping the robot: it is kept in
    `broken`, and nothing more is written.
    """

    broken: CaptureError | None = None

    def __init__(
        self,
        path: str,
        target: Target,
        truncation_timeout: float | None = None,
        start_wall: int | None = None,
    ) -> None:
        protocol = target.protocol
        timeout = timeout_in_ns(protocol, truncation_timeout)
        metadata = session_metadata(
            protocol,
            ports={"device": target.environment.device},
            line=str(target.line),
            timeout=timeout,
            skew=0,
            heard=BOTH,
        )
        self._session = Session(protocol, timeout=timeout, skew=0)
        start = wall_clock() if start_wall is None else start_wall
        self._file = RecordWriter(path, start, metadata, shapes_of(protocol))
        self._now = 0
        self._event(Line(0, "open"))

    def _event(self, event: Chunk | Line) -> None:
        self._now = max(self._now, event.t)

        def write() -> None:
            self._file.event(event)
            self._decoded(self._session.feed(event))
            self._file.tick(self._now)

        self._try(write)

    def _mark(self, value: CaseMark | Look) -> None:
        self._now = max(self._now, value.t)
        self._try(lambda: self._file.write(value, value.t))

    def _decoded(self, records: Iterable[Record]) -> None:
        for record in records:
            self._file.record(record)

    def _try(self, write: Callable[[], None]) -> None:
        if self.broken is None:
            try:
                write()
            except CaptureError as error:
                self.broken = error

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that went to the device."""
        self._event(Chunk(max(t, self._now), "host", data))

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""
        self._event(Chunk(max(t, self._now), "device", data))

    def looked(self, look: Look) -> None:
        """A reading of the probe."""
        self._mark(look)

    def begin(self, ident: str) -> None:
        """A case begins."""
        self._mark(CaseMark(self._now, ident, "begin"))

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._mark(CaseMark(self._now, result.id, "end", result.verdict.label, result.reason))

    def begins(self, protocol: Protocol, options: object, environment: Environment) -> None:
        """The run begins: options and environment are written before anything is sent."""
        about = msgspec.json.encode(
            {
                "kit": kit_version(),
                "grammar": {"sha256": protocol.sha256, "file": protocol.origin},
                "options": options,
                "circumstances": environment,
            }
        )
        self._attach(RUN, "application/json", about)

    def done(self, operation: Operation | None, reply: Reply | Ended) -> None:
        """An operation was done or failed: one message, after the bytes and looks it brought."""
        name = OPERATION_NAMES[type(operation)]
        match reply:
            case Reconnected():
                self._event(Line(reply.lost, "unplugged", "device", str(reply)))
                self._event(Line(reply.now, "reconnected", "device", "the port is there again"))
                told = str(reply), reply.error, reply.line_works, reply.lost
                value = Asked(self._now, name, None, *told)
            case Ended():
                value = Asked(self._now, name, None, str(reply), reply.error, reply.line_works)
            case Observation():
                value = Asked(reply.now, name, reply.asked)
            case Received():
                self._now = max(self._now, reply.now)
                value = Asked(reply.now, name)
            case _:
                value = Asked(reply, name)
        self._try(lambda: self._file.write(value, value.t))

    def reported(self, report: Report) -> None:
        """The run is over."""
        self._attach(PROFILE, "application/json", msgspec.json.encode(report.profile))
        self._attach(VERDICT, "application/json", as_json(report))

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        self._try(lambda: self._file.attach(name, media_type, data, self._now))

    def close(self) -> None:
        """Finish the file."""
        self._try(lambda: self._decoded(self._session.finish()))
        self._try(self._file.close)
