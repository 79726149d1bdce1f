"""`bilprov conform --watch`: tests a device again whenever it comes back or a file has changed."""

from __future__ import annotations

import select
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import click
from rich.console import Console

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.client.probes import ProbeError
from bilprov.analyzer.transport import replug
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.signals import Stopper, ending_requested
from bilprov.captures.text import quantity
from bilprov.conformance.cli.last_run import LastRun, Run, failed_cases
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.target import PORT, SIM, TargetName
from bilprov.conformance.report.grouping import changed_causes

_NEW = "new failures"
_NAMED = 3  # cases in a line
_CAUSES = {"gone": "fixed", "still there": "still there", "changed": "still there", "new": "new"}
_NETWORK = ("socket://", "rfc2217://")
_ABSENT = (LinkError, ProbeError, EmulatorError)  # of a device that cannot be opened yet

Again: TypeAlias = Callable[[TargetName, LastRun], Run]
"""Runs the suite on the device of that name, after the last run.

Raises LinkError, ProbeError or EmulatorError, before anything is sent, where it cannot be opened.
"""


class FileWatch:
    """Notices that a file has changed, once it has been the same at two looks."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known = self._seen = self._state()

    def changed(self) -> bool:
        """Whether it has changed since this was last true, or since the beginning."""
        before, self._seen = self._seen, self._state()
        if self._seen in (None, self._known) or self._seen != before:
            return False
        self._known = self._seen
        return True

    def _state(self) -> tuple[int, int, int] | None:
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_size, status.st_mtime_ns


class Comeback:
    """What a run of the device `name` waits for: the device, a file, or either.

    Raises UsageError where there is nothing to wait for.
    """

    def __init__(self, name: TargetName, settings: LineSettings, file: str | None) -> None:
        self.name = name
        self._port: replug.PathWatch | replug.ConnectionWatch | None = None
        if name.text.lower().startswith(_NETWORK):
            self._port = replug.ConnectionWatch(name.text, settings)
        elif name.kind == PORT and replug.Place(name.text).lasts:
            self._port = replug.PathWatch(name.text)
        watched = [Path(file)] if file else [] if name.kind in (PORT, SIM) else [name.firmware]
        self._files = [FileWatch(path) for path in watched]
        if not (self._port or self._files):
            raise click.UsageError(
                f"{name.text} cannot be seen to come back: name a file that changes when it should "
                "be tested again, with --watch-file"
            )

    @property
    def words(self) -> str:
        """What is waited for, in words."""
        waits = [f"{self.name.text} to come back"] if self._port else []
        return " or ".join(waits + [f"{file.path} to change" for file in self._files])

    def wait(self, stopper: Stopper) -> None:
        """Wait until the device is there again, a file has changed, or `stopper` is to stop."""
        while not stopper.stopped:
            # Each is looked at each time: what is not waited for any more is then no news.
            changed = [file.path for file in self._files if file.changed()]
            if self._port is not None and self._port.returned():
                note(f"{self._port.name} is there again")
                break
            if changed:
                note(f"{changed[0]} has changed")
                break
            select.select([stopper], [], [], replug.LOOK_AGAIN)

    def begin(self, *, lost: bool) -> None:
        """The run is over and its port closed; `lost` where that was why it ended."""
        if self._port is not None:
            self._port.begin(lost=lost)

    def end(self) -> None:
        """The next run begins."""
        if self._port is not None:
            self._port.end()
            self.name = replace(self.name, text=self._port.name)


def watch(first: Run, again: Again, comeback: Comeback, console: Console) -> int:
    """Report the first run, and test the device again and again; returns the last exit code.

    It ends when a signal asks for that, also during a run. A device that cannot be opened is tried
    until it can.
    """
    number, run = 1, first
    with Stopper() as stopper:
        try:
            while True:
                comeback.begin(lost=run.report.ended_by == "error")
                for line in change_words(number, run):
                    console.print(line, markup=False, soft_wrap=True)
                if stopper.stopped or ending_requested() or run.report.ended_by == "user":
                    break
                note(f"waiting for {comeback.words}; Ctrl-C ends")
                comeback.wait(stopper)
                comeback.end()
                open_it = partial(again, comeback.name, run.after)
                next_run = replug.opened_when_there(
                    open_it, lambda: stopper.stopped, note, absent=_ABSENT
                )
                if next_run is None:
                    break
                number, run = number + 1, next_run
        finally:
            comeback.end()
    return run.report.exit


def change_words(number: int, run: Run) -> list[str]:
    """What a run has changed since the one before, in words: a line of numbers, then the cases."""
    if run.report.unusable:
        return [f"run {number}: not judged"]
    failed, after = failed_cases(run.report), run.after.failed
    before = run.before.failed
    lists = {
        "fixed": [ident for ident in before if ident not in after],
        "still failing": [ident for ident in before if ident in failed],
        _NEW: [ident for ident in failed if ident not in before],
        "not judged again": [ident for ident in before if ident in after and ident not in failed],
    }
    lists = {what: idents for what, idents in lists.items() if idents}
    counts = ", ".join(
        quantity(len(idents), "new failure") if what == _NEW else f"{len(idents)} {what}"
        for what, idents in lists.items()
    )
    width = max(map(len, lists), default=0)
    early = ", ended early" if run.report.ended else ""
    changes = changed_causes(run.before.causes, run.after.causes)
    became = Counter(_CAUSES[one.change] for one in changes)
    causes = ", ".join(f"{count} {what}" for what, count in became.items())
    return [
        f"run {number}: {counts or 'nothing fails'}{early}{causes and '; causes: '}{causes}",
        *(f"  {what:{width}}  {_named(idents)}" for what, idents in lists.items()),
    ]


def _named(idents: Collection[str]) -> str:
    shown = ", ".join(list(idents)[:_NAMED])
    more = len(idents) - _NAMED
    return f"{shown} and {quantity(more, 'other')}" if more > 0 else shown
