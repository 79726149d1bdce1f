"""Reads the reports of shards and merges them into the report of the whole run. No I/O.

Keys that are not known here (a later kit wrote them) stay as they are: in a case, always; at the
top, where the shards agree. Where they differ they are kept for each shard, in `shards`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import msgspec

from bilprov.analyzer.client.operations import EndedBy
from bilprov.analyzer.foreign import from_json
from bilprov.captures.text import escape_json
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.oracle.verdicts import LABELS, Axis, CaseResult, Verdict, worst
from bilprov.conformance.report import schema
from bilprov.conformance.report.expected import Comparison
from bilprov.conformance.report.json_report import case_of, head_of, report_from
from bilprov.conformance.report.proof import proven
from bilprov.conformance.report.run_report import Report, compared, coverage, decided_exit
from bilprov.spec.codec import spaced
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

# Keys that stay as the shards have them, if they agree; those of the others that the schema has are
# made anew.
_KEPT = ("kit", "grammar", "link", "seed", "timing", "dropped")
# Keys of which the whole run's value says enough: they are not listed for each shard.
_SUMMED = ("coverage", "counts", "cases", "profile", "options", "expected_failures")
_SHOWN = 8  # missing shards


class MergeError(UserError):
    """Reports cannot be read, or do not belong together. The message is one sentence."""


class _Document(schema.Document, kw_only=True):
    """A shard's report: its wire logs are merged as they stand, also those of a later kit."""

    cases: list[schema.Case]  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.link.get("line"):
            raise ValueError("its link names no line")


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
    try:
        raw = from_json(data, dict[str, Any])
        document = msgspec.convert(raw, _Document)
    except ValueError as error:
        raise MergeError(f"{name} is not a report of bilprov conform --json ({error})") from error
    index, of = _shard(name, document.options)
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
    if shard is None:
        raise MergeError(f"{name} is not the report of a shard; run conform with --shard I/N")
    return shard[0], shard[1]


