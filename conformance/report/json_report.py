"""Writes a report as JSON and reads it back as an equal value. A file's content may be hostile."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

from bilprov.analyzer.files import from_json, read_bounded
from bilprov.captures.text import escape_json
from bilprov.conformance.oracle.verdicts import AXES, NO_AXIS, CaseResult
from bilprov.conformance.report.run_report import Report
from bilprov.spec.errors import UserError, one_line

_MOST = 1 << 28  # bytes of a report


class ReportError(UserError):
    """A report cannot be read. The message is one sentence."""


def as_json(report: Report) -> bytes:
    """The report as JSON: one object in which every key is always present."""
    bare = msgspec.to_builtins(msgspec.structs.replace(report, results=(), file=msgspec.UNSET))
    sums = {"exit": report.exit, "counts": report.counts, "unexplained": report.unexplained}
    head = _open(bare | {"verdict": report.verdict.label} | sums)
    cases = b",\n".join(map(_case, report.results))
    return escape_json(head + (b"\n" + cases + b"\n ]" if cases else b"]") + b"\n}\n")


def _case(result: CaseResult) -> bytes:
    """One case, with each entry of its log on a line of its own."""
    axes = {name: result.axes.get(name, NO_AXIS) for name in AXES}
    text = _open(msgspec.structs.replace(result, axes=axes, log=()))
    log = b",\n    ".join(map(msgspec.json.encode, result.log))
    log = b"\n    " + log + b"\n   " if log else b""
    return b"  " + text.replace(b"\n", b"\n  ") + log + b"]\n  }"


def _open(part: object) -> bytes:
    """A JSON object up to the bracket that opens its last entry, an empty list."""
    return msgspec.json.format(msgspec.json.encode(part), indent=1).removesuffix(b"]\n}")


def read_report(path: str) -> Report:
    """The report that a JSON file of `conform --json` holds.

    Raises ReportError, in one sentence, for a file that cannot be read or is no such result.
    """
    try:
        data = read_bounded(Path(path), _MOST, pipes=True)
    except OSError as error:
        raise ReportError(
            f"{path} cannot be read ({error.strerror}); name what conform --json wrote"
        ) from error
    return parse_report(data, path)


def parse_report(data: bytes, path: str) -> Report:
    """The report that the JSON of a file of that name holds. Raises ReportError, in one sentence.

    What comes out is safe, whatever the file holds: every text prints and is bounded. Its verdict,
    exit code and counts are those of its cases, whatever the file says.
    """
    try:
        report = from_json(data, Report)
    except ValueError as error:
        raise ReportError(
            f"{path} is not a report of bilprov ({error}); give a file that conform --json wrote"
        ) from error
    twice = [ident for ident, count in Counter(r.id for r in report.results).items() if count > 1]
    if twice:
        raise ReportError(f"{path} holds the case {twice[0]} twice; run conform --json again")
    results = tuple(
        msgspec.structs.replace(result, axes=_own_axes(result)) for result in report.results
    )
    return msgspec.structs.replace(report, results=results, file=one_line(path))


def _own_axes(result: CaseResult) -> dict[str, Any]:
    """The axes that a case has."""
    axes = {name: result.axes.get(name, NO_AXIS) for name in AXES}
    return {name: axis for name, axis in axes.items() if axis != NO_AXIS}
