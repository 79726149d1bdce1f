"""Writes reports to the files that the command line names; each is written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import click

from bilprov.analyzer.cli import output_files
from bilprov.analyzer.transport.signals import undisturbed
from bilprov.conformance.report.formats import FORMATS, Writer
from bilprov.conformance.report.run_report import Report
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


class Output(NamedTuple):
    """One file to write: the option that asks for it, its path, and the writer of its format."""

    option: str
    path: str
    write: Writer


def output_options(
    names: Iterable[str] = tuple(FORMATS), *, help: str = ""
) -> Callable[[Command], Callable[..., Any]]:
    """Add the options of some formats to a command, which gets the outputs asked for: `outputs`.

    `help` stands in for the help text of the format.
    """

    def decorated(command: Command) -> Callable[..., Any]:
        @wraps(command)
        def called(*arguments: Any, **options: Any) -> Any:
            paths = {name: options.pop(name) for name in names}
            outputs = [
                Output(f"--{name}", path, FORMATS[name].write)
                for name, path in paths.items()
                if path is not None
            ]
            return command(*arguments, outputs=outputs, **options)

        for name in reversed(tuple(names)):
            text = help or FORMATS[name].help
            click.option(f"--{name}", name, metavar="FILE", help=text)(called)
        return called

    return decorated


def onto_standard_output(outputs: Iterable[Output]) -> bool:
    """Whether one of the outputs goes to standard output, where nothing else may then stand."""
    return any(output.path == output_files.STANDARD_OUTPUT for output in outputs)


def require_writable(outputs: Iterable[Output], inputs: Iterable[str] = ()) -> None:
    """Raise UsageError, in one sentence, for an output that cannot be written.

    It is called before the robot moves. `inputs` are files that must not be overwritten.
    """
    output_files.require_writable(((output.option, output.path) for output in outputs), inputs)


def deliver(outputs: Iterable[Output], reports: Sequence[Report], protocol: Protocol) -> None:
    """Write every output as `write_each` does."""
    write_each((output.path, output.write(reports, protocol)) for output in outputs)


def write_each(texts: Iterable[tuple[str, str]]) -> None:
    """Write texts to their paths, the files first, even if one of them cannot be written.

    Ctrl-C and the like take effect only when the files are written. Raises UserError, one sentence
    that names each file that could not be written; one that existed stays as it was.
    """
    failed: list[str] = []
    onto_stdout: list[bytes] = []
    with undisturbed(again=False):
        for path, text in texts:
            data = text.encode(errors="backslashreplace")
            if path == output_files.STANDARD_OUTPUT:
                onto_stdout.append(data)
                continue
            try:
                output_files.write_output(path, data)
            except UserError as error:
                failed.append(str(error))
    for data in onto_stdout:
        click.echo(data, nl=False)  # in UTF-8, as in a file, whatever the locale is
    if failed:
        raise UserError("; ".join(failed))
