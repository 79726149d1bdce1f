"""Standard output and standard error of a command, and its exit code if one of them breaks.

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
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TextIO

from bilprov.analyzer.cli.failures import say
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
    nowhere = _fill_closed_descriptors()
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


def _fill_closed_descriptors() -> int:
    """Open /dev/null, read-only, in place of each closed descriptor 0, 1 or 2.

    So no file or port opened later becomes a standard stream. Returns one more such descriptor.
    """
    while (number := os.open(os.devnull, os.O_RDONLY)) <= 2:
        os.set_inheritable(number, True)
    return number


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
