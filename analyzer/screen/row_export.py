"""Writes the rows of a view into a new file, as CSV or as JSON lines, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING

from bilprov.analyzer.output.json_text import JsonText
from bilprov.captures.text import printable, quantity

if TYPE_CHECKING:
    from bilprov.analyzer.output.outputs import TextForm
    from bilprov.analyzer.output.row_columns import Column, Times
    from bilprov.analyzer.screen.recording import Recording, View
    from bilprov.spec.protocol import Protocol

_TOGETHER = 4096  # rows
FORMATS = (".csv", ".jsonl")


def refusal(name: str) -> str:
    """Why rows cannot be written into a file of this name, "" if they can."""
    path = Path(name)
    if path.suffix not in FORMATS:
        return f"the name ends in {' or '.join(FORMATS)}, which sets the format"
    return new_file_refusal(name)


def new_file_refusal(name: str) -> str:
    """Why no new file can have this name, "" if one can."""
    path = Path(name)
    try:
        if path.exists() or path.is_symlink():
            return f"{printable(name)} exists and is never overwritten: choose another name"
        if not path.absolute().parent.is_dir():
            return "name a file in a folder that exists"
    except (OSError, ValueError) as error:
        return f"no file can have this name: {printable(error)}"
    return ""


class RowExport:
    """Writes the rows that a view has now. `said` tells how it ended."""

    def __init__(
        self,
        recording: Recording,
        view: View,
        name: str,
        columns: tuple[Column, ...] | None,
        times: Times,
    ) -> None:
        self._recording = recording
        self._view = view
        self._path = Path(name)
        self._first, self._count = view.first, view.count
        self._columns, self._times = columns, times
        self._cancelled = Event()
        self._done = self._written = 0
        self.said = ""
        self._thread = Thread(target=self._run, name="export", daemon=True)
        self._thread.start()

    @property
    def doing(self) -> str:
        """How much is written, in words."""
        return f"exporting {self._done / max(1, self._count - self._first):.0%}"

    @property
    def ended(self) -> bool:
        """Whether nothing more is written."""
        return not self._thread.is_alive()

    def cancel(self) -> None:
        """Stop, and leave no file; returns when that is done."""
        self._cancelled.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            with self._path.open("x", encoding="utf-8", newline="") as file:
                self._write(file.write)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            self.said = f"{printable(self._path)} cannot be written ({printable(why)})"
            if not isinstance(error, FileExistsError):
                self._leave_nothing()
            return
        if self._cancelled.is_set():
            self.said = "the export was stopped: nothing is written"
            self._leave_nothing()
        else:
            self.said = f"{quantity(self._written, 'row')} written to {printable(self._path)}"

    def _write(self, write: Callable[[str], object]) -> None:
        form = self._form(self._recording.protocol, write)
        for at in range(self._first, self._count, _TOGETHER):
            if self._cancelled.is_set():
                return
            rows = self._view.rows(at, min(at + _TOGETHER, self._count))
            text = form.text(self._recording.records(rows))
            write(text)
            self._written += text.count("\n")  # events of the line are rows only on the screen
            self._done += len(rows)

    def _form(self, protocol: Protocol, write: Callable[[str], object]) -> TextForm:
        if self._path.suffix == ".jsonl":
            return JsonText()
        from bilprov.analyzer.output.csv_text import CsvText, usual_columns

        form = CsvText(self._columns or usual_columns(protocol), self._times)
        write(form.header)
        return form

    def _leave_nothing(self) -> None:
        with suppress(OSError):
            self._path.unlink()
