"""What failed in the last run of each device, kept in the user's state folder for the next run."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec

from bilprov.analyzer.cli.settings import state_folder
from bilprov.analyzer.files import from_json, read_bounded, write_whole
from bilprov.captures.text import escape_controls
from bilprov.conformance.api import Options
from bilprov.conformance.oracle.verdicts import VOUCHED, Cause, Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

_FOLDER = "last_runs"
_MOST = 1 << 22  # bytes of a file


class LastRun(msgspec.Struct, frozen=True):
    """The last run of a device with a grammar: the ids of what failed, with verdicts, and causes.

    A case that a later run could not judge stays as it was.
    """

    device: str
    grammar: str
    failed: dict[str, Verdict] = {}
    causes: tuple[Cause, ...] = ()

    def after(self, report: Report) -> LastRun:
        """What is known after another run.

        After a run of all cases nothing is known of any other case; one of some of them (--only),
        or one that ended early, leaves what is known of the rest.
        """
        if report.unusable:
            return self
        judged = {r.id for r in report.results if r.verdict in (*VOUCHED, Verdict.FAIL)}
        if not (report.options.only or report.ended):
            judged |= self.failed.keys() - {result.id for result in report.results}
        kept = {ident: verdict for ident, verdict in self.failed.items() if ident not in judged}
        explained = {ident for cause in report.causes for ident in cause.cases}
        causes = [msgspec.structs.replace(cause, log=()) for cause in report.causes]
        for cause in self.causes:
            if kept.keys() & set(cause.cases) and not explained & set(cause.cases):
                causes.append(cause)
        failed = kept | failed_cases(report)
        return msgspec.structs.replace(self, failed=failed, causes=tuple(causes))

    def keep(self) -> None:
        """Write it for the next run; where that cannot be done, the next run knows of none."""
        file = _file(self.device, self.grammar)
        if file is None:
            return
        with suppress(OSError):
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_whole(file, msgspec.json.encode(self))


class Run(NamedTuple):
    """A run, with what was known of the device before and after it."""

    before: LastRun
    report: Report
    after: LastRun


def last_run(protocol: Protocol, *device: str | None) -> LastRun:
    """The last run of a device; nothing failed where none is known.

    `device` is what names it on the command line: the target, and the simulator's fault or variant.
    """
    words = " ".join(filter(None, device))
    none = LastRun(escape_controls(words), escape_controls(f"{protocol.name}, {protocol.origin}"))
    file = _file(none.device, none.grammar)
    if file is not None:
        with suppress(OSError, ValueError):
            return from_json(read_bounded(file, _MOST), LastRun)
    return none


def ordered(
    suite: Options, last: LastRun, planned: Collection[str], *, alone: bool
) -> tuple[Options, str]:
    """The options with which what failed last is run first, or `alone`; and that in words.

    `planned` are the ids of all cases that the run would have. Where none of them failed last, or
    there is no last run, the options stay.
    """
    failed = tuple(ident for ident in last.failed if ident in planned)
    if not failed:
        return suite, "none of the cases asked for is known to have failed: all of them are run"
    some = "" if len(failed) == len(last.failed) else f" of {len(last.failed)}, as asked for"
    if alone:
        return replace(suite, only=failed), f"only the cases that failed last ({len(failed)}{some})"
    return replace(suite, first=failed), f"first the cases that failed last ({len(failed)}{some})"


def failed_cases(report: Report) -> dict[str, Verdict]:
    """The cases that count as failed in a run, with their verdicts: none that is expected to."""
    least = Verdict.NON_STRICT if report.options.strict else Verdict.FAIL
    return {
        result.id: result.verdict
        for result in report.results
        if result.verdict in (least, Verdict.FAIL) and not result.expected_failure
    }


def _file(device: str, grammar: str) -> Path | None:
    folder = state_folder()
    name = hashlib.sha256(f"{device}\n{grammar}".encode()).hexdigest()[:32]
    return folder / _FOLDER / f"{name}.json" if folder else None
