"""Handling of the signals that end or suspend a process, for who drives a robot.

Which signals end a process is listed in one place, `transport.ending`.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Self

from bilprov.analyzer.transport.ending import ENDINGS, REQUESTS, note_ending
from bilprov.captures.closing import Closing

Handler = Callable[[int, FrameType | None], object]


@dataclass(frozen=True, slots=True)
class _HaltFirst:
    """The handler of `halting_first`: it counts as none, since the usual follows."""

    halt: Callable[[int], object]

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.halt(number)
        _as_usual(number)


class Stopper(Closing):
    """Turns each signal that ends a process into a clean stop: `fileno()` is readable from then on.

    As a context manager it handles these signals (in the main thread; elsewhere it only offers
    `stop`) and restores the old handlers at the end. A signal that is ignored already, as SIGHUP is
    under nohup, stays ignored, but for SIGINT and SIGTERM. A second signal has no effect, so that a
    command can finish its file. A program that goes on after Ctrl-C, such as a prompt, takes the
    request back by `withdraw`.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._causes: set[int] = set()
        self._handlers = ExitStack()

    @property
    def stopped(self) -> bool:
        """Whether a stop was asked for."""
        return bool(self._causes)

    def fileno(self) -> int:
        """Return the descriptor that is readable once a stop was asked for."""
        return self._reader.fileno()

    def stop(self, cause: int = 0) -> None:
        """Request a stop, from any thread or signal handler; `cause` is a signal's number."""
        self._causes.add(cause)
        # Closed already: no loop waits any more. Full: the descriptor is readable all the same.
        with contextlib.suppress(OSError):
            self._writer.send(b"\0")

    def withdraw(self, cause: int) -> bool:
        """Take back the stop that this signal requested, and return whether it had.

        A stop for another cause stands.
        """
        if cause not in self._causes:
            return False
        self._causes.discard(cause)
        with contextlib.suppress(BlockingIOError):
            while self._reader.recv(64):
                pass
        if self._causes:
            self.stop(next(iter(self._causes)))
        return True

    @property
    def suspended(self) -> bool:
        """Whether the process was suspended after `before_suspending`, and not withdrawn since."""
        return signal.SIGTSTP in self._causes

    def before_suspending(self, halt: Callable[[], object]) -> None:
        """Let SIGTSTP (Ctrl-Z) request a stop and call `halt` before it suspends the process.

        So nothing drives on while the process is suspended; once it is continued, it finds the
        request. Only for the main thread, until `close`.
        """

        def stop_first() -> None:
            self.stop(signal.SIGTSTP)  # before it: another thread may be driving
            halt()

        self._handlers.enter_context(suspending(stop_first))

    def close(self) -> None:
        """Restore the old handlers and close; further calls do nothing."""
        self._handlers.close()
        self._reader.close()
        self._writer.close()

    def __enter__(self) -> Self:
        if in_main_thread():
            self._handlers.enter_context(_handled(_heeded(), self._end))
            # A signal that comes between the interpreter's own check and the select call would be
            # handled only at the next event. The wakeup descriptor, which C code writes, ends the
            # select at once.
            old = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            self._handlers.callback(_restore_wakeup, old)
        return self

    def _end(self, number: int, frame: FrameType | None) -> None:
        note_ending(number)
        self.stop(number)


@contextmanager
def undisturbed(*, again: bool) -> Iterator[None]:
    """Hold signals back until the block ends, so that it can stop the robot first.

    If `again`, those that came are raised afterwards. Without effect outside the main thread.
    """
    heard: dict[int, None] = {}
    with _handled(_held_back(), lambda number, frame: heard.setdefault(number)):
        yield
    for number in heard if again else ():
        signal.raise_signal(number)


@contextmanager
def ending_in_order(halt: Callable[[int], object]) -> Iterator[None]:
    """Turn each signal that ends a process into SystemExit inside the block.

    So the block's cleanup runs, as it does after Ctrl-C. `halt` is called first with the signal,
    also by Ctrl-C: a second signal may end the cleanup before it has begun. A signal that the
    program handles or ignores stays so. Without effect outside the main thread.
    """

    def end(number: int, frame: FrameType | None) -> None:
        halt(number)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    with handled_endings(end):
        yield


