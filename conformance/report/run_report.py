"""The report of a run as one value, from which every form of it and the exit code come."""

from __future__ import annotations

import shlex
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import msgspec

from bilprov.analyzer.client.operations import Ended
from bilprov.analyzer.foreign import safe
from bilprov.analyzer.version import kit_version
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.coverage import covered
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.verdicts import CaseResult, Cause, Verdict, exit_code, worst
from bilprov.conformance.report.expected import Comparison
from bilprov.conformance.report.proof import proven
from bilprov.spec.protocol import Protocol

AXES = ("answer", "stop", "state")


class Report(msgspec.Struct, frozen=True):
    """The result of a run: what was tested, with which options, and what came of it.

    `unusable` says why nothing could be judged, `ended` why the run ended early; both are "" for a
    run that went to its end. For one that ended early `ended_by` is `error` (the kit, the port or
    the probe failed) or `user`. `profile` holds what was measured (ms), `coverage` pairs of how
    many and out of how many, `kit` the version that judged. `comparison` is that with a file of
    expected failures, if there is one. `again` has each case's command to reproduce it, for a
    report that was read from a file. `timing` says where the time went (see `meter`), `proof` what
    the level `complete` has proven.
    `begun` is when the run began (ISO 8601, UTC), `took_s` how long it took, `host` the machine's
    name, `versions` those of Python, its platform and libraries: each "", None or empty where it is
    not known. `unseen` says what the probe did not show, and from which look on, `notices` what
    else the user should know of device, line and probe. `causes` explain the failed cases, the
    worst first. `file` is where the report was read from, "" for a run of this process.
    """

    grammar: dict[str, str]
    device: str
    link: dict[str, Any]
    options: dict[str, Any]
    seed: int
    exit: int
    unusable: str
    ended: str
    profile: dict[str, Any]
    coverage: dict[str, tuple[int, int]]
    results: tuple[CaseResult, ...]
    kit: str = ""
    ended_by: str = ""
    comparison: Comparison | None = None
    again: dict[str, str] = {}
    timing: dict[str, float] = {}
    proof: str = ""
    begun: str = ""
    took_s: float | None = None
    host: str = ""
    versions: dict[str, str] = {}
    unseen: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()
    file: str = ""

    @property
    def verdict(self) -> Verdict:
        """The worst verdict, ERROR where nothing could be judged."""
        return Verdict.ERROR if self.unusable else worst(r.verdict for r in self.results)

    @property
    def unexplained(self) -> int:
        """How many failed cases no cause explains."""
        known = {ident for cause in self.causes for ident in cause.cases}
        return sum(r.verdict is Verdict.FAIL and r.id not in known for r in self.results)

    @property
    def counts(self) -> dict[str, int]:
        """How many cases have each verdict, from best to worst."""
        found = Counter(result.verdict for result in self.results)
        return {verdict.label: found[verdict] for verdict in Verdict}


def make_report(
    protocol: Protocol,
    results: Sequence[CaseResult],
    cases: Sequence[AnyCase],
    profile: Profile,
    options: dict[str, Any],
    *,
    unusable: str = "",
    ended: Ended | None = None,
    **facts: Any,
) -> Report:
    """Put a report together; `ended` is what cut the run short, None for a run to its end.

    `facts` are further fields of the report: `device`, `link` and, if known, what the run spent.
    """
    ended_by = "" if ended is None else ended.by
    measured = _measured(profile)
    foreign = {"ended": "" if ended is None else str(ended), "unusable": unusable, **facts}
    return Report(
        grammar={
            "name": protocol.name,
            "version": protocol.version,
            "sha256": protocol.sha256,
            "file": protocol.origin,
        },
        options=safe(options),
        seed=options["seed"],
        exit=decided_exit(results, options, unusable, ended_by),
        ended_by=ended_by,
        profile=measured,
        coverage=coverage(protocol, results, cases),
        results=tuple(results),
        proof=proven(protocol, results, options, measured),
        kit=kit_version(),
        **safe(foreign),
    )


def compared(report: Report, comparison: Comparison) -> Report:
    """The report with a comparison: only failures that are not expected decide its exit code.

    A stale entry makes it 1.
    """
    counted = [r for r in report.results if r.id not in comparison.expected]
    code = decided_exit(counted, report.options, report.unusable, report.ended_by)
    if comparison.stale:
        code = 1
    return msgspec.structs.replace(report, exit=code, comparison=comparison)


def decided_exit(
    results: Sequence[CaseResult], options: dict[str, Any], unusable: str, ended_by: str
) -> int:
    """The exit code of a run with these results; `unusable` and `ended_by` as in a Report.

    An interrupted run with nothing failed has exit code 3, because the rest was not judged.
    """
    code = exit_code((r.verdict for r in results), strict=bool(options.get("strict")))
    if unusable or (ended_by == "error" and code != 1):
        return 2
    return 3 if ended_by and code == 0 else code


