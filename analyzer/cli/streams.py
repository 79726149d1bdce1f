"""The standard streams of a command, and how its failures are reported: one sentence, an exit code.

A stream breaks when its reader closes it, when the disk behind it is full, or when the command
writes to a stream that was closed before the command began. Later output to it is discarded.

- A command that called `promise_verdict` continues to its end: the robot is judged and stopped, and
  every file is written. Its exit code is then 2, since 0, 1 and 3 say that all was delivered.
- Any other command ends without a message and with 0 when the reader closes its standard output; a
  full disk there is an error (2). A broken standard error, and a stream that was closed from the
  start, do not matter.

A reader that is slow is waited for, also where a stream is non-blocking. If a signal asks the
command to end meanwhile, its robot is stopped at once.
"""

from __future__ import annotations

import errno
import io
import os
import re
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TextIO

import click
from click import exceptions

from bilprov.analyzer.output.console import NARROW
from bilprov.analyzer.transport.signals import halt_if_ending

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_VERDICTS = (0, 1, 3)  # the exit codes that say something about a device or a file


class _Descriptor(io.FileIO):
    """The descriptor of a standard stream; drops output after the error that `broke` it."""

    def __init__(self, number: int, name: str) -> None:
        super().__init__(number, "w", closefd=False)
        self.called = f"standard {'output' if name == 'stdout' else 'error'}"
        self.needed = name == "stdout"
        self.verdict = False
        self.broke: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write to the descriptor. Raises SystemExit if it breaks and the command should end."""
        if self.broke is None:
            try:
                while (written := self._written(data)) is None:
                    halt_if_ending()
                return written
            except OSError as error:
                self.broke = error
                if self.needed and not self.verdict and not self.was_closed:
                    raise SystemExit(0) from None
        return memoryview(data).nbytes

    def _written(self, data: ReadableBuffer) -> int | None:
        """How much was written; None where nobody has read for a while, as after Ctrl-S."""
        # Another program may have made the pipe or terminal that it shares with this one
        # non-blocking, and then nothing is written while there is no room.
        return super().write(data) if select.select([], [self], [], 0.2)[1] else None

    @property
    def was_closed(self) -> bool:
        """Whether the stream was closed from the start, or was not open for writing."""
        return self.broke is not None and self.broke.errno == errno.EBADF

    def settled(self, status: int) -> int:
        """The exit code of a command that ended with `status`; says what broke, if it matters."""
        if self.broke is None:
            return status
        why = " is closed" if self.was_closed else f": {self.broke.strerror}"
        if self.verdict:
            say(f"{self.called}{why}: not all could be shown, so the exit code is 2")
            return 2 if status in _VERDICTS else status
        if not self.needed or self.was_closed:
            return status
        if isinstance(self.broke, (BrokenPipeError, ConnectionResetError)):  # its reader closed it
            return 0 if status in _VERDICTS else status
        say(f"{self.called}{why}")
        return 2


@contextmanager
def standard_streams() -> Iterator[Callable[[int], int]]:
    """Replace the process's streams by ones that handle breaking; restore them at the end.

    Gives a function that flushes them and returns the exit code of a command that ended with a
    status. If a stream broke and that matters, one sentence on standard error says so.
    """
    # /dev/null, read-only, takes the place of each closed descriptor 0, 1 or 2, so that no file or
    # port that is opened later becomes a standard stream; `nowhere` is one more.
    while (nowhere := os.open(os.devnull, os.O_RDONLY)) <= 2:
        os.set_inheritable(nowhere, True)
    own = sys.stdin, sys.stdout, sys.stderr
    sys.stdin = sys.stdin or open(nowhere, closefd=False)  # noqa: SIM115
    opened = [pair for name in ("stdout", "stderr") if (pair := _opened(name, nowhere))]

    def settled(status: int) -> int:
        for stream, _ in opened:
            with suppress(SystemExit):
                stream.flush()
        for _, descriptor in opened:
            status = descriptor.settled(status)
        return status

    try:
        yield settled
    finally:
        sys.stdin, sys.stdout, sys.stderr = own
        os.close(nowhere)


def promise_verdict() -> None:
    """Declare that the exit code is a verdict, so that a broken stream does not end the command."""
    for stream in (sys.stdout, sys.stderr):
        descriptor = getattr(getattr(stream, "buffer", None), "raw", None)
        if isinstance(descriptor, _Descriptor):
            descriptor.verdict = True


def _opened(name: str, nowhere: int) -> tuple[TextIO, _Descriptor] | None:
    """Put a stream that handles breaking in the place of a standard stream.

    Gives it and its descriptor; None where it has none, as when Python code captures the output.

    """
    stream: TextIO | None = getattr(sys, name)
    try:
        if stream:
            stream.flush()
        number = stream.fileno() if stream else nowhere
    except (OSError, ValueError):
        return None
    descriptor = _Descriptor(number, name)
    text = io.TextIOWrapper(
        io.BufferedWriter(descriptor),
        encoding=stream.encoding if stream else "utf-8",
        errors=NARROW,  # a narrow locale is no reason to fail
        line_buffering=bool(getattr(stream, "line_buffering", True)),
        write_through=bool(getattr(stream, "write_through", False)),
    )
    setattr(sys, name, text)
    return text, descriptor


def report(error: BaseException) -> int:
    """Print what went wrong, in one sentence on standard error, and return the exit code."""
    from bilprov.spec.errors import UserError

    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        # So that it does not wait for a slow reader. A test that captures output has no such file.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 130
    if isinstance(error, exceptions.NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
    elif isinstance(error, click.ClickException):
        say(_usage(error))
    elif isinstance(error, UserError):
        say(str(error))
    elif isinstance(error, MemoryError):
        say("memory ran out: close other programs, raise its limit (ulimit -v), or ask for less")
    elif isinstance(error, OSError) and error.strerror:  # a full disk
        say(f"{error.filename}: {error.strerror}" if error.filename else error.strerror)
    else:
        import traceback

        traceback.print_exception(error)
        say("this is a bug in bilprov, not in the device; please report it with the lines above")
    return 2


def say(sentence: str) -> None:
    """Print a sentence on standard error as one safe line of at most 4,000 characters."""
    from bilprov.spec.errors import one_line

    click.echo(f"bilprov: {one_line(sentence)}", err=True)


# The beginnings of click's own sentences; ours may begin with a name, which keeps its case.
_CLICK_BEGINS = ("Missing ", "No such ", "Invalid value", "Got unexpected ", "Option ", "Could not")


def _usage(error: click.ClickException) -> str:
    """Convert click's message to one plain sentence that also says what to do next."""
    text = error.message if isinstance(error, _NO_SUCH) else error.format_message()
    text = " ".join(text.split()).rstrip(".")
    for kind, words in (("integer", "not a whole number"), ("float", "not a number")):
        text = re.sub(rf"is not a valid {kind}(?: range)?\b", f"is {words}", text)
    if isinstance(error, click.BadParameter) and error.ctx and error.param:
        from bilprov.analyzer.cli.settings import as_set, is_setting

        if is_setting(error.ctx, error.param):
            text = f"{text}, {as_set()}"
    if text.startswith(_CLICK_BEGINS):
        text = text[0].lower() + text[1:]
    if isinstance(error, _NO_SUCH) and error.possibilities:
        return f"{text}, did you mean {error.possibilities[0]}?"
    if isinstance(error, click.UsageError) and error.ctx and "; see " not in text:
        return f"{text}; see {error.ctx.command_path} --help"
    return text


_NO_SUCH = (exceptions.NoSuchOption, exceptions.NoSuchCommand)
