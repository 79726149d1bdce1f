"""Reads a shard's report from JSON, and checks that several belong to one run. No I/O."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from bilprov.captures.text import printable
from bilprov.conformance.oracle.verdicts import LABELS, worst
from bilprov.conformance.report import schema
from bilprov.conformance.report.json_report import report_from
from bilprov.conformance.report.run_report import Report
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_MOST_SHARDS = 1_000_000


class MergeError(UserError):
    """Reports cannot be read, or do not belong together. The message is one sentence."""


class _Document(schema.Head, kw_only=True):
    """A shard's report: its wire logs are merged as they stand, also those of a later kit."""

    cases: list[schema.Case]


class _Link(schema.Link, kw_only=True):
    line: str


class _OpenParts(schema.OpenParts, kw_only=True):
    link: _Link


@dataclass(frozen=True)
class ShardReport:
    """One shard's report: file name, JSON and value (without logs), and shard `index` of `of`."""

    name: str
    raw: dict[str, Any]
    report: Report
    index: int
    of: int


def shard_from(name: str, data: bytes) -> ShardReport:
    """The report of a shard, from what `conform --shard --json` wrote. Raises MergeError."""
    name = printable(name)
    try:
        document = msgspec.json.decode(data, type=_Document)
        index, of = _shard(name, document.options)
        msgspec.json.decode(data, type=_OpenParts)
        raw = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MergeError(
            f"{name} is no report of bilprov conform --json ({printable(error)})"
        ) from error
    report = report_from(document, document.cases)
    # A verdict is never better than its axes, whatever a file says.
    results = tuple(
        msgspec.structs.replace(
            result,
            verdict=worst([result.verdict, *(LABELS[a.verdict] for a in case.axes.values())]),
        )
        for case, result in zip(document.cases, report.results, strict=True)
    )
    return ShardReport(name, raw, msgspec.structs.replace(report, results=results), index, of)


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
    theirs = first.report.grammar
    if theirs["sha256"] != protocol.sha256:
        raise MergeError(
            f"{first.name} was made with another grammar ({printable(theirs['name'])} "
            f"{printable(theirs['version'])}, {printable(theirs['file'])}); give that "
            "one with --grammar FILE.py"
        )
    seen: dict[int, ShardReport] = {}
    known = _same_in_all(first)
    for part in parts:
        facts = _same_in_all(part)
        for what in dict.fromkeys((*facts, *known)):
            here, there = facts.get(what), known.get(what)
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


def _same_in_all(part: ShardReport) -> dict[str, Any]:
    """What must be the same in all shards, by its name for the user.

    The device and its probe may be others of the same kind.
    """
    report, link = part.report, part.report.link
    return {
        "the kit": report.kit,
        "the grammar": report.grammar["sha256"][:12],
        "the seed": report.seed,
        "the link": link["kind"],
        "the line": link["line"],
        "the probe": (link.get("probe") or "none").partition(":")[0],
        "the fault": link.get("fault"),
        **{f"option {name}": value for name, value in report.options.items()},
        "option shard": None,
        "the number of shards": part.of,
    }
