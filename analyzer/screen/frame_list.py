"""The list of frames and the list of faults: rows of a recording, drawn from its columns."""

from __future__ import annotations

from rich.text import Text

from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    HostRecord,
    LineRecord,
    Record,
    Severity,
    serious_faults,
    severity_of,
)
from bilprov.analyzer.output.row_columns import COLUMNS, TIME, Column, RowStyle, Times, cells
from bilprov.analyzer.output.text_lines import SEVERITY_COLOURS
from bilprov.analyzer.screen.recording import Recording, View
from bilprov.analyzer.screen.rows import Rows
from bilprov.analyzer.screen.signs import Signs
from bilprov.captures.text import printable

WHAT = Column("what", "what", 30, "the frame in words, or the answer and its latency", lambda r: "")
"""A column of this list alone, which is made from the record."""

_USUAL = (TIME, COLUMNS["hex"], WHAT, COLUMNS["reason"])
_NARROW = 60  # columns, under which the bytes are left to the pane of bytes
_FRONT = 3  # columns before the first cell: a sign, the direction, a space
_BUNCH = 64  # rows that are looked at together


class FrameList(Rows):
    """The rows of a view.

    `held` is how many rows the recording had when the view was paused, None where it is not.
    """

    def __init__(
        self, recording: Recording, style: RowStyle, start_wall: int, signs: Signs
    ) -> None:
        super().__init__("frames", signs, "frames")
        self.view = View(recording)
        self.held: int | None = None
        self.marks: set[int] = set()
        self.columns = style.columns
        self.time_style = style.times(start_wall).style
        self._start_wall = start_wall
        self._recording = recording

    @property
    def count(self) -> int:
        """How many rows are shown."""
        return self.view.count if self.held is None else self.view.position(self.held)

    @property
    def start(self) -> int:
        """The first row that was not let go."""
        return self.view.first

    @property
    def row(self) -> int | None:
        """The number of the chosen row in the recording; None without rows."""
        rows = self.view.rows(self.cursor, self.cursor + 1)
        return rows[0] if rows else None

    @property
    def record(self) -> Record | None:
        """The chosen row's record; None without rows."""
        row = self.row
        found = self._recording.records([row]) if row is not None else []
        return found[0] if found else None

    def go_to(self, row: int) -> None:
        """Choose a row of the recording, or the next one of the view."""
        self.choose(self.view.position(row))

    def position_at(self, t: int) -> int:
        """The last position, from the chosen one on, whose row is not later than `t` (ns)."""
        position = self.cursor
        while position + 1 < self.count:
            rows = self.view.rows(position + 1, position + 1 + _BUNCH)
            due = [record for record in self._recording.records(rows) if record.t <= t]
            position += len(due)
            if len(due) < _BUNCH:
                break
        return position

    def look_at(self, view: View) -> None:
        """Show another view, with the same row chosen if it has it."""
        row = self.row
        self.view = view
        self.top = view.first
        self.go_to(row or 0)

    def heading(self, width: int) -> Text:
        """The names of the columns."""
        text = Text(" " * _FRONT, "bold dim", no_wrap=True)
        for column, room in self._widths(width):
            text.append(self._padded(column.heading, room, column.right) + " ")
        return text

    def lines(self, first: int, stop: int, width: int) -> list[Text]:
        """The rows from `first` to before `stop`."""
        before = first > self.start  # the row before the first is what a delta counts from
        rows = self.view.rows(first - before, stop)
        records = self._recording.records(rows)
        times = Times(self.time_style, self._start_wall)
        shown = [
            self._line(row, record, times, width)
            for row, record in zip(rows, records, strict=False)
        ]
        return shown[before:]

    def _widths(self, width: int) -> list[tuple[Column, int]]:
        """The columns that fit, each with its width; the last one takes what is left."""
        columns = self.columns
        if columns is None:
            columns = _USUAL if width >= _NARROW else tuple(c for c in _USUAL if c.name != "hex")
        left = width - _FRONT
        fitting: list[tuple[Column, int]] = []
        for column in columns:
            room = Times(self.time_style).width if column is TIME else column.width
            if fitting and left < min(room, 8):
                break
            fitting.append((column, min(room, left)))
            left -= min(room, left) + 1
        if fitting and left > 0:
            column, room = fitting[-1]
            fitting[-1] = column, room + left + 1
        return fitting

    def _line(self, row: int, record: Record, times: Times, width: int) -> Text:
        severity = severity_of(record)
        serious = severity is not None and severity > Severity.INFO
        style = _style(record, severity)
        mark = self.signs.mark if row in self.marks else "!" if serious else " "
        text = Text(no_wrap=True)
        text.append(mark, f"bold {style}" if serious else "bold")
        direction = self._direction(record)
        text.append(f"{direction} ", "bold cyan" if direction == self.signs.to_device else "bold")
        line = json_line(record)
        if line is None:
            assert isinstance(record, LineRecord)
            return text.append(f"{times.padded(record.t)} {event_words(record)}", "dim")
        for column, room in self._widths(width):
            cell = _words(record) if column is WHAT else cells(line, (column,), times)[0]
            dim = column is TIME or column.name == "reason"
            text.append(self._padded(cell, room, column.right), "dim" if dim else style)
            text.append(" ")
        return text

    def _direction(self, record: Record) -> str:
        if isinstance(record, HostRecord):
            return self.signs.to_device
        return self.signs.to_host if isinstance(record, DeviceRecord) else "-"

    def _padded(self, text: str, room: int, right: bool) -> str:
        cut = text if len(text) <= room else text[: max(0, room - 1)] + self.signs.cut
        return cut.rjust(room) if right else cut.ljust(room)