def _measured(profile: Profile) -> dict[str, Any]:
    """The profile for a report: measured times in milliseconds, and choices at open points."""
    times = [latency / MS for latency in profile.latencies]

    def ms(time: int | None) -> float | None:
        return None if time is None else round(time / MS, 3)

    return {
        "truncation_timeout_ms": ms(profile.truncation_timeout),
        "truncated_frames_answered": profile.truncation_answered,
        "latency_median_ms": round(statistics.median(times), 3) if times else None,
        "latency_max_ms": round(max(times), 3) if times else None,
        "round_trip_ms": ms(profile.round_trip),
        "jitter_ms": ms(profile.jitter),
        "boot_ms": ms(profile.boot),
        "flushes": profile.flushes,
        "flushes_for_ms": ms(profile.flushes_for),
        "whole_frame": profile.whole_frame,
        "led_id": profile.choices.led_id,
        "stop_latency_ms": ms(profile.stop_latency),
        "watchdog_ms": ms(profile.watchdog),
        "facets": sorted(profile.facets),
        "preamble_speed": profile.preamble_speed,
        "all_but_two_answers_ms": ms(profile.all_but_two),
        "wheels": [asdict(curve) for curve in profile.wheels],
        "readings": {point: word for point, (word, _) in sorted(profile.choices.shown.items())},
    }


def coverage(
    protocol: Protocol, results: Sequence[CaseResult], cases: Sequence[AnyCase]
) -> dict[str, tuple[int, int]]:
    """How many facts (see `cases.coverage`) of each kind the run exercised, out of how many.

    A case that was not run does not count, nor does a sequence that was not judged to its end.
    """
    done = {r.id for r in results if r.counted or (r.sent and r.axes.get("answer") and r.received)}
    done |= {r.id for r in results if "stop" in r.axes or "state" in r.axes}
    broken = {r.id for r in results if r.verdict >= Verdict.INCONCLUSIVE}
    run = [
        c for c in cases if c.id in done and not (isinstance(c, SequenceCase) and c.id in broken)
    ]
    return covered(protocol, run)


def run_facts(report: Report) -> dict[str, str]:
    """When, where and with what the run was made, and what to know of it: labels and words.

    What is not known is left out.
    """
    took = "" if report.took_s is None else f"{report.took_s:.1f} s"
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    told = {"begun": report.begun, "took": took, "host": report.host, "versions": versions}
    told["not seen"] = "; ".join(report.unseen)
    told["notice"] = "; ".join(report.notices)
    return {name: words for name, words in told.items() if words}


def evidence(result: CaseResult) -> list[tuple[str, str]]:
    """Labels and words: what was sent, and what was expected and seen on the axes not passed.

    Of a case that failed these are the axes that failed.
    """
    frames = f"{result.frames} frames, made again with --only {result.id}"
    rows = [("sent", " | ".join(result.sent) or (frames if result.counted else "nothing"))]
    for name, axis in result.axes.items():
        if axis.verdict in (Verdict.PASS, Verdict.SKIPPED):
            continue
        if result.verdict is Verdict.FAIL and axis.verdict < Verdict.FAIL:
            continue
        reading = f" [{axis.reading}]" if axis.reading else ""
        said = [(name, axis.reason + reading), ("expected", axis.expected), ("got", axis.actual)]
        rows += [(label, words) for label, words in said if words]
    return rows


def port_of(report: Report) -> str:
    """The port to send to; `PORT` for the built-in simulator, where `bilprov simulate` serves."""
    return report.device if report.link["kind"] == "port" else "PORT"


def reproduce(report: Report, result: CaseResult) -> str:
    """The command that runs this case again or, for a sequence, sends the frames that fail.

    For the built-in simulator the frames go to `PORT`, where `bilprov simulate` serves it.
    """
    if report.again.get(result.id):
        return report.again[result.id]
    grammar = report.grammar["file"]
    start = ["bilprov"] if grammar == "grammar.py" else ["bilprov", "--grammar", grammar]
    if result.reproduce:
        return shlex.join([*start, "send", port_of(report), *result.reproduce.split()])
    words = [*start, "conform", report.device, "--seed", str(report.seed), "--only", result.id]
    if report.options.get("level", "standard") != "standard":
        words += ["--level", report.options["level"]]
    if report.options.get("extra"):
        words += ["--extra", str(report.options["extra"])]
    if report.options.get("deadline"):
        words += ["--deadline", f"{report.options['deadline']:g}"]
    for allowed in report.options.get("allow", ()):
        words += ["--allow", allowed]
    probe, fault = report.link.get("probe"), report.link.get("fault")
    if report.link["kind"] == "port" and probe:
        words += ["--probe", probe]
    if fault:
        words += ["--fault", fault]
    return shlex.join(words)