@contextmanager
def suspending(
    halt: Callable[[], object], continued: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Let SIGTSTP (Ctrl-Z) call `halt` before it suspends the process, inside the block.

    `continued` is called once the process goes on. A SIGTSTP that is ignored or handled already
    stays so. Without effect outside the main thread; SIGSTOP cannot be handled.
    """

    def suspend(number: int, frame: FrameType | None) -> None:
        halt()
        _as_usual(number)
        continued()

    with _handled(_unhandled([signal.SIGTSTP]), suspend):
        yield


def halting_first(halt: Callable[[int], object]) -> None:
    """Let each signal call `halt` before it ends or suspends the process as usual, from now on.

    Only for the main thread. A signal that the program handles or ignores stays so, and so does
    SIGINT, which is an exception in Python; asyncio asks for the usual handler of it.
    """

    for number in _unhandled([*ENDINGS, signal.SIGTSTP]):
        if number != signal.SIGINT:
            signal.signal(number, _HaltFirst(halt))


@contextmanager
def handled_endings(handler: Handler) -> Iterator[None]:
    """Handle each signal that ends a process, unless the program itself handles or ignores it.

    Without effect outside the main thread.
    """
    with _handled(_unhandled(ENDINGS), handler):
        yield


def in_main_thread() -> bool:
    """Whether signals can be handled from here."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def _handled(numbers: Iterable[int], handler: Handler) -> Iterator[None]:
    """Handle signals by `handler` until the block ends. Without effect outside the main thread."""
    old: dict[int, Any] = {}
    try:
        for number in numbers if in_main_thread() else ():
            old[number] = signal.signal(number, handler)
        yield
    finally:
        while old:
            signal.signal(*old.popitem())


def _as_usual(number: int) -> None:
    """End or suspend the process by a signal; returns once a suspended one is continued."""
    handler = signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
    signal.signal(number, handler)


def _restore_wakeup(descriptor: int) -> None:
    try:
        signal.set_wakeup_fd(descriptor)
    except OSError:  # the old wakeup descriptor was closed in the meantime
        signal.set_wakeup_fd(-1)


def _heeded() -> set[int]:
    """The signals that ask a command to end."""
    heeded = set(_unhandled(ENDINGS))
    for number in REQUESTS:
        handler = signal.getsignal(number)
        # nohup ignores SIGHUP so that the run goes on without its terminal. A shell's background
        # jobs ignore SIGINT too, but there `kill -INT` is how a script ends what it started.
        nohup = number == signal.SIGHUP and handler is signal.SIG_IGN
        # None is a handler that was not set from Python and cannot be put back from here.
        if handler is not None and not nohup:
            heeded.add(number)
    return heeded


def _held_back() -> list[int]:
    """The signals that would end the process, or whose handlers could raise an exception."""
    unhandled = _unhandled(ENDINGS)
    return [n for n in ENDINGS if n in unhandled or callable(signal.getsignal(n))]


def _unhandled(numbers: Iterable[int]) -> list[int]:
    """Those of the signals that the program neither handles nor ignores."""
    caught = _caught()
    usual = (signal.SIG_DFL, signal.default_int_handler)
    found = []
    for number in numbers:
        handler = signal.getsignal(number)
        in_c = handler is signal.SIG_DFL and caught >> (number - 1) & 1
        if isinstance(handler, _HaltFirst) or (handler in usual and not in_c):
            found.append(number)
    return found


def _caught() -> int:
    """A bit for each signal that has a handler, also those set in C, which Python does not know of.

    A profiler and `faulthandler.register` set such; 0 where the system does not tell.
    """
    with contextlib.suppress(OSError, ValueError):
        _, caught = Path("/proc/self/status").read_bytes().split(b"SigCgt:")
        return int(caught.split()[0], 16)
    return 0
