"""The files that a command line asks for: checked before anything is done, then written whole."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import click

from bilprov.analyzer.cli.command import flag, option
from bilprov.analyzer.files import real_path, whole_file, why_not_writable
from bilprov.captures.parts import kept_parts
from bilprov.captures.text import escape_json
from bilprov.spec.errors import UserError

STANDARD_OUTPUT = "-"

force_option = partial(flag, "Overwrite what exists.")
json_option = partial(
    option,
    "--json",
    metavar="FILE",
    help="Write everything as one JSON object; - is standard output, which then holds nothing "
    "else.",
)


def require_writable(
    outputs: Iterable[tuple[str, str]],
    inputs: Iterable[str] = (),
    *,
    force: bool = True,
    regular: bool = False,
) -> None:
    """Raise UsageError, in one sentence, for an output that cannot be written.

    `outputs` are the option and the path of each, `inputs` files, or recordings in parts, that must
    not be overwritten; nor may the grammar in use.
    Without `force` none may exist; a pipe or a device is not overwritten, and with `regular` it is
    refused.
    """
    context = click.get_current_context(silent=True)
    inputs = [*inputs, *([context.obj] if context and context.obj else [])]
    inputs += [str(part) for one in inputs for part in kept_parts(Path(one)).values()]
    taken: dict[Path, str] = {}
    for name, path in outputs:
        file = Path(path)
        if path == STANDARD_OUTPUT:
            if regular:
                raise click.UsageError(f"{name} - is standard output, not a regular file: name one")
            if other := taken.get(file):
                raise click.UsageError(
                    f"{other} and {name} both go to standard output: name a file for one of them"
                )
            taken[file] = name
            continue
        parts = kept_parts(file) if regular else {}
        lost = next((f"the input {one}" for one in inputs if _same(file, Path(one))), None)
        lost = lost or taken.get(real_path(file))
        if why_not := why_not_writable(file):
            wrong = f"cannot be written: {why_not}"
        elif lost:
            wrong = f"would overwrite {lost}: name another file"
        elif parts:
            first = next(iter(parts.values()))
            wrong = (
                f"is the name of a recording in parts, {first} and so on, which it would hide: "
                "name another file"
            )
        elif regular and file.exists() and not file.is_file():
            wrong = "is not a regular file: name another one"
        elif not force and file.is_file():
            wrong = "exists: name another file, or give --force to overwrite it"
        else:
            taken[real_path(file)] = name
            continue
        raise click.UsageError(f"{name} {path} {wrong}")


def _same(one: Path, other: Path) -> bool:
    """Whether two names are of one file, by links too."""
    try:
        return one.samefile(other)
    except OSError:  # one of them is not there
        return real_path(one) == real_path(other)


@contextmanager
def opened_file(path: str, *, replace: bool = True) -> Iterator[BinaryIO]:
    """Open a file, which is there only if the block ends well, or standard output.

    Raises UserError, in one sentence, if it cannot be written.
    """
    if path == STANDARD_OUTPUT:
        yield sys.stdout.buffer
        sys.stdout.buffer.flush()
        return
    try:
        with whole_file(Path(path), replace=replace) as file:
            yield file
    except OSError as error:
        why = error.strerror or "it cannot be written"
        raise UserError(f"{path} cannot be written: {why}") from error


def write_output(path: str, data: bytes) -> None:
    """Write bytes as `opened_file` does."""
    with opened_file(path) as file:
        file.write(data)


def json_object(value: Any) -> bytes:
    """A value as indented JSON, safe to show."""
    import msgspec

    return escape_json(msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n")
