"""The file of `--expect-failures`: read before a run, compared with its report, and updated.

Its text has one entry per line, `GLOB : AXIS` or `GLOB : AXIS: MESSAGE`. Empty lines and lines that
begin with # are ignored. GLOB matches case ids, * crosses /. AXIS is the axis that fails (`answer`,
`stop` or `state`). MESSAGE is for the reader alone: another version of the kit may word a failure
differently, and means the same one:

    # the board takes all eight bits of the LED byte (issue 12)
    bad-data/LED/* : answer: OK instead of BAD_DATA

A case is an expected failure when each of its axes that fails matches an entry. An entry is stale,
and itself a failure, when all of its cases were judged and none of them fails any more.
"""

from __future__ import annotations

import glob
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from bilprov.analyzer.files import read_bounded, why_not_writable, write_whole
from bilprov.captures.text import escape_controls, printable
from bilprov.conformance.cases.levels import CONDITIONAL_CASES, matching
from bilprov.conformance.oracle.verdicts import AXES, VOUCHED, CaseResult, Verdict
from bilprov.conformance.report.run_report import Comparison, Report, compared
from bilprov.spec.errors import UserError, one_line

_SEPARATOR = " : "
_BYTES = 1 << 20
_FORM = "GLOB : AXIS: MESSAGE"
_NEW_FILE = f"# Failures that are expected, {_FORM}; see bilprov conform --help\n"


class ExpectedError(UserError):
    """A file of expected failures cannot be used. The message is one sentence for the user."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the file: cases that match `glob` may fail on `axis`; `message` is a note."""

    glob: str
    axis: str
    message: str
    line: int

    def __str__(self) -> str:
        failure = f"{self.axis}: {self.message}" if self.message else self.axis
        return f"{self.glob}{_SEPARATOR}{failure}"

    def among(self, ids: Collection[str]) -> list[str]:
        """The ids that the glob matches."""
        return [self.glob] if self.glob in ids else list(filter(matching([self.glob]), ids))


def parse_expected(text: str, file: str) -> tuple[Entry, ...]:
    """The entries of a file's text. Raises ExpectedError, naming file and line."""
    entries = []
    for number, line in enumerate(text.split("\n"), 1):  # as an editor counts them
        words = escape_controls(line.replace("\t", " ").strip())
        if not words or words.startswith("#"):
            continue
        pattern, _, failure = words.partition(_SEPARATOR)
        axis, _, message = failure.partition(":")
        pattern, axis = pattern.strip(), axis.strip()
        if not pattern or axis not in AXES:
            raise ExpectedError(
                f"{file}, line {number} is {printable(words)!r}; write {_FORM} (a glob of case "
                f"ids; {', '.join(AXES[:-1])} or {AXES[-1]}; a message if you like), or # and a "
                "comment"
            )
        entries.append(Entry(pattern, axis, printable(_plain(message)), number))
    return tuple(entries)


@dataclass(frozen=True, slots=True)
class Matches:
    """What entries and failures have in common.

    `expected` are the ids of the cases that fail only as entries say, `unexpected` has a new entry
    for each axis that fails otherwise, `stale` are the entries that no longer fail.
    """

    expected: frozenset[str]
    unexpected: tuple[str, ...]
    stale: tuple[Entry, ...]