def require_together(parts: Sequence[ShardReport], protocol: Protocol) -> None:
    """Raise MergeError, in one sentence, unless the parts are shards of one and the same run."""
    first = parts[0]
    theirs = first.report.grammar
    if theirs["sha256"] != protocol.sha256:
        raise MergeError(
            f"{first.name} was made with another grammar ({theirs['name']} "
            f"{theirs['version']}, {theirs['file']}); give that "
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
                    f"{part.name} and {first.name} are not of one run: {what} is {here} "
                    f"in one and {there} in the other"
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


@dataclass(frozen=True)
class Merged:
    """The whole run as a report, and what its JSON is made of: the shards and the cases' JSON."""

    report: Report
    parts: Sequence[ShardReport]
    cases: Sequence[dict[str, Any]]

    def as_json(self, report: Report) -> bytes:
        """The whole run as JSON; `report` is the merged one, or that with another comparison."""
        raws = [part.raw for part in self.parts]
        names = dict.fromkeys(name for raw in raws for name in raw)
        agreed = {
            name: raws[0].get(name)
            for name in names
            if all(raw.get(name) == raws[0].get(name) for raw in raws)
        }
        apart = [name for name in names if name not in agreed and name not in _SUMMED]
        shards = [
            {
                "file": part.name,
                "shard": [part.index, part.of],
                "profile": part.report.profile,
                **{name: part.raw[name] for name in apart if name in part.raw},
            }
            for part in self.parts
        ]
        head = msgspec.to_builtins(head_of(report))
        document = {name: agreed.get(name) for name in names if name != "cases"}
        document |= {
            name: value for name, value in head.items() if name not in _KEPT or name in apart
        }
        cases = self.cases
        if report.comparison:
            known = report.comparison.expected
            cases = [case | {"expected_failure": case["id"] in known} for case in cases]
        document |= {"shards": shards, "cases": cases}
        return escape_json(msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")


def merge(parts: Sequence[ShardReport], protocol: Protocol, cases: Sequence[AnyCase]) -> Merged:
    """Put shards that belong together into one report.

    `cases` are those of the whole run, besides the opening ones. A case that several shards ran
    (the opening ones) counts once, with its worst verdict. One that no shard ran is inconclusive.
    """
    parts = sorted(parts, key=lambda part: part.index)
    first = parts[0].report
    raws, results = _worst_of_each(parts)
    unrun = [case for case in cases if case.id not in results]
    ended, ended_by = _endings(parts, len(unrun))
    for case in unrun:
        results[case.id] = _not_run(case, ended)
    order = {case.id: at for at, case in enumerate(cases)}
    ids = sorted(results, key=lambda ident: order.get(ident, -1))  # the opening ones first
    merged = [results[ident] for ident in ids]
    options, profile = {**first.options, "shard": None}, _profile(parts)
    report = msgspec.structs.replace(
        first,
        options=options,
        exit=decided_exit(merged, options, "", ended_by),
        unusable="",
        ended=ended,
        ended_by=ended_by,
        profile=profile,
        proof=proven(protocol, merged, options, profile),
        coverage=coverage(protocol, merged, cases),
        results=tuple(merged),
        comparison=None,
        timing={},
        dropped={},
        unseen=tuple(
            f"shard {part.index}/{part.of}: {sentence}"
            for part in parts
            for sentence in part.report.unseen
        ),
        notices=tuple(dict.fromkeys(n for part in parts for n in part.report.notices)),
        **_run_facts(parts),
        again={ident: raw["reproduce"] for ident, raw in raws.items()},
    )
    for case in unrun:
        raws[case.id] = msgspec.to_builtins(case_of(report, results[case.id]))
    devices = ", ".join(dict.fromkeys(part.report.device for part in parts))
    report = msgspec.structs.replace(report, device=devices)
    comparison = _expected(parts, merged)
    if comparison:
        report = compared(report, comparison)
    return Merged(report, parts, [raws[ident] for ident in ids])


def _not_run(case: AnyCase, why: str) -> CaseResult:
    axis = Axis(Verdict.INCONCLUSIVE, "", "not run", why)
    sent = tuple(spaced(frame) for frame in case.sent if frame)
    return CaseResult(
        id=case.id,
        clause=case.clause,
        requirement=case.requirement,
        verdict=axis.verdict,
        axes={"answer": axis},
        reading=case.reading,
        sent=sent,
        received=(),
        frames=case.frames,
    )


def _expected(parts: Sequence[ShardReport], results: Sequence[CaseResult]) -> Comparison | None:
    """The shards' comparisons with expected failures as one, None where there were none."""
    comparisons = [part.report.comparison for part in parts]
    known = [comparison for comparison in comparisons if comparison]
    if not known:
        return None
    failed = {result.id for result in results if result.verdict is Verdict.FAIL}
    surprising = {
        result.id
        for part, comparison in zip(parts, comparisons, strict=True)
        for result in part.report.results
        if result.verdict is Verdict.FAIL and not (comparison and result.id in comparison.expected)
    }
    stale = [sentence for comparison in known for sentence in comparison.stale]
    return Comparison(
        file=", ".join(dict.fromkeys(comparison.file for comparison in known)),
        expected=frozenset(failed - surprising),
        unexpected=len(failed & surprising),
        stale=tuple(dict.fromkeys(sentence for sentence in stale)),
    )


def _worst_of_each(
    parts: Sequence[ShardReport],
) -> tuple[dict[str, dict[str, Any]], dict[str, CaseResult]]:
    """Each case's JSON and result, those of its worst verdict where several shards ran it."""
    raws: dict[str, dict[str, Any]] = {}
    results: dict[str, CaseResult] = {}
    for part in parts:
        for raw, result in zip(part.raw["cases"], part.report.results, strict=True):
            if result.id not in results or result.verdict > results[result.id].verdict:
                raws[result.id], results[result.id] = raw, result
    return raws, results


def _endings(parts: Sequence[ShardReport], unrun: int) -> tuple[str, str]:
    """Why the run is not whole, and what ended it, the worst first; both "" if it is whole."""
    told = []
    causes = set()
    for part in parts:
        why = part.report.unusable or part.report.ended
        if why:
            told.append(f"shard {part.index}/{part.of}: {why}")
            causes.add("error" if part.report.unusable else part.report.ended_by or "error")
    of = parts[0].of
    missing = sorted(set(range(1, of + 1)) - {part.index for part in parts})
    if missing:
        numbers = ", ".join(f"{number}/{of}" for number in missing[:_SHOWN])
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        told.append(f"shard{'s' if len(missing) > 1 else ''} {numbers}{more} missing")
        causes.add("user")
    elif unrun and not told:
        told.append(f"{unrun} cases are in none of the shards")
        causes.add("user")
    unknown = "error" if causes else ""  # of a later kit
    return "; ".join(told), next((by for by in get_args(EndedBy) if by in causes), unknown)


def _profile(parts: Sequence[ShardReport]) -> dict[str, Any]:
    """The merged profile: the value if all shards agree, of times that differ the strictest.

    Of what answers take that is the largest, of the truncation time-out the smallest. The curves of
    the wheels are those of all shards.
    """
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in parts for name in part.report.profile):
        values = [part.report.profile.get(name) for part in parts]
        numbers = [value for value in values if isinstance(value, int | float)]
        if numbers and (name.endswith("_max_ms") or name == "all_but_two_answers_ms"):
            found[name] = max(numbers)
        elif numbers and name == "truncation_timeout_ms":
            found[name] = min(numbers)
        elif name == "wheels":  # each curve is measured in one shard
            found[name] = [curve for value in values for curve in value or ()]
        else:
            found[name] = values[0] if all(value == values[0] for value in values) else None
    return found


def _run_facts(parts: Sequence[ShardReport]) -> dict[str, Any]:
    """The earliest begin, the sum of the times (spent on all devices), hosts and versions."""
    begun = sorted(part.report.begun for part in parts if part.report.begun)
    took = [part.report.took_s for part in parts if part.report.took_s is not None]
    hosts = dict.fromkeys(part.report.host for part in parts if part.report.host)
    versions = parts[0].report.versions
    return {
        "begun": begun[0] if begun else "",
        "took_s": round(sum(took), 3) if took else None,
        "host": ", ".join(hosts),
        "versions": versions if all(p.report.versions == versions for p in parts) else {},
    }
