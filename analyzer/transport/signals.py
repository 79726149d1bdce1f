"""Handling of SIGINT (Ctrl-C), SIGTERM, SIGHUP and SIGTSTP (Ctrl-Z), for who drives a robot."""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any, Self

from bilprov.captures.closing import Closing

Handler = Callable[[int, FrameType | None], object]


class Stopper(Closing):
    """Turns SIGINT, SIGTERM and SIGHUP into a clean stop: `fileno()` is readable from then on.

    As a context manager it installs handlers for the three signals (in the main thread; elsewhere
    it only offers `stop`) and restores the old handlers at the end. A SIGHUP that is ignored
    already, as under nohup, stays ignored. A second signal has no effect, so that a command can
    finish its file; SIGQUIT (Ctrl-\\) still ends the process at once. A program that goes on after
    Ctrl-C, such as a prompt, takes the request back by `withdraw`.
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
        if _in_main_thread():
            self._handlers.enter_context(
                _handled(_heeded(), lambda number, frame: self.stop(number))
            )
            # A signal that comes between the interpreter's own check and the select call would be
            # handled only at the next event. The wakeup descriptor, which C code writes, ends the
            # select at once.
            old = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            self._handlers.callback(_restore_wakeup, old)
        return self


@contextmanager
def undisturbed(*, again: bool) -> Iterator[None]:
    """Hold signals back until the block ends, so that it can stop the robot first.

    If `again`, the first signal that came is raised afterwards. Without effect outside the main
    thread.
    """
    heard: list[int] = []
    with _handled(_heeded(), lambda number, frame: heard.append(number)):
        yield
    if heard and again:
        signal.raise_signal(heard[0])


@contextmanager
def ending_in_order(halt: Callable[[], object]) -> Iterator[None]:
    """Turn SIGTERM and SIGHUP, where they have no handler, into SystemExit inside the block.

    So the block's cleanup runs, as it does after Ctrl-C. `halt` is called first, also by Ctrl-C
    where the program does not handle it: a second signal may end the cleanup before it has begun.
    Without effect outside the main thread.
    """

    def end(number: int, frame: FrameType | None) -> None:
        halt()
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    usual = (signal.SIG_DFL, signal.default_int_handler)
    with _handled([number for number in numbers if signal.getsignal(number) in usual], end):
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
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)  # returns once the process is continued
        signal.signal(number, suspend)
        continued()

    unhandled = signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL
    with _handled([signal.SIGTSTP] if unhandled else [], suspend):
        yield


@contextmanager
def _handled(numbers: Iterable[signal.Signals], handler: Handler) -> Iterator[None]:
    """Handle signals by `handler` until the block ends. Without effect outside the main thread."""
    old: dict[signal.Signals, Any] = {}
    try:
        for number in numbers if _in_main_thread() else ():
            old[number] = signal.signal(number, handler)
        yield
    finally:
        while old:
            signal.signal(*old.popitem())


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _restore_wakeup(descriptor: int) -> None:
    try:
        signal.set_wakeup_fd(descriptor)
    except OSError:  # the old wakeup descriptor was closed in the meantime
        signal.set_wakeup_fd(-1)


def _heeded() -> Iterator[signal.Signals]:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        handler = signal.getsignal(number)
        # nohup ignores SIGHUP so that the run goes on without its terminal. A shell's background
        # jobs ignore SIGINT too, but there `kill -INT` is how a script ends what it started.
        nohup = number is signal.SIGHUP and handler is signal.SIG_IGN
        # None is a handler that was not set from Python and cannot be put back from here.
        if handler is not None and not nohup:
            yield number
