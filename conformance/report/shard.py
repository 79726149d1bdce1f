"""A shard's report as it was written: read from JSON, and held against the others. No file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from captures.errors import shown
from conformance.oracle.verdicts import Axis, CaseResult, Received, Verdict, worst
from conformance.report.run_report import NO_AXIS
from spec.protocol import Protocol

_VERDICTS = {verdict.label: verdict for verdict in Verdict}
_MOST_SHARDS = 1_000_000


class MergeError(Exception):
    """Reports that are none, or do not belong together. The message is one sentence."""


class _Axis(msgspec.Struct):
    verdict: str
    expected: str
    actual: str
    reason: str


class _Byte(msgspec.Struct):
    hex: str
    t: float


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


@dataclass(frozen=True)
class Part:
    """One shard's report: the file's name, its JSON as it came, and the shard that it is."""

    name: str
    raw: dict[str, Any]
    told: _Document
    results: tuple[CaseResult, ...]
    index: int
    of: int


def part_from(name: str, data: bytes) -> Part:
    """A report of a shard, as `conform --shard --json` wrote it. Raises MergeError."""
    name = shown(name)
    try:
        told = msgspec.json.decode(data, type=_Document)
        raw = msgspec.json.decode(data)
        results = tuple(_result(case) for case in told.cases)
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError, RecursionError) as error:
        raise MergeError(
            f"{name} is no report of bilprov conform --json ({shown(error)})"
        ) from error
    shard = told.options.get("shard")
    if not (
        isinstance(shard, list)
        and [type(number) for number in shard] == [int, int]
        and 1 <= shard[0] <= shard[1] < _MOST_SHARDS
    ):
        raise MergeError(f"{name} is not the report of a shard; run conform with --shard I/N")
    return Part(name, raw, told, results, *shard)


def require_together(parts: Sequence[Part], protocol: Protocol) -> None:
    """Raise MergeError, in one sentence, unless the parts are shards of one and the same run."""
    first = parts[0]
    if first.told.grammar.sha256 != protocol.sha256:
        theirs = first.told.grammar
        raise MergeError(
            f"{first.name} was made with another grammar ({shown(theirs.name)} "
            f"{shown(theirs.version)}, {shown(theirs.file)}); give that one with --grammar FILE.py"
        )
    seen: dict[int, Part] = {}
    for part in parts:
        for what, here, there in _alike(part, first):
            if here != there:
                raise MergeError(
                    f"{part.name} and {first.name} are not of one run: {what} is {shown(here)} "
                    f"in one and {shown(there)} in the other"
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
        received=tuple(Received(byte.hex, round(byte.t * 1e9)) for byte in case.received),
    )


def _alike(part: Part, other: Part) -> list[tuple[str, Any, Any]]:
    """What must be the same in all shards; the device and its probe may be others of their kind."""

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
