"""The file of `--expect-failures`: read before a run, held against its report, written anew."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Collection
from pathlib import Path

from captures.errors import shown
from conformance.report.expected import (
    Comparison,
    ExpectedError,
    Update,
    compare,
    parse_expected,
    require_known,
    updated,
)
from conformance.report.run_report import Report, compared

_MOST = 1 << 20  # bytes


class ExpectedFile:
    """A file of expected failures; with `update` it is written anew after the run.

    `known` are the ids of all cases of the whole suite, `suite` those that a run of this kind has
    when nothing is left out. Raises ExpectedError, before anything moves, for a file that cannot
    be read (or, with `update`, written; there it need not exist), a line that is no entry, and an
    entry that no case fits (with `update` it is taken out instead).
    """

    def __init__(
        self, path: str, known: Collection[str], suite: Collection[str], *, update: bool = False
    ) -> None:
        self._path = Path(path)
        self._name = shown(path)
        self._known, self._suite = known, suite
        self._update = update
        self._text = _read(self._path, self._name, missing_ok=update)
        entries = parse_expected(self._text, self._name)
        if update:
            _require_writable(self._path, self._name)
        else:
            require_known(entries, self._name, known)

    def applied(self, report: Report) -> tuple[Report, Update | None]:
        """The report with what the file says about it, and what was changed in the file, if so.

        A run that could not judge anything changes nothing. Raises ExpectedError.
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


def replace_file(path: Path, data: bytes) -> None:
    """Write a file so that there is always either the old one or the new one. Raises OSError."""
    target = path.resolve()
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    beside = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if mode is None:
            umask = os.umask(0)
            os.umask(umask)
            mode = 0o666 & ~umask
        beside.chmod(mode)
        beside.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise


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
    """What cannot be written is better known before the robot moves."""
    folder = path.resolve().parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ExpectedError(
            f"{name} cannot be written: name a file in a folder that exists and is yours"
        )
