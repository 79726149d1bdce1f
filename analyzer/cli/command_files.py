"""The files of a command line: the captures that it reads, and what it writes.

Outputs are checked before anything is done, then written whole. While captures are read, a bar
shows how far that has come, and Ctrl-C ends it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from bilprov.analyzer.cli.command import flag, option, protocol_in_use, typed_protocol
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.files import real_path, whole_file, why_not_writable
from bilprov.captures.parts import is_capture, kept_parts
from bilprov.captures.text import escape_json
from bilprov.spec.errors import UserError

if TYPE_CHECKING:
    from bilprov.analyzer.replay.capture_decoding import Progress
    from bilprov.captures.reader import Capture
    from bilprov.spec.protocol import Protocol

_LONG = 1 << 18  # bytes of files from which on a bar is drawn
_STEPS = 200  # of the bar
_KEPT = {-3: 1 << 25, -1: 1 << 28}  # bytes: glibc's M_MMAP_THRESHOLD and M_TRIM_THRESHOLD


def opened_captures(
    paths: Iterable[str | Path], *, copied: bool = False, half_duplex: bool = False
) -> tuple[list[Capture], Protocol]:
    """Open captures, and print what there is to note about each; with the protocol of all.

    `copied` is as in `protocol_of`; with `half_duplex` both directions are in one stream, and are
    told apart. Raises CaptureError, and GrammarError as `protocol_of` does.
    """
    from bilprov.analyzer.replay.capture_decoding import said_about
    from bilprov.captures.reader import open_verified

    keep_memory()
    captures = [open_verified(path) for path in paths]
    protocol = protocol_of(*captures, copied=copied)
    if half_duplex:
        captures = [split(capture, protocol) for capture in captures]
    for capture in captures:
        note(*said_about(capture, protocol))
    return captures, protocol


def split(capture: Capture, protocol: Protocol) -> Capture:
    """A capture of one tap on a wire, with the directions told apart.

    It is kept in a temporary file as long as the command runs. Raises CaptureError and UserError.
    """
    from dataclasses import replace
    from tempfile import TemporaryDirectory

    from bilprov.analyzer.edit.cut import new_capture, split_metadata, write_split
    from bilprov.captures.reader import open_capture

    folder = click.get_current_context().with_resource(TemporaryDirectory(prefix="bilprov-"))
    path, metadata = Path(folder, capture.path.name), split_metadata(capture, protocol)
    with (
        reading([capture]) as progress,
        new_capture(path, [capture], metadata, protocol, progress, force=False) as copy,
    ):
        write_split(capture, copy)
    return replace(open_capture(path), path=capture.path)


def keep_memory() -> None:
    """Let the arrays of each batch have the memory of those before.

    Else the C library returns it to the system and gets it anew, page by page, which takes a fifth
    of the time of reading a long capture. Other C libraries than glibc have no such setting.
    """
    import ctypes

    with suppress(AttributeError):
        for setting, size in _KEPT.items():
            ctypes.CDLL(None).mallopt(setting, size)


def protocol_of(*captures: Capture, copied: bool = False) -> Protocol:
    """The protocol by which captures are decoded: of the grammar that was typed, else of theirs.

    Where a capture is `copied` and its grammar is not known, there is none. Raises GrammarError.
    """
    from bilprov.analyzer.replay.capture_decoding import capture_protocol, require_known

    typed = typed_protocol()
    protocol = typed or capture_protocol(captures, protocol_in_use())
    if copied and typed is None:
        require_known(captures, protocol)
    return protocol


@contextmanager
def reading(
    captures: Sequence[Capture], *, times: int = 1, least: int = _LONG
) -> Iterator[Progress]:
    """Give a function that is told how many raw bytes of the captures were read more.

    On a terminal a bar shows how much of it is done, from `least` bytes on; the captures are read
    so many times. After Ctrl-C or SIGTERM the function raises click's Abort.
    """
    from bilprov.analyzer.transport.signals import Stopper

    total = times * sum(capture.contents.size for capture in captures)
    steps, hidden = max(1, total // _STEPS), total < least or not sys.stderr.isatty()
    shown = click.progressbar(length=total, file=sys.stderr, update_min_steps=steps, hidden=hidden)
    with Stopper() as stopper, shown as bar:

        def progress(size: int) -> None:
            if stopper.stopped:
                raise click.Abort
            bar.update(sum(capture.passed for capture in captures) - bar.pos)

        try:
            yield progress
            bar.update(total - bar.pos)  # also of what nobody had to read
        except click.Abort:
            note("stopped before the end")
            raise


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
    outputs: Iterable[tuple[str, str | None]],
    inputs: Iterable[str] = (),
    *,
    force: bool | None = None,
    regular: bool = False,
) -> None:
    """Raise UsageError, in one sentence, for an output that cannot be written.

    `outputs` are the option and the path of each, None where it is not given; `inputs` files, or
    recordings in parts, that must not be overwritten; nor may the grammar in use.
    `force` is the command's option: without it none may exist; None is for commands that have none
    and renew what exists, but never a capture. A pipe or a device is not overwritten, and with
    `regular` it is refused.
    """
    context = click.get_current_context(silent=True)
    inputs = [*inputs, *([context.obj] if context and context.obj else [])]
    inputs += [str(part) for one in inputs for part in kept_parts(Path(one)).values()]
    taken: dict[Path, str] = {}
    for name, path in outputs:
        if path is None:
            continue
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
        elif force is None and is_capture(file):
            wrong = "is a capture, which is not overwritten: name another file"
        elif force is False and file.is_file():
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
