"""Compares a run's results with expected failures: finds unexpected ones and stale entries. No I/O.

The text of a file of expected failures has one entry per line, `GLOB : AXIS` or
`GLOB : AXIS: MESSAGE`. Empty lines and lines that begin with # are ignored. GLOB matches case ids,
* crosses /. AXIS is the axis that fails (`answer`, `stop` or `state`). MESSAGE is for the reader
alone: another version of the kit may word a failure differently, and means the same one:

    # the board takes all eight bits of the LED byte (issue 12)
    bad-data/LED/* : answer: OK instead of BAD_DATA

A case is an expected failure when each of its axes that fails matches an entry. An entry is stale,
and itself a failure, when all of its cases were judged and none of them fails any more.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import msgspec

from bilprov.captures.text import escape_controls, printable
from bilprov.conformance.cases.selection import CONDITIONAL_CASES, LONGEST_GLOB, matching
from bilprov.conformance.oracle.verdicts import CaseResult, Count, Verdict
from bilprov.spec.errors import UserError

_SEPARATOR = " : "
_AXES = ("answer", "stop", "state")
_FINE = (Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT)
_MOST = 10_000  # entries: each is compared with each case
FORM = "GLOB : AXIS: MESSAGE"
"""How an entry is written."""

_NEW_FILE = f"# Failures that are expected, {FORM}; see bilprov conform --help\n"


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


class Comparison(msgspec.Struct, frozen=True):
    """The result of comparing a run with the entries of `file`.

    `expected` is how many cases fail only as entries say, `unexpected` how many others fail,
    `stale` has a sentence for each entry that no longer fails.
    """

    file: str
    expected: Count
    unexpected: Count
    stale: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Update:
    """The file's new text, and the lines that were added and removed."""

    text: str
    added: tuple[str, ...]
    removed: tuple[str, ...]


def parse_expected(text: str, file: str) -> tuple[Entry, ...]:
    """The entries of a file's text. Raises ExpectedError, naming file and line."""
    entries = []
    for number, line in enumerate(_lines(text), 1):
        words = escape_controls(line.replace("\t", " ").strip())
        if not words or words.startswith("#"):
            continue
        glob, _, failure = words.partition(_SEPARATOR)
        axis, _, message = failure.partition(":")
        glob, axis = glob.strip(), axis.strip()
        if not glob or axis not in _AXES:
            raise ExpectedError(
                f"{file}, line {number} is {printable(words)!r}; write {FORM} (a glob of case "
                f"ids; {', '.join(_AXES[:-1])} or {_AXES[-1]}; a message if you like), or # and a "
                "comment"
            )
        if len(glob) > LONGEST_GLOB:
            raise ExpectedError(
                f"{file}, line {number}: the glob {printable(glob)!r} has {len(glob)} characters, "
                f"allowed are {LONGEST_GLOB}; see the ids with bilprov conform sim --list"
            )
        entries.append(Entry(glob, axis, printable(_plain(message)), number))
        if len(entries) > _MOST:
            raise ExpectedError(f"{file} has more than {_MOST} entries; name several with one glob")
    return tuple(entries)


def all_fit(entries: Iterable[Entry], ids: Collection[str]) -> bool:
    """Whether each entry fits a case of these ids."""
    return all(_ids(entry, ids) for entry in entries)


def require_known(entries: Iterable[Entry], file: str, known: Collection[str]) -> None:
    """Raise ExpectedError, naming file and line, for an entry that no case of the suite fits."""
    for entry in entries:
        if not _ids(entry, known):
            raise ExpectedError(
                f"{file}, line {entry.line}: no case matches "
                f"{entry.glob!r}; see the ids "
                "with bilprov conform sim --list, or take the entry out"
            )


def failures(result: CaseResult) -> dict[str, str]:
    """Each axis that fails, with its reason in one line."""
    return {
        name: _plain(axis.reason or f"{axis.actual} instead of {axis.expected}")
        for name, axis in result.axes.items()
        if axis.verdict is Verdict.FAIL
    }


