"""Reads a shard's report from JSON, and checks that several belong to one run. No I/O."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from bilprov.captures.text import printable
from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, Verdict, worst
from bilprov.conformance.report.foreign_parts import Seconds, planned, require_readable
from bilprov.conformance.report.run_report import NO_AXIS
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_VERDICTS = {verdict.label: verdict for verdict in Verdict}
_MOST_SHARDS = 1_000_000


class MergeError(UserError):
    """Reports cannot be read, or do not belong together. The message is one sentence."""


class _Axis(msgspec.Struct):
    verdict: str
    expected: str
    actual: str
    reason: str


class _Byte(msgspec.Struct):
    hex: str
    t: Seconds


class _Case(msgspec.Struct):
    id: str
    clause: str
    requirement: str
    verdict: str
    axes: dict[str, _Axis]
    reading: str | None
    sent: list[str]
    received: list[_Byte]
    reproduce: str = ""
    planned_clause: str | None = None


class _Grammar(msgspec.Struct):
    name: str
    version: str
    sha256: str
    file: str


class _Link(msgspec.Struct):
    kind: str
    line: str
    probe: str | None = None
    fault: str | None = None


class _Expected(msgspec.Struct):
    file: str = ""
    stale: list[str] = []


class _Document(msgspec.Struct):
    kit: str
    grammar: _Grammar
    device: str
    link: _Link
    options: dict[str, Any]
    seed: int
    profile: dict[str, Any]
    cases: list[_Case]
    unusable: str | None = None
    ended: str | None = None
    ended_by: str | None = None
    expected_failures: _Expected | None = None
    begun: str | None = None
    took_s: Seconds | None = None
    host: str | None = None
    versions: dict[str, str] = {}


@dataclass(frozen=True)
class ShardReport:
    """One shard's report: file name, raw and typed JSON, results, and shard `index` of `of`."""

    name: str
    raw: dict[str, Any]
    told: _Document
    results: tuple[CaseResult, ...]
    index: int
    of: int


def shard_from(name: str, data: bytes) -> ShardReport:
    """The report of a shard, from what `conform --shard --json` wrote. Raises MergeError."""
    name = printable(name)
    try:
        told = msgspec.json.decode(data, type=_Document)
        raw = msgspec.json.decode(data)
        results = tuple(_result(case) for case in told.cases)
        shard = _shard(name, told.options)
        require_readable(data)
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError, RecursionError) as error:
        raise MergeError(
            f"{name} is no report of bilprov conform --json ({printable(error)})"
        ) from error
    return ShardReport(name, raw, told, results, *shard)


def _shard(name: str, options: dict[str, Any]) -> tuple[int, int]:
    shard = options.get("shard")
    if not (
        isinstance(shard, list)
        and [type(number) for number in shard] == [int, int]
        and 1 <= shard[0] <= shard[1] < _MOST_SHARDS
    ):
        raise MergeError(f"{name} is not the report of a shard; run conform with --shard I/N")
    return shard[0], shard[1]


def require_together(parts: Sequence[ShardReport], protocol: Protocol) -> None:
    """Raise MergeError, in one sentence, unless the parts are shards of one and the same run."""
    first = parts[0]
    if first.told.grammar.sha256 != protocol.sha256:
        theirs = first.told.grammar
        raise MergeError(
            f"{first.name} was made with another grammar ({printable(theirs.name)} "
            f"{printable(theirs.version)}, {printable(theirs.file)}); give that "
            "one with --grammar FILE.py"
        )
    seen: dict[int, ShardReport] = {}
    for part in parts:
        for what, here, there in _alike(part, first):
            if here != there:
                raise MergeError(
                    f"{part.name} and {first.name} are not of one run: {what} is {printable(here)} "
                    f"in one and {printable(there)} in the other"
                )
        twin = seen.setdefault(part.index, part)
        if twin is not part:
            raise MergeError(
                f"{twin.name} and {part.name} are both shard {part.index}/{part.of}; give each once"
            )


def _result(case: _Case) -> CaseResult:
    axes = {
        name: Axis(_VERDICTS[axis.verdict], axis.expected, axis.actual, axis.reason)
        for name, axis in case.axes.items()
        if (axis.verdict, axis.reason) != (NO_AXIS.verdict.label, NO_AXIS.reason)
    }
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=worst([_VERDICTS[case.verdict], *(axis.verdict for axis in axes.values())]),
        axes=axes,
        reading=case.reading or "",
        sent=tuple(case.sent),
        received=tuple(AnswerByte(byte.hex, round(byte.t * 1e9)) for byte in case.received),
        planned=planned(case.clause, case.planned_clause),
    )


def _alike(part: ShardReport, other: ShardReport) -> list[tuple[str, Any, Any]]:
    """(name, value here, value there) of what must be the same in all shards.

    The device and its probe may be others of the same kind.
    """

    def facts(told: _Document) -> dict[str, Any]:
        probe = (told.link.probe or "none").partition(":")[0]
        link = {"link": told.link.kind, "line": told.link.line, "probe": probe}
        options = {f"option {name}": value for name, value in told.options.items()}
        return {
            "the kit": told.kit,
            "the grammar": told.grammar.sha256[:12],
            "the seed": told.seed,
            **{f"the {name}": value for name, value in link.items()},
            "the fault": told.link.fault,
            **options,
            "option shard": None,
            "the number of shards": None,
        }

    here, there = facts(part.told), facts(other.told)
    here["the number of shards"], there["the number of shards"] = part.of, other.of
    names = dict.fromkeys((*here, *there))
    return [(name, here.get(name), there.get(name)) for name in names]
