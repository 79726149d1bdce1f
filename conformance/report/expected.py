"""Compares a run's results with expected failures: finds unexpected ones and stale entries. No I/O.

The text of a file of expected failures has one entry a line, `GLOB : MESSAGE`. Empty lines and
lines that begin with # are ignored. GLOB matches case ids, * crosses /. MESSAGE is how the failure
begins: the axis (`answer`, `stop` or `state`), a colon, and its reason, as much of it as stays the
same from run to run:

    # the board takes all eight bits of the LED byte (issue 12)
    bad-data/LED/* : answer: OK instead of BAD_DATA

A case is an expected failure when each of its axes that fails matches an entry. An entry is stale,
and itself a failure, when all of its cases were judged and none of them fails any more.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

from bilprov.captures.text import printable
from bilprov.conformance.cases.selection import CONDITIONAL_CASES, LONGEST_GLOB, matching
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.spec.errors import UserError

_SEPARATOR = " : "
_FINE = (Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT)
# Measured values differ from run to run: a message is written only up to the first of them.
_MEASURED = re.compile(r"\s*\b\d+(\.\d+)?\s*(ms|s|us)\b")
_MOST = 10_000  # entries: each is compared with each case
_NEW_FILE = "# Failures that are expected, GLOB : MESSAGE; see bilprov conform --help\n"


class ExpectedError(UserError):
    """A file of expected failures cannot be used. The message is one sentence for the user."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the file: cases that match `glob` may fail with a message that begins so."""

    glob: str
    message: str
    line: int

    def allows(self, message: str) -> bool:
        """Whether the entry covers a failure with this message."""
        return message.startswith(self.message)


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of comparing a run with the entries of `file`.

    `expected` are the ids of the cases that fail only as entries say, `unexpected` how many others
    fail, `stale` a sentence for each entry that no longer fails.
    """

    file: str
    expected: frozenset[str]
    unexpected: int
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
        words = line.strip()
        if not words or words.startswith("#"):
            continue
        glob, separator, message = f"{words} ".partition(_SEPARATOR)
        glob, message = glob.strip(), _plain(message)
        if not (glob and separator and message):
            raise ExpectedError(
                f"{file}, line {number} is {printable(words)!r}; write GLOB : "
                "MESSAGE, a glob of case "
                "ids and how the failure begins, or # and a comment"
            )
        if len(glob) > LONGEST_GLOB:
            raise ExpectedError(
                f"{file}, line {number}: the glob {printable(glob)!r} has {len(glob)} characters, "
                f"allowed are {LONGEST_GLOB}; see the ids with bilprov conform sim --list"
            )
        entries.append(Entry(glob, message, number))
        if len(entries) > _MOST:
            raise ExpectedError(f"{file} has more than {_MOST} entries; say several with one glob")
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
                f"{printable(entry.glob)!r}; see the ids "
                "with bilprov conform sim --list, or take the entry out"
            )


def failure_messages(result: CaseResult) -> tuple[str, ...]:
    """The messages that entries are compared with: name and reason of each axis that fails."""
    found = []
    for name, axis in result.axes.items():
        if axis.verdict is Verdict.FAIL:
            reason = axis.reason or f"{axis.actual} instead of {axis.expected}"
            found.append(_plain(f"{name}: {reason}"))
    return tuple(found)


def compare(
    entries: Sequence[Entry],
    file: str,
    results: Sequence[CaseResult],
    suite: Collection[str],
    *,
    whole: bool = True,
) -> Comparison:
    """Compare a run's results with the entries.

    `suite` are the ids of all cases that a run of this kind has, also of those that this one left
    out (--only, --shard). `whole` says that the run went to its end: only then does the absence of
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
            what = f"{printable(its[0])} does" if len(its) == 1 else f"its {len(its)} cases do"
            stale.append(
                f"{file}, line {entry.line}: {printable(entry.glob)} : "
                f"{printable(entry.message)}: {what} "
                "not fail any more; take the entry out, or run with --update-expected"
            )
    return Comparison(file, frozenset(expected), unexpected, tuple(stale))


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
        messages = failure_messages(result)
        used.update(entry for entry in its if any(entry.allows(m) for m in messages))
        if all(any(entry.allows(m) for entry in its) for m in messages):
            expected.add(result.id)
    return used, expected, sum(result.id not in expected for result in failed)


def _new_lines(kept: Sequence[Entry], results: Sequence[CaseResult]) -> Iterable[str]:
    """A line for each failure that none of the kept entries covers."""
    tests = [(entry, matching([entry.glob])) for entry in kept]
    for result in results:
        if result.verdict is not Verdict.FAIL:
            continue
        its = [entry for entry, fits in tests if fits(result.id)]
        for message in failure_messages(result):
            if not any(entry.allows(message) for entry in its):
                glob = re.sub(r"([*?[])", r"[\1]", result.id)
                yield f"{glob}{_SEPARATOR}{_stable(message)}"


def _stable(message: str) -> str:
    """The beginning of a message, up to the first measured value."""
    return _MEASURED.split(message, maxsplit=1)[0] or message
