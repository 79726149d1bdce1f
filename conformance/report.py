"""The report of a run: one value that the summary, the JSON and the exit code come from."""

from __future__ import annotations

import shlex
import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgspec

from analyzer.version import kit_version
from conformance.cases import Case, Class
from conformance.judging import MS
from conformance.run import Profile
from conformance.verdicts import Axis, CaseResult, Verdict, exit_code, worst
from spec.motion import Motion
from spec.protocol import Protocol

AXES = ("answer", "stop", "state")
_NO_AXIS = Axis(Verdict.SKIPPED, "", "", "not part of this case")


class Report(msgspec.Struct, frozen=True):
    """Everything that is known after a run.

    `unusable` says why nothing could be judged, `ended` why the run ended early; both are "" for a
    run that went to its end. `profile` holds what was measured (ms), `coverage` pairs of how many
    and out of how many.
    """

    grammar: dict[str, str]
    device: str
    link: dict[str, Any]
    options: dict[str, Any]
    seed: int
    exit: int
    unusable: str
    ended: str
    profile: dict[str, float | bool | None]
    coverage: dict[str, tuple[int, int]]
    results: tuple[CaseResult, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst verdict, ERROR where nothing could be judged."""
        return Verdict.ERROR if self.unusable else worst(r.verdict for r in self.results)

    @property
    def counts(self) -> dict[str, int]:
        """How many cases have each verdict, from best to worst."""
        found = Counter(result.verdict for result in self.results)
        return {verdict.label: found[verdict] for verdict in Verdict}


def make_report(
    protocol: Protocol,
    results: Sequence[CaseResult],
    cases: Sequence[Case],
    profile: Profile,
    *,
    device: str,
    link: dict[str, Any],
    options: dict[str, Any],
    seed: int,
    unusable: str = "",
    ended: str = "",
    error: bool = False,
    interrupted: bool = False,
) -> Report:
    """Put a report together. `error` says that the kit, the port or the probe ended the run.

    An interrupted run with nothing failed cannot vouch for the rest: its exit code is 3.
    """
    code = exit_code((r.verdict for r in results), strict=bool(options.get("strict")))
    if unusable or (error and code != 1):
        code = 2
    elif interrupted and code == 0:
        code = 3
    return Report(
        grammar={
            "name": protocol.name,
            "version": protocol.version,
            "sha256": protocol.sha256,
            "file": protocol.origin,
        },
        device=device,
        link=link,
        options=options,
        seed=seed,
        exit=code,
        unusable=unusable,
        ended=ended,
        profile=_measured(profile),
        coverage=_coverage(protocol, results, cases),
        results=tuple(results),
    )


def _measured(profile: Profile) -> dict[str, float | bool | None]:
    """What was measured, times in milliseconds."""
    times = [latency / MS for latency in profile.latencies]
    timeout = profile.truncation_timeout
    return {
        "truncation_timeout_ms": None if timeout is None else round(timeout / MS, 3),
        "truncated_frames_answered": profile.truncation_answered,
        "latency_median_ms": round(statistics.median(times), 3) if times else None,
        "latency_max_ms": round(max(times), 3) if times else None,
    }


def _coverage(
    protocol: Protocol, results: Sequence[CaseResult], cases: Sequence[Case]
) -> dict[str, tuple[int, int]]:
    """What was exercised out of what there is, as facts. A case that was not run counts nothing."""
    done = {r.id for r in results if r.sent and r.axes.get("answer") and r.received}
    done |= {r.id for r in results if "stop" in r.axes or "state" in r.axes}
    run = [case for case in cases if case.id in done]
    moving = [m for m in Motion if m is not Motion.STOPPED]
    frames = {case.stimulus for case in run if case.kind is Class.VALID}
    valid = sum(1 for case in cases if case.kind is Class.VALID)
    cuts = {(case.stimulus[:1], case.arrived) for case in run if case.arrived is not None}
    classes = [k for k in Class if k not in (Class.VALID, Class.RECOVERY)]
    met = {(case.kind, case.setup.motion) for case in run if case.kind in classes}
    return {
        "headers": (len({case.stimulus[0] for case in run}), len(protocol.headers)),
        "valid frames": (len(frames), max(valid, len(frames))),
        "truncations": (len(cuts), sum(protocol.lengths)),
        "fault classes x kinds of motion": (len(met), len(classes) * len(moving)),
    }


def as_json(report: Report) -> bytes:
    """The report for machines: one JSON object, every key always there.

    `verdict` and `exit` sum up, `counts` has each verdict, `coverage` what was exercised (`done`)
    and how much there is (`of`), `profile` what was measured (ms). Each of `cases` has `id`,
    `clause`, `requirement`, `verdict`, `axes` (`answer`, `stop`, `state`: each `verdict`,
    `expected`, `actual`, `reason`; `skipped` where a case has no such axis), `reading`, `sent` (hex
    of each frame), `received` (`hex` and `t`, in s since the stimulus had gone) and `reproduce`.
    """
    document = {
        "kit": kit_version(),
        "grammar": report.grammar,
        "device": report.device,
        "link": report.link,
        "options": report.options,
        "seed": report.seed,
        "verdict": report.verdict.label,
        "exit": report.exit,
        "unusable": report.unusable or None,
        "ended": report.ended or None,
        "counts": report.counts,
        "coverage": {name: {"done": d, "of": of} for name, (d, of) in report.coverage.items()},
        "profile": report.profile,
        "cases": [_case(report, result) for result in report.results],
    }
    return msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n"


def _case(report: Report, result: CaseResult) -> dict[str, Any]:
    return {
        "id": result.id,
        "clause": result.clause,
        "requirement": result.requirement,
        "verdict": result.verdict.label,
        "axes": {name: _axis(result.axes.get(name, _NO_AXIS)) for name in AXES},
        "reading": result.reading or None,
        "sent": result.sent,
        "received": [{"hex": byte.hex, "t": byte.t / 1e9} for byte in result.received],
        "reproduce": reproduce(report, result.id),
    }


def _axis(axis: Axis) -> dict[str, str]:
    return {
        "verdict": axis.verdict.label,
        "expected": axis.expected,
        "actual": axis.actual,
        "reason": axis.reason,
    }


def reproduce(report: Report, ident: str) -> str:
    """The command that tries this case again."""
    words = ["bilprov", "conform", report.device, "--seed", str(report.seed), "--only", ident]
    if report.grammar["file"] != "grammar.py":
        words[1:1] = ["--grammar", report.grammar["file"]]
    probe, fault = report.link.get("probe"), report.link.get("fault")
    if report.link["kind"] == "port" and probe:
        words += ["--probe", probe]
    if fault:
        words += ["--fault", fault]
    return shlex.join(words)
