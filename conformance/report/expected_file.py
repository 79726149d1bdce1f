"""The file of `--expect-failures`: read before a run, compared with its report, and updated."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from bilprov.analyzer.files import read_bounded, why_not_writable, write_whole
from bilprov.conformance.report.expected import (
    FORM,
    ExpectedError,
    Update,
    all_fit,
    compare,
    parse_expected,
    require_known,
    updated,
)
from bilprov.conformance.report.run_report import Report, compared
from bilprov.spec.errors import one_line

_MOST = 1 << 20  # bytes


class ExpectedFile:
    """A file of expected failures; with `update` it is rewritten after the run.

    `suite` are the ids of all cases that a run of this kind has when nothing is left out, `known`
    gives those of the whole suite, and is called only for an entry that fits none of `suite`.
    Raises ExpectedError, before the robot moves, for a file that cannot be read (or, with `update`,
    written; it then need not exist), a line that is no entry, and an entry that matches no case
    (with `update` it is removed instead).
    """

    def __init__(
        self,
        path: str,
        known: Callable[[], Collection[str]],
        suite: Collection[str],
        *,
        update: bool = False,
    ) -> None:
        self._path = Path(path)
        self._name = one_line(path)
        self._known, self._suite = known, suite
        self._update = update
        self._text = _read(self._path, self._name, missing_ok=update)
        entries = parse_expected(self._text, self._name)
        why_not = why_not_writable(self._path) if update else ""
        if why_not:
            raise ExpectedError(f"{self._name} cannot be written: {why_not}")
        if not update:
            require_known(entries, self._name, self._every_id())

    def applied(self, report: Report) -> tuple[Report, Update | None]:
        """The report with its comparison, and the update of the file, None where there is none.

        A run that could not judge anything does not change the file. Raises ExpectedError.
        """
        whole = not (report.ended or report.unusable)
        change = None
        if self._update and not report.unusable:
            known = self._every_id()
            change = updated(
                self._text, self._name, report.results, self._suite, known, whole=whole
            )
            if change.text != self._text or not self._path.exists():
                self._text = change.text
                self._write()
        entries = parse_expected(self._text, self._name)
        comparison, expected = compare(
            entries, self._name, report.results, self._suite, whole=whole
        )
        return compared(report, comparison, expected), change

    def _every_id(self) -> Collection[str]:
        """The ids that entries may fit: those of this run where they all do."""
        entries = parse_expected(self._text, self._name)
        return self._suite if all_fit(entries, self._suite) else self._known()

    def _write(self) -> None:
        try:
            write_whole(self._path, self._text.encode())
        except OSError as error:
            raise ExpectedError(
                f"{self._name} cannot be written ({error.strerror}); it is as it was before"
            ) from error


def _read(path: Path, name: str, *, missing_ok: bool) -> str:
    if missing_ok and not path.exists():
        return ""
    try:
        text = read_bounded(path, _MOST).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ExpectedError(
            f"{name} is not UTF-8 text (byte {error.start}); it takes lines of {FORM}"
        ) from error
    except OSError as error:
        hint = f"it takes lines of {FORM}"
        if isinstance(error, FileNotFoundError):
            hint = "--update-expected makes a new one"
        raise ExpectedError(f"{name} cannot be read ({error.strerror}); {hint}") from error
    if "\0" in text:
        raise ExpectedError(f"{name} has zero bytes in it; it takes lines of {FORM}")
    return text.removeprefix("\ufeff")
