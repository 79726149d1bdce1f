"""The formats of a report, and the files of the command line, each written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import click

from bilprov.analyzer.cli import command_files
from bilprov.analyzer.cli.command import option_each
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Report
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

Writer = Callable[[Sequence[Report], Protocol], str]


def _json(reports: Sequence[Report], protocol: Protocol) -> str:
    return as_json(*reports).decode()


# For each format its option's help text, and its writer. The option is its name with two dashes.
FORMATS: dict[str, tuple[str, Writer]] = {
    "json": ("The report as JSON; - is standard output.", _json),
    "junit": ("JUnit XML, for a CI's list of tests.", as_junit),
    "markdown": ("A summary for a CI's page.", as_markdown),
    "html": ("One page with matrix, wire logs and timing pictures.", as_html),
}
SEVERAL = ("junit", "markdown", "html")
"""The formats that take several reports."""


class Output(NamedTuple):
    """One file to write: the option that asks for it, its path, and the writer of its format."""

    option: str
    path: str
    write: Writer


def outputs_option(names: Iterable[str] = tuple(FORMATS), help: str = "") -> Any:
    """A field with the paths of the options of some formats, by format.

    `help` stands in for the help text of the format.
    """
    return option_each(
        {name: {"metavar": "FILE", "help": help or FORMATS[name][0]} for name in names}
    )


class Outputs(list[Output]):
    """The outputs that were asked for, by the paths of an `outputs_option`."""

    def __init__(self, paths: Mapping[str, str]) -> None:
        for name, path in paths.items():
            self.append(Output(f"--{name}", path, FORMATS[name][1]))

    @property
    def onto_stdout(self) -> bool:
        """Whether one of them goes to standard output, where nothing else may then stand."""
        return any(output.path == command_files.STANDARD_OUTPUT for output in self)

    def require_writable(self, inputs: Iterable[str] = ()) -> None:
        """Raise UsageError, in one sentence, for an output that cannot be written.

        It is called before the robot moves. `inputs` are files that must not be overwritten.
        """
        command_files.require_writable(((output.option, output.path) for output in self), inputs)


def write_each(
    texts: Iterable[tuple[str, str]], signals: AbstractContextManager[object] | None = None
) -> None:
    """Write texts to their paths, the files first, even if one of them cannot be written.

    Ctrl-C and the like change nothing until the files are written. `signals` is what has handled
    them since before the call, and is left then. Raises UserError, one sentence that names each
    file that could not be written; one that existed stays as it was.
    """
    failed: list[str] = []
    onto_stdout: list[bytes] = []
    with signals or Stopper():
        for path, text in texts:
            data = text.encode(errors="backslashreplace")
            if path == command_files.STANDARD_OUTPUT:
                onto_stdout.append(data)
                continue
            try:
                command_files.write_output(path, data)
            except UserError as error:
                failed.append(str(error))
    for data in onto_stdout:
        click.echo(data, nl=False)  # in UTF-8, as in a file, whatever the locale is
    if failed:
        raise UserError("; ".join(failed))
