"""Standard output and standard error of a command, and its exit code if one of them breaks.

A stream breaks when its reader closes it, when the disk behind it is full, or when the command
writes to a stream that was closed before the command began. Later output to it is discarded.

- A command that called `promise_verdict` continues to its end: the robot is judged and stopped, and
  every file is written. Its exit code is then 2, since 0, 1 and 3 say that all was delivered.
- Any other command ends without a message and with 0 when the reader closes its standard output; a
  full disk there is an error (2). A broken standard error, and a stream that was closed from the
  start, do not matter.

A reader that is slow is waited for, also where a stream is non-blocking.
"""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple, TextIO

from bilprov.analyzer.cli.failures import say

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_VERDICTS = (0, 1, 3)  # the exit codes that say something about a device or a file


class _Descriptor(io.FileIO):
    """The descriptor of a standard stream; drops output after the error that `broke` it."""

    def __init__(self, number: int, name: str, *, needed: bool) -> None:
        super().__init__(number, "w", closefd=False)
        self.called = name
        self.needed = needed
        self.verdict = False
        self.broke: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write to the descriptor. Raises SystemExit if it breaks and the command should end."""
        if self.broke is None:
            try:
                # Another program may have made the pipe or terminal that it shares with this one
                # non-blocking, and then nothing is written while there is no room.
                while (written := super().write(data)) is None:
                    select.select([], [self], [])
                return written
            except OSError as error:
                self.broke = error
                if self.needed and not self.verdict and not self.was_closed:
                    raise SystemExit(0) from None
        return memoryview(data).nbytes

    @property
    def was_closed(self) -> bool:
        """Whether the stream was closed from the start, or was not open for writing."""
        return self.broke is not None and self.broke.errno == errno.EBADF

    @property
    def unread(self) -> bool:
        """Whether the stream broke because its reader closed it."""
        return isinstance(self.broke, (BrokenPipeError, ConnectionResetError))

    @property
    def why(self) -> str:
        """The reason why the stream broke, in words."""
        if self.was_closed:
            return f"{self.called} is closed"
        return f"{self.called}: {self.broke.strerror if self.broke else ''}"


class Streams(NamedTuple):
    """The standard output and standard error of a running command, if they are real streams."""

    streams: list[TextIO]
    descriptors: list[_Descriptor]

    def settled(self, status: int) -> int:
        """Flush the streams and return the exit code of a command that ended with `status`.

        If a stream broke and that matters, one sentence on standard error says so.
        """
        for stream in self.streams:
            with suppress(SystemExit):
                stream.flush()
        for one in self.descriptors:
            if one.broke is None:
                continue
            if one.verdict:
                say(f"{one.why}: not all could be shown, so the exit code is 2")
                status = 2 if status in _VERDICTS else status
            elif one.needed and one.unread:
                status = 0 if status in _VERDICTS else status
            elif one.needed and not one.was_closed:
                say(one.why)
                status = 2
        return status


@contextmanager
def standard_streams() -> Iterator[Streams]:
    """Replace the process's streams by ones that handle breaking; restore them at the end."""
    nowhere = _fill_closed_descriptors()
    own = sys.stdin, sys.stdout, sys.stderr
    if sys.stdin is None:
        sys.stdin = open(nowhere, closefd=False)  # noqa: SIM115
    streams: list[TextIO] = []
    descriptors: list[_Descriptor] = []
    for attribute in ("stdout", "stderr"):
        stream = getattr(sys, attribute)
        number = nowhere if stream is None else _number(stream)
        if number is None:
            continue
        name = {"stdout": "standard output", "stderr": "standard error"}[attribute]
        descriptor = _Descriptor(number, name, needed=attribute == "stdout")
        streams.append(_text(descriptor, stream))
        descriptors.append(descriptor)
        setattr(sys, attribute, streams[-1])
    try:
        yield Streams(streams, descriptors)
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


def _number(stream: TextIO) -> int | None:
    """The descriptor of a stream, None if it has none, as when Python code captures the output."""
    try:
        stream.flush()
        return stream.fileno()
    except (OSError, ValueError):
        return None


def _text(descriptor: _Descriptor, like: TextIO | None) -> io.TextIOWrapper:
    return io.TextIOWrapper(
        io.BufferedWriter(descriptor),
        encoding=like.encoding if like else "utf-8",
        errors="backslashreplace",  # a narrow locale is no reason to fail
        line_buffering=bool(getattr(like, "line_buffering", True)),
        write_through=bool(getattr(like, "write_through", False)),
    )
