"""The files that a command line asks for: checked before anything is done, then written whole."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click

from bilprov.analyzer.files import real_path, why_not_writable, write_whole
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError

STANDARD_OUTPUT = "-"

# Whether files that exist are overwritten, as `force`.
force_option = click.option("--force", is_flag=True, help="Overwrite what exists.")


def require_writable(
    outputs: Iterable[tuple[str, str]], inputs: Iterable[str] = (), *, force: bool = True
) -> None:
    """Raise UsageError, in one sentence, for an output that cannot be written.

    `outputs` are the option and the path of each, `inputs` files that must not be overwritten.
    Without `force` none may exist; a pipe or a device is not overwritten.
    """
    taken = {real_path(path): f"the input {path}" for path in inputs}
    on_standard_output = ""
    for option, path in outputs:
        if path == STANDARD_OUTPUT:
            if on_standard_output:
                raise click.UsageError(
                    f"{on_standard_output} and {option} both go to standard output: "
                    "name a file for one of them"
                )
            on_standard_output = option
            continue
        file = Path(path)
        why_not = why_not_writable(file)
        if why_not:
            raise click.UsageError(f"{option} {path} cannot be written: {why_not}")
        if real_path(file) in taken:
            raise click.UsageError(
                f"{option} {path} would overwrite {taken[real_path(file)]}: name another file"
            )
        if not force and file.is_file():
            raise click.UsageError(
                f"{option} {path} exists: name another file, or say --force to overwrite it"
            )
        taken[real_path(file)] = option


def write_output(path: str, data: bytes) -> None:
    """Write bytes to a file, complete or not at all, or to standard output as they are.

    Raises UserError, in one sentence, if it cannot be written.
    """
    if path == STANDARD_OUTPUT:
        click.echo(data, nl=False)
        return
    try:
        write_whole(Path(path), data)
    except OSError as error:
        why = error.strerror or "it cannot be written"
        raise UserError(f"{printable(path)} cannot be written: {why}") from error