def match(
    entries: Sequence[Entry],
    results: Sequence[CaseResult],
    suite: Collection[str],
    *,
    whole: bool = True,
) -> Matches:
    """Match the failures of a run with the entries.

    `suite` are the ids of all cases that a run of this kind has, also of those that this one left
    out (--only). `whole` says that the run went to its end: only then does the absence of
    a conditional case (such as an unsolicited answer) show that it does not fail.
    """
    tests = [(entry, matching([entry.glob])) for entry in entries]
    used, expected, unexpected = set(), set(), []
    for result in results:
        if result.verdict is not Verdict.FAIL:
            continue
        its = {entry for entry, fits in tests if fits(result.id)}
        failing = {n: axis for n, axis in result.axes.items() if axis.verdict is Verdict.FAIL}
        used |= {entry for entry in its if entry.axis in failing}
        left = {n: axis for n, axis in failing.items() if n not in {e.axis for e in its}}
        if failing and not left:
            expected.add(result.id)
        for name, axis in left.items():
            reason = axis.reason or f"{axis.actual} instead of {axis.expected}"
            unexpected.append(f"{glob.escape(result.id)}{_SEPARATOR}{name}: {_plain(reason)}")
    fine = {result.id for result in results if result.verdict in VOUCHED}
    if whole:
        fine |= set(CONDITIONAL_CASES) - {result.id for result in results}
    stale = [
        entry
        for entry in entries
        if entry not in used and (its_ids := entry.among(suite)) and fine.issuperset(its_ids)
    ]
    return Matches(frozenset(expected), tuple(unexpected), tuple(stale))


def _plain(message: str) -> str:
    return " ".join(message.split())


class ExpectedFile:
    """A file of expected failures; with `update` it is rewritten after the run.

    `suite` are the ids of all cases that a run of this kind has when nothing is left out. An entry
    that matches none of them has no effect: another level may have its cases. Raises ExpectedError,
    before the robot moves, for a file that cannot be read (or, with `update`, written; it then need
    not exist), and for a line that is no entry.
    """

    def __init__(self, path: str, suite: Collection[str], *, update: bool) -> None:
        self._path, self._name = Path(path), one_line(path)
        self._suite, self._update = dict.fromkeys(suite), update
        self._text = _read(self._path, self._name, missing_ok=update)
        self._entries = parse_expected(self._text, self._name)
        why_not = why_not_writable(self._path) if update else ""
        if why_not:
            raise ExpectedError(f"{self._name} cannot be written: {why_not}")

    def applied(self, report: Report) -> tuple[Report, str]:
        """The report with its comparison, and a sentence on what was changed in the file, or "".

        A run that could not judge anything does not change the file. Raises ExpectedError.
        """
        whole, said = not (report.ended or report.unusable), ""
        found = match(self._entries, report.results, self._suite, whole=whole)
        if self._update and not report.unusable:
            new = tuple(dict.fromkeys(found.unexpected))
            self._rewrite({entry.line for entry in found.stale}, new)
            changed = f": {len(new)} added, {len(found.stale)} removed"
            said = self._name + (changed if new or found.stale else " fits")
            found = match(self._entries, report.results, self._suite, whole=whole)
        failed = report.counts[Verdict.FAIL.label]
        comparison = Comparison(
            file=self._name,
            expected=len(found.expected),
            unexpected=failed - len(found.expected),
            stale=tuple(map(self._stale, found.stale)),
        )
        return compared(report, comparison, found.expected), said

    def _stale(self, entry: Entry) -> str:
        its = entry.among(self._suite)
        what = f"{its[0]} does" if len(its) == 1 else f"its {len(its)} cases do"
        return (
            f"{self._name}, line {entry.line}: {entry}: {what} "
            "not fail any more; take the entry out, or run with --update-expected"
        )

    def _rewrite(self, gone: Collection[int], new: Sequence[str]) -> None:
        """Write the file without the lines that are `gone` and with new ones; comments stay."""
        lines = self._text.split("\n")
        left = "\n".join(line for number, line in enumerate(lines, 1) if number not in gone)
        if left and not left.endswith("\n"):
            left += "\n"
        text = (left or _NEW_FILE) + "".join(f"{line}\n" for line in new)
        self._entries = parse_expected(text, self._name)
        try:
            if text != self._text:
                write_whole(self._path, text.encode())
        except OSError as error:
            raise ExpectedError(
                f"{self._name} cannot be written ({error.strerror}); it is as it was before"
            ) from error


def _read(path: Path, name: str, *, missing_ok: bool) -> str:
    if missing_ok and not path.exists():
        return ""
    try:
        return read_bounded(path, _BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else f"byte {error.start} is not UTF-8"
        raise ExpectedError(
            f"{name} cannot be read ({why}); it takes lines of {_FORM}, and --update-expected "
            "makes a new one"
        ) from error
