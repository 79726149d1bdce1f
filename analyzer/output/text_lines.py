"""Renders records as lines of text, one per frame, device byte or anomaly; prints nothing.

A fully loaded serial line carries more frames than rich can style in time, so the text of each
distinct frame is rendered once and cached.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

import click

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    HostRecord,
    LineRecord,
    PerFrame,
    Record,
    Severity,
    severity_of,
)
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import usual_way
from bilprov.spec.state import State

HEX_WIDTH = 11  # fits four bytes; longer frames shift the rest of the line to the right
_LONGEST = 12  # bytes for which all lines are made wider
WORDS_WIDTH = 22

SEVERITY_COLOURS = {
    Severity.INFO: "cyan",
    Severity.WARNING: "yellow",
    Severity.ERROR: "red",
}


def hex_width(protocol: Protocol) -> int:
    """The columns for the bytes of most frames: a quarter of the kinds may be longer.

    What is counted in a frame is left out.
    """
    sizes = sorted(
        layout.head + data.length + layout.tail
        for spec in protocol.instructions
        for layout, data in ((protocol.layout.of(spec.id), spec), usual_way(protocol, spec))
        if data
    )
    usual = sizes[len(sizes) * 3 // 4] if sizes else 0
    return max(HEX_WIDTH, 3 * min(_LONGEST, usual) - 1)


class LineRenderer:
    """Renders records for one output.

    `colour` adds ANSI colour codes, which only a terminal should get. `time` writes
    a time (ns since the start), which is in seconds without it. The bytes have `width` columns.
    """

    def __init__(
        self,
        *,
        colour: bool,
        time: Callable[[int], str] | None = None,
        width: int = HEX_WIDTH,
    ) -> None:
        self._colour = colour
        self._width = width
        self._time = time or _seconds
        self._host = PerFrame(self._host_text)
        self._device = lru_cache(maxsize=8192)(self._device_text)
        self._state = lru_cache(maxsize=8192)(self._state_text)

    def text(self, records: Iterable[Record]) -> str:
        """Render the lines of the records, each with its newline."""
        return "".join([f"{self.line(record)}\n" for record in records])

    def line(self, record: Record) -> str:
        """Render one line without its newline, safe for a terminal and for a pipe."""
        if isinstance(record, HostRecord):
            text, why = self._host(record)
            return f"{self._time(record.t)} {text}{self._state(record.state)}{why}".rstrip()
        if isinstance(record, DeviceRecord):
            severity = severity_of(record) if record.faults else None
            text = self._device(record.hex, record.words, severity)
            latency = "" if record.latency is None else f" {record.latency / 1e6:8.3f} ms"
            why = self._why(record.reason, severity)
            return f"{self._time(record.t)} {text}{latency}{why}".rstrip()
        if isinstance(record, LineRecord) and not record.faults:
            line = record.value
            detail = f": {line.detail}" if line.detail else ""
            what = f"{line.tap} line {line.event}{detail}".lstrip()
            return f"{self._time(record.t)} - {what}"
        fault = record.faults[0]
        words = f"{fault.kind}: {fault.reason}"
        return f"{self._time(fault.t)} ! {self._paint(words, fault.severity)}"

    def _host_text(self, record: HostRecord) -> tuple[str, str]:
        """What stands before the state, and behind it."""
        severity = severity_of(record)
        body = f"{record.hex:<{self._width}}  {record.words:<{WORDS_WIDTH}}"
        text = f"→ {self._paint(body, severity)}"
        return text, self._why(record.reason, severity)

    def _device_text(self, coded: str, name: str, severity: Severity | None) -> str:
        body = f"{coded:<{self._width}}  {name:<13}"
        return f"← {self._paint(body, severity)}"

    def _state_text(self, state: State) -> str:
        words = state.described
        if not words:
            return ""
        return f"  {click.style(words, dim=True) if self._colour else words}"

    def _why(self, reason: str, severity: Severity | None) -> str:
        return self._paint(f"  {reason}", severity) if reason else ""

    def _paint(self, text: str, severity: Severity | None) -> str:
        return painted(text, severity) if self._colour else text


def painted(text: str, severity: Severity | None) -> str:
    """The text in the colour of what it tells: green where nothing is odd."""
    return click.style(text, fg="green" if severity is None else SEVERITY_COLOURS[severity])


def _seconds(t: int) -> str:
    return f"{t / 1e9:12.6f}"