class FaultList(Rows):
    """The rows of a recording that have an anomaly, in one line each; `held` as in FrameList."""

    def __init__(self, recording: Recording, signs: Signs) -> None:
        super().__init__("faults", signs, "faults")
        self.held: int | None = None
        self._recording = recording

    @property
    def count(self) -> int:
        """How many there are."""
        faults = self._recording.faults
        return faults.members if self.held is None else faults.before(self.held)

    @property
    def start(self) -> int:
        """The first one that was not let go."""
        return self._recording.faults.before(self._recording.first)

    @property
    def row(self) -> int | None:
        """The number of the chosen row in the recording; None without any."""
        rows = self._recording.faults.slice(self.cursor, self.cursor + 1)
        return rows[0] if rows else None

    def follow(self, row: int) -> None:
        """Choose the last fault up to a row of the recording."""
        self.choose(self._recording.faults.before(row + 1) - 1)

    def lines(self, first: int, stop: int, width: int) -> list[Text]:
        """The faults from the `first` to before the `stop`."""
        records = self._recording.records(self._recording.faults.slice(first, stop))
        return [_fault_line(record) for record in records]


def event_words(record: LineRecord) -> str:
    """A line event in words."""
    line = record.value
    where = f"{printable(line.tap)} line" if line.tap else "line"
    return f"{where} {printable(line.event)}" + (
        f": {printable(line.detail)}" if line.detail else ""
    )


def _words(record: Record) -> str:
    if isinstance(record, HostRecord):
        return printable(record.words)
    if isinstance(record, DeviceRecord):
        late = "" if record.latency is None else f"  {record.latency / 1e6:.3f} ms"
        return record.words + late
    return printable(record.faults[0].kind)


def _fault_line(record: Record) -> Text:
    fault = serious_faults(record)[0]
    colour = f"bold {SEVERITY_COLOURS[fault.severity]}"
    line = Text.assemble((f"{fault.t / 1e9:12.6f} ", "dim"), (printable(fault.kind), colour))
    return line.append(f"  {printable(fault.reason)}")


def _style(record: Record, severity: Severity | None) -> str:
    if severity is not None:
        return SEVERITY_COLOURS[severity]
    return "green" if isinstance(record, HostRecord | DeviceRecord) else ""
