"""Writes reports where the command line asks for them: whole, or not at all."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import rich_click as click

from analyzer.whole_file import write_whole
from conformance.report.run_report import Report, as_json
from spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])
Writer = Callable[[Sequence[Report], Protocol], str]

STANDARD_OUTPUT = "-"


class Format(NamedTuple):
    """One way to write reports: its option, what it is for, and where its writer lives."""

    option: str
    help: str
    module: str
    writer: str


FORMATS = {
    "json": Format(
        "--json", "The report as JSON, for machines.", "conformance.cli.outputs", "_as_json"
    ),
    "junit": Format(
        "--junit", "JUnit XML, for a CI's list of tests.", "conformance.report.junit", "as_junit"
    ),
    "markdown": Format(
        "--markdown", "A summary for a CI's page.", "conformance.report.markdown", "as_markdown"
    ),
    "html": Format(
        "--html",
        "One page with matrix, wire logs and timing pictures.",
        "conformance.report.html.page",
        "as_html",
    ),
}


def report_options(command: Command) -> Command:
    """`--junit`, `--markdown` and `--html`, each a path, - for standard output, or None."""
    for form in reversed([form for name, form in FORMATS.items() if name != "json"]):
        command = click.option(form.option, metavar="FILE", help=form.help)(command)
    return command


class Output(NamedTuple):
    """One file that is asked for: the option that did, the path, and who writes it."""

    option: str
    path: str
    write: Writer


def wanted(paths: Mapping[str, str | None]) -> list[Output]:
    """The outputs that are asked for, by the names of FORMATS."""
    return [
        Output(FORMATS[name].option, path, _writer(FORMATS[name]))
        for name, path in paths.items()
        if path is not None
    ]


def _writer(form: Format) -> Writer:
    def write(reports: Sequence[Report], protocol: Protocol) -> str:
        written: str = getattr(import_module(form.module), form.writer)(reports, protocol)
        return written

    return write


def _as_json(reports: Sequence[Report], protocol: Protocol) -> str:
    (report,) = reports
    return as_json(report).decode()


def require_writable(outputs: Iterable[Output], inputs: Iterable[str] = ()) -> None:
    """Refuse what cannot be written: that is better known before the robot moves.

    `inputs` are files that must not be overwritten. Raises UsageError in one sentence.
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
    """Write every output; one that cannot be written does not keep the others from it.

    Raises the first OSError. A file that was there and could not be written is as it was.
    """
    failed: list[OSError] = []
    for output in outputs:
        text = output.write(reports, protocol)
        if output.path == STANDARD_OUTPUT:
            sys.stdout.write(text)
            continue
        try:
            write_whole(Path(output.path), text.encode(errors="backslashreplace"))
        except OSError as error:
            failed.append(error)
    if failed:
        raise failed[0]
