"""Writes a report as JSON and reads it back as an equal value. A file's content may be hostile."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from bilprov.analyzer.files import read_bounded
from bilprov.analyzer.foreign import from_json
from bilprov.captures.text import escape_json
from bilprov.conformance.oracle.verdicts import (
    LABELS,
    AnswerByte,
    Axis,
    CaseResult,
    Verdict,
    WireEvent,
)
from bilprov.conformance.report import schema
from bilprov.conformance.report.expected import Comparison
from bilprov.conformance.report.run_report import AXES, Report, reproduce
from bilprov.spec.errors import UserError

NO_AXIS = Axis(Verdict.SKIPPED, "", "", "not part of this case")
# The values that a Report and its JSON have in common, and those whose "" is null in the JSON.
_SAME = (
    *("kit", "device", "link", "options", "seed", "exit", "timing", "profile"),
    *("took_s", "versions", "unseen", "notices", "causes"),
)
_NULLED = ("unusable", "ended", "ended_by", "proof", "begun", "host")
_MOST = 1 << 28  # bytes of a report


class ReportError(UserError):
    """A report cannot be read. The message is one sentence."""


def as_json(report: Report) -> bytes:
    """The report as JSON (see `schema`): one object in which every key is always present."""
    head = _unclosed(head_of(report))
    cases = b",\n".join(_case(report, result) for result in report.results)
    text = head + b',\n "cases": [' + (b"\n" + cases + b"\n ]" if cases else b"]") + b"\n}\n"
    return escape_json(text)


def _unclosed(part: msgspec.Struct) -> bytes:
    """A JSON object without its closing brace."""
    return msgspec.json.format(msgspec.json.encode(part), indent=1).removesuffix(b"\n}")


def _case(report: Report, result: CaseResult) -> bytes:
    """One case, with each entry of its log on a line of its own."""
    text = _unclosed(case_of(report, result))
    log = b",\n    ".join(
        msgspec.json.encode(schema.WireEvent(e.t / 1e9, e.kind, e.hex, e.look)) for e in result.log
    )
    log = b"\n    " + log + b"\n   " if log else b""
    return b"  " + text.replace(b"\n", b"\n  ") + b',\n   "log": [' + log + b"]\n  }"


def head_of(report: Report) -> schema.Head:
    """What the JSON says of the whole run."""
    values: dict[str, Any] = {name: getattr(report, name) for name in _SAME}
    values |= {name: getattr(report, name) or None for name in _NULLED}
    return schema.Head(
        **values,
        grammar=schema.Grammar(**report.grammar),
        verdict=report.verdict.label,
        counts=report.counts,
        unexplained=report.unexplained,
        coverage={name: schema.Covered(*pair) for name, pair in report.coverage.items()},
        expected_failures=_expected_failures(report.comparison),
    )


def case_of(report: Report, result: CaseResult) -> schema.Case:
    """What the JSON says of a case, without its log."""
    return schema.Case(
        id=result.id,
        clause=result.clause,
        planned_clause=result.own_clause,
        requirement=result.requirement,
        verdict=result.verdict.label,
        axes={name: _axis(result.axes.get(name, NO_AXIS)) for name in AXES},
        reading=result.reading or None,
        sent=list(result.sent),
        received=[schema.AnswerByte(byte.hex, byte.t / 1e9) for byte in result.received],
        frames=result.frames,
        reproduce=reproduce(report, result),
        expected_failure=bool(report.comparison and result.id in report.comparison.expected),
    )


def _axis(axis: Axis) -> schema.Axis:
    return schema.Axis(
        axis.verdict.label, axis.expected, axis.actual, axis.reason, axis.reading or None
    )


def _expected_failures(comparison: Comparison | None) -> schema.ExpectedFailures | None:
    if comparison is None:
        return None
    return schema.ExpectedFailures(
        comparison.file, len(comparison.expected), comparison.unexpected, list(comparison.stale)
    )


def report_file(path: str) -> bytes:
    """The content of a report's file. Raises ReportError."""
    try:
        return read_bounded(Path(path), _MOST, pipes=True)
    except OSError as error:
        raise ReportError(
            f"{path} cannot be read ({error.strerror}); name what conform --json wrote"
        ) from error


def read_report(path: str) -> Report:
    """The report that a JSON file of `conform --json` holds.

    Raises ReportError, in one sentence, for a file that cannot be read, that is no such result, or
    whose verdict and counts are not those of its cases.
    """
    return parse_report(report_file(path), path)


def parse_report(data: bytes, path: str) -> Report:
    """The report that the JSON of a file of that name holds. Raises ReportError, in one sentence.

    What comes out is safe, whatever the file holds: every text prints and is bounded.
    """
    try:
        document = from_json(data, schema.Document)
    except ValueError as error:
        raise ReportError(
            f"{path} is not a report of bilprov ({error}); give a file that conform --json wrote"
        ) from error
    report = report_from(document, document.cases)
    said = {name: count for name, count in document.counts.items() if count}
    found = dict(Counter(str(case.verdict) for case in document.cases))
    if LABELS[document.verdict] is not report.verdict or said != found:
        raise ReportError(
            f"{path} contradicts itself: its verdict is {document.verdict} ({_counted(said)}), "
            f"that of its cases is {report.verdict.label} ({_counted(found)}); run conform "
            "--json again"
        )
    twice = [ident for ident, count in Counter(r.id for r in report.results).items() if count > 1]
    if twice:
        raise ReportError(f"{path} holds the case {twice[0]} twice; run conform --json again")
    return report


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[name]} {name}" for name in LABELS if counts.get(name)) or "no case"


def report_from(head: schema.Head, cases: Sequence[schema.Case]) -> Report:
    """The report that the JSON of a run and its cases tells."""
    comparison = None
    if head.expected_failures is not None:
        told = head.expected_failures
        expected = frozenset(case.id for case in cases if case.expected_failure)
        comparison = Comparison(told.file, expected, told.unexpected, tuple(told.stale))
    values: dict[str, Any] = {name: getattr(head, name) for name in _SAME}
    values |= {name: getattr(head, name) or "" for name in _NULLED}
    return Report(
        **values,
        grammar=msgspec.to_builtins(head.grammar),
        coverage={name: (entry.done, entry.of) for name, entry in head.coverage.items()},
        results=tuple(_result(case) for case in cases),
        comparison=comparison,
        again={case.id: case.reproduce for case in cases},
    )


def _result(case: schema.Case) -> CaseResult:
    axes = {
        name: Axis(LABELS[a.verdict], a.expected, a.actual, a.reason, a.reading or "")
        for name, a in case.axes.items()
        if name in AXES
    }
    log = case.log if isinstance(case, schema.LoggedCase) else []
    own_clause = case.planned_clause or case.clause
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=LABELS[case.verdict],
        axes={name: axis for name, axis in axes.items() if axis != NO_AXIS},
        reading=case.reading or "",
        sent=tuple(case.sent),
        received=tuple(AnswerByte(byte.hex, round(byte.t * 1e9)) for byte in case.received),
        frames=case.frames,
        planned="" if own_clause == case.clause else own_clause,
        log=tuple(WireEvent(round(e.t * 1e9), e.kind, e.hex, e.look) for e in log),
    )
