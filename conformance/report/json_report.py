"""Reads a report back from its JSON, as an equal value. The content may be hostile."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, Verdict, WireEvent
from bilprov.conformance.report.expected import Comparison
from bilprov.conformance.report.foreign_parts import Seconds, planned, require_readable
from bilprov.conformance.report.run_report import AXES, NO_AXIS, Report

LABELS = {verdict.label: verdict for verdict in Verdict}

_Hex = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{2}( [0-9a-f]{2})*)?$")]
_Count = Annotated[int, msgspec.Meta(ge=0)]
_Label = Literal["skipped", "pass", "informational", "non-strict", "inconclusive", "fail", "error"]


class _Axis(msgspec.Struct):
    verdict: _Label
    expected: str
    actual: str
    reason: str
    reading: str | None = None


class _Byte(msgspec.Struct):
    hex: _Hex
    t: Seconds


class _Event(msgspec.Struct):
    t: Annotated[float, msgspec.Meta(ge=0, le=1e9)]
    kind: Literal["sent", "received", "look", "clipped"]
    hex: _Hex
    look: str


class _Case(msgspec.Struct):
    id: str
    clause: str
    requirement: str
    verdict: _Label
    axes: dict[str, _Axis]
    reading: str | None
    sent: list[_Hex]
    received: list[_Byte]
    reproduce: str
    expected_failure: bool = False
    log: list[_Event] = []
    planned_clause: str | None = None


class _Grammar(msgspec.Struct):
    name: str
    version: str
    sha256: str
    file: str


class _Covered(msgspec.Struct):
    done: _Count
    of: _Count


class _Expected(msgspec.Struct):
    file: str
    expected: _Count
    unexpected: _Count
    stale: list[str]


class _Document(msgspec.Struct):
    kit: str
    grammar: _Grammar
    device: str
    link: dict[str, Any]
    options: dict[str, Any]
    seed: int
    verdict: _Label
    exit: Annotated[int, msgspec.Meta(ge=0, le=3)]
    unusable: str | None
    ended: str | None
    counts: dict[str, _Count]
    coverage: dict[str, _Covered]
    profile: dict[str, Any]
    cases: list[_Case]
    ended_by: str | None = None
    timing: dict[str, int | float] = {}
    dropped: dict[str, int] = {}
    expected_failures: _Expected | None = None
    begun: str | None = None
    took_s: Seconds | None = None
    host: str | None = None
    versions: dict[str, str] = {}


def read_report(path: str) -> Report:
    """The report that a JSON file of `conform --json` holds.

    Keys that this version does not know are ignored. Raises ValueError, in one sentence, for a
    file that cannot be read, that is no such result, or whose verdict and counts are not those of
    its cases.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    try:
        document = msgspec.json.decode(data, type=_Document)
        require_readable(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(
            f"{path} is no result of bilprov ({error}); give a file that conform --json wrote"
        ) from error
    report = _report(document)
    said = {name: count for name, count in document.counts.items() if count}
    found = dict(Counter(str(case.verdict) for case in document.cases))
    if LABELS[document.verdict] is not report.verdict or said != found:
        raise ValueError(
            f"{path} contradicts itself: it says {document.verdict} ({_counted(said)}), its cases "
            f"say {report.verdict.label} ({_counted(found)}); run conform --json again"
        )
    return report


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{counts[name]} {name}" for name in LABELS if counts.get(name)) or "no case"


def _report(document: _Document) -> Report:
    return Report(
        grammar=msgspec.to_builtins(document.grammar),
        device=document.device,
        link=document.link,
        options=document.options,
        seed=document.seed,
        exit=document.exit,
        unusable=document.unusable or "",
        ended=document.ended or "",
        profile=document.profile,
        coverage={name: (entry.done, entry.of) for name, entry in document.coverage.items()},
        results=tuple(_case(case) for case in document.cases),
        kit=document.kit,
        ended_by=document.ended_by or "",
        timing=document.timing,
        dropped=document.dropped,
        comparison=_comparison(document),
        begun=document.begun or "",
        took_s=document.took_s,
        host=document.host or "",
        versions=document.versions,
        again={case.id: case.reproduce for case in document.cases},
    )


def _comparison(document: _Document) -> Comparison | None:
    """The comparison with a file of expected failures, None where there was none."""
    told = document.expected_failures
    if told is None:
        return None
    expected = frozenset(case.id for case in document.cases if case.expected_failure)
    return Comparison(told.file, expected, told.unexpected, tuple(told.stale))


def _case(case: _Case) -> CaseResult:
    axes = {name: _axis(axis) for name, axis in case.axes.items() if name in AXES}
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=LABELS[case.verdict],
        axes={name: axis for name, axis in axes.items() if axis != NO_AXIS},
        reading=case.reading or "",
        sent=tuple(case.sent),
        received=tuple(AnswerByte(byte.hex, round(byte.t * 1e9)) for byte in case.received),
        planned=planned(case.clause, case.planned_clause),
        log=tuple(WireEvent(round(e.t * 1e9), e.kind, e.hex, e.look) for e in case.log),
    )


def _axis(axis: _Axis) -> Axis:
    return Axis(LABELS[axis.verdict], axis.expected, axis.actual, axis.reason, axis.reading or "")
