"""The signals that end or suspend a process, and their handling for who drives a robot.

A command is asked to end by a `Stopper`; who needs an exception instead, such as `Robot`, handles
them by `handled`. What Python itself would lose of them `interrupts_kept` sends again.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import Any, Self

from bilprov.captures.closing import Closing

Handler = Callable[[int, FrameType | None], object]

REQUESTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The usual requests to end: a command that they end has an exit code of its own for that."""


def _endings() -> tuple[int, ...]:
    names = "SIGQUIT SIGUSR1 SIGUSR2 SIGALRM SIGVTALRM SIGPROF SIGXCPU SIGIO SIGPWR SIGSTKFLT"
    others = [getattr(signal, name) for name in names.split() if hasattr(signal, name)]
    first = getattr(signal, "SIGRTMIN", 0)
    realtime = range(first, signal.SIGRTMAX + 1) if first else ()
    return (*REQUESTS, *others, *realtime)


ENDINGS = _endings()
"""Every signal that ends a process unless it is handled.

SIGKILL cannot be handled. SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGSYS and SIGTRAP are how a
process crashes: no Python can run after them. Python ignores SIGPIPE and SIGXFSZ.
"""

SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""Signals that suspend a process unless it is handled: Ctrl-Z, and the use of the terminal by a job
in the background. SIGSTOP cannot be handled."""

_heard: list[int] = []
_lasting: list[Any] = [signal.SIG_DFL, signal.default_int_handler]
_halts: list[Callable[[], object]] = []


class Stopper(Closing):
    """Turns each signal that ends a process into a clean stop: `fileno()` is readable from then on.

    As a context manager it handles these signals (in the main thread; elsewhere it only offers
    `stop`) and restores the old handlers at the end. A signal that is ignored already, as SIGHUP is
    under nohup, stays ignored, but for SIGINT and SIGTERM. A second signal has no effect, so that a
    command can finish its file, and a robot is stopped before anything else is done. A program that
    goes on after Ctrl-C, such as a prompt, takes the request back by `withdraw`; one that only
    postponed the signals gets them by `pass_on`.
    """

    def __init__(self) -> None:
        import socket  # which takes 3 ms to load, and most commands need none

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
        return not self._causes.isdisjoint(SUSPENDING)

    def before_suspending(self, halt: Callable[[], object]) -> None:
        """Let what suspends the process request a stop and call `halt` before it does.

        So nothing drives on while the process is suspended; once it is continued, it finds the
        request. Only for the main thread, until `close`.
        """

        def suspend(number: int, frame: FrameType | None) -> None:
            self.stop(number)  # before it: another thread may be driving
            halt()
            as_usual(number)

        self._handlers.enter_context(handled(unhandled(SUSPENDING), suspend))
        _halts.append(halt)
        self._handlers.callback(_halts.remove, halt)

    def pass_on(self) -> None:
        """Raise the signals that asked for a stop again, once this is closed."""
        for number in self._causes:
            signal.raise_signal(number)

    def close(self) -> None:
        """Restore the old handlers and close; further calls do nothing."""
        self._handlers.close()
        self._reader.close()
        self._writer.close()

    def __enter__(self) -> Self:
        if in_main_thread():
            self._handlers.enter_context(handled(_heeded(), self._end))
            # A signal that comes between the interpreter's own check and the select call would be
            # handled only at the next event. The wakeup descriptor, which C code writes, ends the
            # select at once.
            old = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
            self._handlers.callback(_restore_wakeup, old)
        return self

    def _end(self, number: int, frame: FrameType | None) -> None:
        _heard.append(number)  # also where it is put off
        self.stop(number)


@contextmanager
def handled(numbers: Iterable[int], handler: Handler) -> Iterator[None]:
    """Handle signals by `handler` until the block ends. Without effect outside the main thread."""
    old: dict[int, Any] = {}
    try:
        for number in numbers if in_main_thread() else ():
            old[number] = signal.signal(number, handler)
        yield
    finally:
        while old:
            signal.signal(*old.popitem())


def handled_from_now_on(handler: Handler) -> None:
    """Handle each signal that ends or suspends a process by `handler`, which then does the same.

    So it counts as none where others handle signals. Only for the main thread. A signal that the
    program handles or ignores stays so, and so does SIGINT, which is an exception in Python;
    asyncio asks for the usual handler of it.
    """
    if handler not in _lasting:
        _lasting.append(handler)
    for number in unhandled([*ENDINGS, *SUSPENDING]):
        if number != signal.SIGINT:
            signal.signal(number, handler)


def unhandled(numbers: Iterable[int]) -> list[int]:
    """Those of the signals that the program neither handles nor ignores."""
    return [number for number in numbers if signal.getsignal(number) in _lasting]


def ending_requested() -> bool:
    """Whether a signal has asked the command to end, also one that was put off and is over."""
    return bool(_heard)


def exit_status(status: int) -> int:
    """The exit code of the command that has ended with `status`.

    It is 128 + N where a signal N other than SIGINT, SIGTERM and SIGHUP ended it.
    """
    others = [number for number in _heard if number not in REQUESTS]
    _heard.clear()
    return 128 + others[0] if others else status


def halt_if_ending() -> None:
    """Stop each robot if a signal has asked the command to end, which cannot go on by itself."""
    for halt in _halts if _heard else ():
        halt()


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Send a SIGINT again whose KeyboardInterrupt was raised where no exception can go on.

    Such a place is a callback of the interpreter's own, as when an import ends: it prints
    "Exception ignored in" and goes on, and a robot would drive although Ctrl-C was pressed.
    """
    before = sys.unraisablehook

    def ignored(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            before(lost)
            return
        # Not at once: it would be raised in here, and be lost again.
        while True:
            # On a busy machine it may come before its timer's thread is known to have started.
            with contextlib.suppress(KeyboardInterrupt):
                threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
                break

    sys.unraisablehook = ignored
    try:
        yield
    finally:
        sys.unraisablehook = before


def as_usual(number: int) -> None:
    """End or suspend the process by a signal; returns once a suspended one is continued."""
    handler = signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
    signal.signal(number, handler)


def in_main_thread() -> bool:
    """Whether signals can be handled from here."""
    return threading.current_thread() is threading.main_thread()


def _restore_wakeup(descriptor: int) -> None:
    signal.set_wakeup_fd(-1)
    with contextlib.suppress(OSError):  # the old wakeup descriptor was closed in the meantime
        signal.set_wakeup_fd(descriptor)


def _heeded() -> set[int]:
    """The signals that ask a command to end: they would end it, or their handlers might."""
    # nohup ignores SIGHUP so that the run goes on without its terminal. A shell's background jobs
    # ignore SIGINT too, but there `kill -INT` is how a script ends what it started.
    handlers = {number: signal.getsignal(number) for number in ENDINGS}
    ignored = {n for n in (signal.SIGINT, signal.SIGTERM) if handlers[n] is signal.SIG_IGN}
    return ignored.union(unhandled(ENDINGS), (n for n in ENDINGS if callable(handlers[n])))
