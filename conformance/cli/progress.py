"""Shows the progress of a run as a bar on a terminal; shows nothing in a pipe."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.listeners.recorder import RunRecorder


class Progress:
    """A run listener that draws a bar on standard error, and passes each call on to a recorder.

    `shown` is false where the terminal is needed for something else: questions to a person.
    """

    def __init__(self, total: int, recorder: RunRecorder | None, *, shown: bool = True) -> None:
        console = Console(stderr=True)
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[failed]}"),
            console=console,
            transient=True,
            disable=not (shown and console.is_terminal),
        )
        self._task = self._bar.add_task("", total=total, failed="")
        self._total, self._done, self._failed = total, 0, 0
        self._recorder = recorder

    def begin(self, ident: str) -> None:
        """A case begins."""
        self._bar.update(self._task, description=ident.ljust(26))
        if self._recorder:
            self._recorder.begin(ident)

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._failed += result.verdict >= Verdict.FAIL
        failed = f"[red]{self._failed} failed" if self._failed else ""
        self._done += 1
        total = max(self._total, self._done)  # a fault may add cases of its own
        self._bar.update(self._task, total=total, advance=1, failed=failed)
        if self._recorder:
            self._recorder.end(result)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