def compare(
    entries: Sequence[Entry],
    file: str,
    results: Sequence[CaseResult],
    suite: Collection[str],
    *,
    whole: bool = True,
) -> tuple[Comparison, set[str]]:
    """Compare a run's results with the entries; the ids are those that fail as expected.

    `suite` are the ids of all cases that a run of this kind has, also of those that this one left
    out (--only). `whole` says that the run went to its end: only then does the absence of
    a conditional case (such as an unsolicited answer) show that it does not fail.
    """
    used, expected, unexpected = _used(entries, results)
    fine = {r.id for r in results if r.verdict in _FINE}
    if whole:
        fine |= set(CONDITIONAL_CASES) - {r.id for r in results}
    stale = []
    for entry in entries:
        its = _ids(entry, suite)
        if entry not in used and its and fine.issuperset(its):
            what = f"{its[0]} does" if len(its) == 1 else f"its {len(its)} cases do"
            stale.append(
                f"{file}, line {entry.line}: {entry}: {what} "
                "not fail any more; take the entry out, or run with --update-expected"
            )
    return Comparison(file, len(expected), unexpected, tuple(stale)), expected


def updated(
    text: str,
    file: str,
    results: Sequence[CaseResult],
    suite: Collection[str],
    known: Collection[str],
    *,
    whole: bool = True,
) -> Update:
    """The file's text brought up to date: failures of this run are added, stale entries removed.

    Comments stay where they are, and so do entries that still fit and those whose cases were not
    all judged; entries that no case of `known` fits are removed. Raises ExpectedError as
    `parse_expected` does.
    """
    entries = parse_expected(text, file)
    used, _, _ = _used(entries, results)
    judged = {r.id for r in results if r.verdict in (*_FINE, Verdict.FAIL)}
    if whole:
        judged |= set(CONDITIONAL_CASES)
    gone = set()
    for entry in entries:
        its = _ids(entry, suite)
        over = its and judged.issuperset(its)
        if entry not in used and (over or not _ids(entry, known)):
            gone.add(entry)
    kept = [entry for entry in entries if entry not in gone]
    dropped = {entry.line for entry in gone}
    lines = _lines(text)
    left = [line for number, line in enumerate(lines, 1) if number not in dropped]
    new = tuple(dict.fromkeys(_new_lines(kept, results)))
    ending = "\r\n" if "\r\n" in text else "\n"
    body = "\n".join(left)
    if body and not body.endswith("\n"):
        body += ending
    body = body or _NEW_FILE
    body += "".join(f"{line}{ending}" for line in new)
    removed = tuple(lines[number - 1].strip() for number in sorted(dropped))
    return Update(body if new or removed else text, new, removed)


def _lines(text: str) -> list[str]:
    """The lines as an editor counts them; a form feed or U+2028 does not end a line."""
    return text.split("\n")


def _plain(message: str) -> str:
    return " ".join(message.split())


def _ids(entry: Entry, known: Collection[str]) -> list[str]:
    """The ids of `known` that an entry's glob matches."""
    if entry.glob in known:
        return [entry.glob]
    fits = matching([entry.glob])
    return [ident for ident in known if fits(ident)]


def _used(
    entries: Sequence[Entry], results: Sequence[CaseResult]
) -> tuple[set[Entry], set[str], int]:
    """The entries that fit a failure, the ids that fail as expected, and how many others fail."""
    tests: list[tuple[Entry, Callable[[str], bool]]] = [(e, matching([e.glob])) for e in entries]
    used: set[Entry] = set()
    expected: set[str] = set()
    failed = [result for result in results if result.verdict is Verdict.FAIL]
    for result in failed:
        its = [entry for entry, fits in tests if fits(result.id)]
        axes = failures(result).keys()
        used.update(entry for entry in its if entry.axis in axes)
        if axes and axes <= {entry.axis for entry in its}:
            expected.add(result.id)
    return used, expected, sum(result.id not in expected for result in failed)


def _new_lines(kept: Sequence[Entry], results: Sequence[CaseResult]) -> Iterable[str]:
    """A line for each failure that none of the kept entries covers."""
    tests = [(entry, matching([entry.glob])) for entry in kept]
    for result in results:
        if result.verdict is not Verdict.FAIL:
            continue
        allowed = {entry.axis for entry, fits in tests if fits(result.id)}
        for axis, reason in failures(result).items():
            if axis not in allowed:
                glob = re.sub(r"([*?[])", r"[\1]", result.id)
                yield f"{glob}{_SEPARATOR}{axis}: {reason}"
