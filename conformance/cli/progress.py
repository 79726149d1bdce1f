"""Shows how a run goes: a progress bar on a terminal, nothing in a pipe."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from conformance.oracle.verdicts import CaseResult, Verdict
from conformance.runner.listeners.recorder import RunRecorder


class Progress:
    """A watcher that draws a bar on standard error, and passes the marks on to a recording.

    `shown` is false where the terminal is wanted for something else: questions to a person.
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
        self._failed = 0
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
        self._bar.update(self._task, advance=1, failed=failed)
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
