"""Shows the progress of a run as a bar on a terminal; shows nothing in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import progress
from rich.console import Console
from rich.progress import Progress as Bar

from bilprov.captures.closing import Closing
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.runner.listeners.listener import RunListener


def bar(*columns: progress.ProgressColumn, shown: bool = True) -> Bar:
    """A progress bar on standard error, with a description first; shown on a terminal only."""
    console = Console(stderr=True)
    return Bar(
        progress.TextColumn("{task.description}", markup=False),  # a case has names of the grammar
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeRemainingColumn(),
        *columns,
        console=console,
        transient=True,
        disable=not (shown and console.is_terminal),
    )


@contextmanager
def counted(total: int) -> Iterator[Callable[[str], None]]:
    """A bar of so many names; what it gives is called with each that is done."""
    with bar() as shown:
        task = shown.add_task("", total=total)
        yield lambda name: shown.update(task, advance=1, description=name[:40].ljust(40))


class Progress(Closing, RunListener):
    """A run listener that draws a bar on standard error.

    `shown` is false where the terminal is needed for something else: questions to a person.
    """

    def __init__(self, total: int, *, shown: bool = True) -> None:
        self._bar = bar(progress.TextColumn("{task.fields[failed]}"), shown=shown)
        self._task = self._bar.add_task("", total=total, failed="")
        self._total, self._done, self._failed = total, 0, 0
        self._bar.start()

    def begin(self, ident: str) -> None:
        """A case begins."""
        self._bar.update(self._task, description=ident.ljust(26))

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._failed += result.verdict >= Verdict.FAIL
        failed = f"[red]{self._failed} failed" if self._failed else ""
        self._done += 1
        total = max(self._total, self._done)  # a fault may add cases of its own
        self._bar.update(self._task, total=total, advance=1, failed=failed)

    def note(self, sentence: str) -> None:
        """Print a sentence above the bar, on standard error."""
        self._bar.console.print(sentence, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.stop()
