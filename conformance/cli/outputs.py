"""Writes reports to the files that the command line names; each is written whole or not at all."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import rich_click as click

from bilprov.analyzer.files import write_whole
from bilprov.analyzer.transport.signals import undisturbed
from bilprov.conformance.report.formats import FORMATS, Writer, writer_of
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])

STANDARD_OUTPUT = "-"


def report_options(command: Command) -> Command:
    """Add `--junit`, `--markdown` and `--html` to a command: path, - (standard output) or None."""
    for form in reversed([form for name, form in FORMATS.items() if name != "json"]):
        command = click.option(form.option, metavar="FILE", help=form.help)(command)
    return command


class Output(NamedTuple):
    """One file to write: the option that asks for it, its path, and the writer of its format."""

    option: str
    path: str
    write: Writer


def wanted(paths: Mapping[str, str | None]) -> list[Output]:
    """The outputs that are asked for; `paths` are keyed by the names of FORMATS."""
    return [
        Output(FORMATS[name].option, path, writer_of(FORMATS[name]))
        for name, path in paths.items()
        if path is not None
    ]


def require_writable(outputs: Iterable[Output], inputs: Iterable[str] = ()) -> None:
    """Raise UsageError, in one sentence, for an output that cannot be written.

    It is called before the robot moves. `inputs` are files that must not be overwritten.
    """
    taken = {Path(path).resolve(): f"the input {path}" for path in inputs}
    on_standard_output = ""
    for option, path, _ in outputs:
        if path == STANDARD_OUTPUT:
            if on_standard_output:
                raise click.UsageError(
                    f"{on_standard_output} and {option} both go to standard output: "
                    "name a file for one of them"
                )
            on_standard_output = option
            continue
        file = Path(path)
        folder = file.absolute().parent
        if file.is_dir() or not folder.is_dir():
            raise click.UsageError(
                f"{option} {path} cannot be written: name a file in a folder that exists"
            )
        if not _may_write(file):
            raise click.UsageError(
                f"{option} {path} cannot be written: this user may not; name another file"
            )
        if file.resolve() in taken:
            raise click.UsageError(
                f"{option} {path} would overwrite {taken[file.resolve()]}: name another file"
            )
        taken[file.resolve()] = option


def _may_write(file: Path) -> bool:
    if file.exists() and not file.is_file():  # a pipe, a terminal: written as it is
        return os.access(file, os.W_OK)
    kept = not file.exists() or os.access(file, os.W_OK)
    return kept and os.access(file.resolve().parent, os.W_OK | os.X_OK)


def deliver(outputs: Iterable[Output], reports: Sequence[Report], protocol: Protocol) -> None:
    """Write every output, the files first, even if one of them cannot be written.

    Ctrl-C and the like take effect only when the files are written. Raises the first OSError. An
    existing file that could not be written stays as it was.
    """
    failed: list[OSError] = []
    onto_stdout: list[str] = []
    with undisturbed(again=False):
        for output in outputs:
            text = output.write(reports, protocol)
            if output.path == STANDARD_OUTPUT:
                onto_stdout.append(text)
                continue
            try:
                write_whole(Path(output.path), text.encode(errors="backslashreplace"))
            except OSError as error:
                failed.append(error)
    for text in onto_stdout:
        sys.stdout.write(text)
        sys.stdout.flush()
    if failed:
        raise failed[0]
