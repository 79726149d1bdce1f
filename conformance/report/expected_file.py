"""The file of `--expect-failures`: read before a run, compared with its report, and updated."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

from bilprov.analyzer.files import replace_file
from bilprov.captures.text import printable
from bilprov.conformance.report.expected import (
    Comparison,
    ExpectedError,
    Update,
    compare,
    parse_expected,
    require_known,
    updated,
)
from bilprov.conformance.report.run_report import Report, compared

_MOST = 1 << 20  # bytes


class ExpectedFile:
    """A file of expected failures; with `update` it is rewritten after the run.

    `known` are the ids of all cases of the whole suite, `suite` those that a run of this kind has
    when nothing is left out. Raises ExpectedError, before the robot moves, for a file that cannot
    be read (or, with `update`, written; it then need not exist), a line that is no entry, and an
    entry that matches no case (with `update` it is removed instead).
    """

    def __init__(
        self, path: str, known: Collection[str], suite: Collection[str], *, update: bool = False
    ) -> None:
        self._path = Path(path)
        self._name = printable(path)
        self._known, self._suite = known, suite
        self._update = update
        self._text = _read(self._path, self._name, missing_ok=update)
        entries = parse_expected(self._text, self._name)
        if update:
            _require_writable(self._path, self._name)
        else:
            require_known(entries, self._name, known)

    def applied(self, report: Report) -> tuple[Report, Update | None]:
        """The report with its comparison, and the update of the file, None where there is none.

        A run that could not judge anything does not change the file. Raises ExpectedError.
        """
        whole = not (report.ended or report.unusable)
        change = None
        if self._update and not report.unusable:
            change = updated(
                self._text, self._name, report.results, self._suite, self._known, whole=whole
            )
            if change.text != self._text or not self._path.exists():
                self._text = change.text
                self._write()
        return compared(report, self._compared(report, whole=whole)), change

    def _compared(self, report: Report, *, whole: bool) -> Comparison:
        entries = parse_expected(self._text, self._name)
        return compare(entries, self._name, report.results, self._suite, whole=whole)

    def _write(self) -> None:
        try:
            replace_file(self._path, self._text.encode())
        except OSError as error:
            raise ExpectedError(
                f"{self._name} cannot be written ({error.strerror}); it is as it was before"
            ) from error


def _read(path: Path, name: str, *, missing_ok: bool) -> str:
    try:
        if missing_ok and not path.exists():
            return ""
        if not path.is_file() and path.exists():
            raise ExpectedError(f"{name} is no regular file; name a text file of GLOB : MESSAGE")
        with path.open("rb") as file:
            data = file.read(_MOST + 1)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "no file can have this name"
        hint = "; --update-expected makes a new one" if isinstance(error, FileNotFoundError) else ""
        raise ExpectedError(f"{name} cannot be read ({why}){hint}") from error
    if len(data) > _MOST:
        raise ExpectedError(f"{name} is larger than 1 MiB: that is no list of expected failures")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ExpectedError(
            f"{name} is no text in UTF-8 (byte {error.start}); it takes lines of GLOB : MESSAGE"
        ) from error
    if "\0" in text:
        raise ExpectedError(f"{name} has zero bytes in it; it takes lines of GLOB : MESSAGE")
    return text.removeprefix("\ufeff")


def _require_writable(path: Path, name: str) -> None:
    """Raise ExpectedError, before the robot moves, where the file could not be written after it."""
    folder = path.resolve().parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ExpectedError(
            f"{name} cannot be written: name a file in a folder that exists and is yours"
        )
